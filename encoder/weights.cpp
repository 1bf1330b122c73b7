#include "encoder/weights.h"

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "vdb/file_io.h"

namespace vdbc {
namespace {

using nlohmann::json;
constexpr uint64_t kMaxHeader = 64u << 20;
constexpr int64_t kMaxCount = int64_t(1) << 40;  // values of a tensor

const char* typeName(torch::ScalarType type) {
  switch (type) {
    case torch::kFloat32:
      return "F32";
    case torch::kFloat16:
      return "F16";
    case torch::kInt32:
      return "I32";
    case torch::kInt64:
      return "I64";
    default:
      throw Error("writeTensors: only float32, float16, int32 and int64 tensors can be stored");
  }
}

torch::ScalarType typeOf(const std::string& name, const std::string& path) {
  if (name == "F32") return torch::kFloat32;
  if (name == "F16") return torch::kFloat16;
  if (name == "I32") return torch::kInt32;
  if (name == "I64") return torch::kInt64;
  throw Error(
      joinText("readTensors: ", path, ": expected dtype F16, F32, I32 or I64, found ", name));
}

}  // namespace

void writeTensors(const TensorFile& file, const std::string& path) {
  json header;
  if (!file.metadata.empty()) header["__metadata__"] = file.metadata;
  uint64_t offset = 0;
  for (const auto& [name, tensor] : file.tensors) {
    const uint64_t bytes = uint64_t(tensor.nbytes());
    header[name] = {{"dtype", typeName(tensor.scalar_type())},
                    {"shape", tensor.sizes().vec()},
                    {"data_offsets", {offset, offset + bytes}}};
    offset += bytes;
  }
  std::string text = header.dump();
  text.resize((text.size() + 7) / 8 * 8, ' ');
  TemporaryFile target("writeTensors", path);
  std::ofstream out(target.path(), std::ios::binary);
  require(out.good(), "writeTensors: ", path, ": cannot create the file");
  const uint64_t length = text.size();
  out.write(reinterpret_cast<const char*>(&length), 8);
  out.write(text.data(), std::streamsize(text.size()));
  for (const auto& entry : file.tensors) {
    const Tensor t = entry.second.detach().cpu().contiguous();
    out.write(static_cast<const char*>(t.data_ptr()), std::streamsize(t.nbytes()));
  }
  out.close();
  require(out.good(), "writeTensors: ", path, ": write failed (disk full?)");
  target.commit();
}

TensorFile readTensors(const std::string& path) {
  std::ifstream in(path, std::ios::binary | std::ios::ate);
  require(in.good() && std::filesystem::is_regular_file(path), "readTensors: ", path,
          ": cannot open the file");
  const uint64_t size = uint64_t(in.tellg());
  require(size >= 8, "readTensors: ", path, ": expected a safetensors file, found ", size,
          " bytes");
  in.seekg(0);
  uint64_t length = 0;
  in.read(reinterpret_cast<char*>(&length), 8);
  require(length <= kMaxHeader && length <= size - 8, "readTensors: ", path,
          ": expected a header of at most ", size - 8, " bytes, found ", length);
  std::string text(length, '\0');
  in.read(text.data(), std::streamsize(length));
  TensorFile file;
  try {
    const json header = json::parse(text);
    const uint64_t data = size - 8 - length;
    for (const auto& [name, entry] : header.items()) {
      if (name == "__metadata__") {
        file.metadata = entry.get<std::map<std::string, std::string>>();
        continue;
      }
      const auto type = typeOf(entry.at("dtype").get<std::string>(), path);
      const auto shape = entry.at("shape").get<std::vector<int64_t>>();
      const auto offsets = entry.at("data_offsets").get<std::vector<uint64_t>>();
      uint64_t count = 1;
      for (int64_t d : shape) {
        require(d >= 0 && d <= kMaxCount && (d == 0 || int64_t(count) <= kMaxCount / d),
                "readTensors: ", path, ": ", name, " has an impossible shape");
        count *= uint64_t(d);
      }
      const uint64_t bytes = count * torch::elementSize(type);
      require(offsets.size() == 2 && offsets[0] <= offsets[1] && offsets[1] <= data &&
                  offsets[1] - offsets[0] == bytes,
              "readTensors: ", path, ": ", name, ": expected ", bytes,
              " bytes inside the file, found other offsets (truncated?)");
      Tensor t = torch::empty(shape, type);
      in.seekg(std::streamoff(8 + length + offsets[0]));
      in.read(static_cast<char*>(t.data_ptr()), std::streamsize(bytes));
      require(in.good(), "readTensors: ", path, ": ", name, " cannot be read");
      file.tensors[name] = type == torch::kFloat16 ? t.to(torch::kFloat32) : t;
    }
  } catch (const json::exception&) {
    throw Error(joinText("readTensors: ", path, ": the header is not valid safetensors JSON"));
  }
  return file;
}

void addModule(const torch::nn::Module& module, const std::string& prefix, TensorFile* file) {
  for (const auto& p : module.named_parameters()) file->tensors[prefix + p.key()] = p.value();
  for (const auto& p : module.named_buffers()) file->tensors[prefix + p.key()] = p.value();
}

void loadModule(torch::nn::Module& module, const std::string& prefix, const TensorFile& file,
                const std::string& path) {
  torch::NoGradGuard no_grad;
  auto copy = [&](const std::string& name, Tensor& target) {
    const auto found = file.tensors.find(prefix + name);
    require(found != file.tensors.end(), "loadModule: ", path, ": expected a tensor ", prefix, name,
            ", found none");
    require(found->second.sizes() == target.sizes(), "loadModule: ", path, ": ", prefix, name,
            ": expected shape ", target.sizes(), ", found ", found->second.sizes());
    require(torch::isfinite(found->second).all().item<bool>(), "loadModule: ", path, ": ", prefix,
            name, " contains NaN or infinity");
    target.copy_(found->second);
  };
  for (auto& p : module.named_parameters()) copy(p.key(), p.value());
  for (auto& p : module.named_buffers()) copy(p.key(), p.value());
}

std::string weightsHash(const torch::nn::Module& module) {
  uint64_t hash = 1469598103934665603ull;
  auto add = [&](const void* data, size_t bytes) { hash = fnv1a(data, bytes, hash); };
  auto addTensor = [&](const std::string& name, const Tensor& value) {
    const Tensor t = value.detach().contiguous();
    add(name.data(), name.size());
    add(t.data_ptr(), t.nbytes());
  };
  for (const auto& p : module.named_parameters()) addTensor(p.key(), p.value());
  for (const auto& b : module.named_buffers()) addTensor(b.key(), b.value());
  return hexOf(hash);
}

}  // namespace vdbc
