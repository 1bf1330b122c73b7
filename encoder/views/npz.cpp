#include "encoder/views/npz.h"

#include <half.h>

#include <charconv>
#include <cstring>

#include "vdb/error.h"

namespace vdbc {
namespace {

constexpr uint64_t kMaxNpyHeaderBytes = 1 << 16;
constexpr uint64_t kMaxArrayBytes = uint64_t(1) << 34;
constexpr int64_t kMaxExtent = int64_t(1) << 28;
static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "values are copied as they are");

template <typename T>
T load(const char* from) {
  T value;
  std::memcpy(&value, from, sizeof(value));
  return value;
}

/// Bytes of a value of a `descr` such as '<f4' (quotes included), 0 if it is not among ours.
int wordOf(std::string_view descr) {
  for (const auto& [name, bytes] :
       {std::pair<std::string_view, int>{"<f4", 4}, {"<f2", 2}, {"<f8", 8}, {"|u1", 1}, {"<u1", 1}})
    if (descr.size() > 4 && descr.substr(1, 3) == name && descr[4] == descr[0]) return bytes;
  return 0;
}

/// What follows `'key':` in a header, which is the text of a Python dictionary.
std::string_view valueOf(std::string_view header, std::string_view key) {
  for (const char quote : {'\'', '"'}) {
    const std::string quoted = std::string(1, quote) + std::string(key) + quote;
    size_t at = header.find(quoted);
    if (at == std::string_view::npos) continue;
    at = header.find_first_not_of(" :", at + quoted.size());
    return at == std::string_view::npos ? std::string_view() : header.substr(at);
  }
  return {};
}

/// The dimensions in "(2, 3)", "(5,)" or "()"; nothing if it is something else.
std::optional<std::vector<int64_t>> parseShape(std::string_view text) {
  if (text.empty() || text[0] != '(' || text.find(')') == std::string_view::npos) return {};
  text = text.substr(1, text.find(')') - 1);
  std::vector<int64_t> shape;
  while (true) {
    const size_t begin = text.find_first_not_of(" ,");
    if (begin == std::string_view::npos) return shape;
    text.remove_prefix(begin);
    int64_t dim = -1;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), dim);
    if (error != std::errc() || dim < 0 || dim > kMaxExtent || shape.size() == 8) return {};
    shape.push_back(dim);
    text.remove_prefix(size_t(end - text.data()));
  }
}

/// The dictionary of an .npy file that starts with `start`, and where its values begin; empty if it
/// is none.
std::string_view headerOf(std::string_view start, size_t* begin) {
  if (start.size() < 12 || start.substr(0, 6) != "\x93NUMPY") return {};
  const bool short_form = start[6] == 1;  // versions 2 and 3 have four bytes of length
  const size_t length =
      short_form ? load<uint16_t>(start.data() + 8) : load<uint32_t>(start.data() + 8);
  const size_t before = short_form ? 10 : 12;
  if (length > start.size() - before) return {};
  *begin = before + length;
  return start.substr(before, length);
}

}  // namespace

double NpyArray::at(size_t i) const {
  const char* value = bytes.data() + begin + i * size_t(word);
  if (word == 4) return double(load<float>(value));
  if (word == 8) return load<double>(value);
  if (word == 1) return double(load<uint8_t>(value));
  half h;
  h.setBits(load<uint16_t>(value));
  return double(float(h));
}

std::optional<NpyArray> NpzFile::describe(const std::string& name) const {
  const std::string member = name + ".npy";
  if (!zip_.has(member)) return {};
  NpyArray array;
  array.name = name;
  uint64_t size = 0;
  const std::string start = zip_.readStart(member, kMaxNpyHeaderBytes, &size);
  const std::string where = joinText(operation_, ": ", path(), ": ", name, ": ");
  const std::string_view header = headerOf(start, &array.begin);
  const std::string_view type = valueOf(header, "descr"), order = valueOf(header, "fortran_order"),
                         shape = valueOf(header, "shape");
  require(!type.empty() && !order.empty() && !shape.empty(), where, "expected an .npy array");
  if (type.substr(1, 2) == "|O" || type.substr(1, 1) == "O") return {};
  array.word = wordOf(type);
  require(array.word > 0, where,
          "expected float16, float32, float64 or uint8, little-endian, found ",
          type.substr(0, type.find(',')));
  require(order.substr(0, 5) == "False", where,
          "Fortran order is not supported (expected C order)");
  const auto dims = parseShape(shape);
  require(bool(dims), where, "expected a shape of at most 8 numbers, found ",
          shape.substr(0, shape.find(')') + 1));
  array.shape = *dims;
  uint64_t bytes = uint64_t(array.word);
  for (int64_t d : array.shape) {
    bytes *= uint64_t(d);
    require(bytes <= kMaxArrayBytes, where, "is too large (expected at most ", kMaxArrayBytes,
            " bytes)");
  }
  require(size == array.begin + bytes, where, "expected ", array.begin + bytes, " bytes, found ",
          size);
  return array;
}

std::optional<NpyArray> NpzFile::read(const std::string& name) const {
  std::optional<NpyArray> array = describe(name);
  if (array) array->bytes = zip_.read(name + ".npy", kMaxArrayBytes + kMaxNpyHeaderBytes);
  return array;
}

}  // namespace vdbc
