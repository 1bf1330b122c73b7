#include "splat/exr.h"

// OpenEXR's headers include each other by bare name; its CMake target provides the folder.
#include <Iex.h>
#include <ImfChannelList.h>
#include <ImfCompression.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfIO.h>
#include <ImfInputPart.h>
#include <ImfMatrixAttribute.h>
#include <ImfMultiPartInputFile.h>
#include <ImfOutputFile.h>
#include <ImfPartType.h>

#include <Eigen/LU>
#include <algorithm>
#include <cstring>

#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

// No codec of OpenEXR packs a picture more tightly: where a header claims so, take no memory for
// it.
constexpr uint64_t kMaxPixelsPerByte = 2048;

class MemoryStream : public Imf::IStream {
 public:
  MemoryStream(const std::string& name, std::vector<uint8_t> bytes)
      : IStream(name.c_str()), bytes_(std::move(bytes)) {}

  bool read(char to[], int count) override {
    if (count < 0 || position_ > bytes_.size() || size_t(count) > bytes_.size() - position_)
      throw Iex::InputExc("Unexpected end of file.");
    std::memcpy(to, bytes_.data() + position_, size_t(count));
    position_ += size_t(count);
    return position_ < bytes_.size();
  }
  uint64_t tellg() override { return position_; }
  void seekg(uint64_t position) override { position_ = position; }
  uint64_t size() const { return bytes_.size(); }

 private:
  std::vector<uint8_t> bytes_;
  uint64_t position_ = 0;
};

int64_t widthOf(const Imath::Box2i& box) { return int64_t(box.max.x) - box.min.x + 1; }
int64_t heightOf(const Imath::Box2i& box) { return int64_t(box.max.y) - box.min.y + 1; }

bool isFlat(const Imf::Header& header) {
  return !header.hasType() || header.type() == Imf::SCANLINEIMAGE ||
         header.type() == Imf::TILEDIMAGE;
}

/// Axes x right, y up, z forward, in the world: OpenEXR's worldToCamera.
Eigen::Matrix4d axesFromWorld(const Camera& camera) {
  Eigen::Matrix4d axes_from_world = camera.world_from_camera.inverse().matrix();
  axes_from_world.row(1) *= -1;
  return axes_from_world;
}

/// NDC from (0, 0) upper left to (1, 1) lower right, z / w in [0, 1] between 1 cm and 1 km, w = z.
Eigen::Matrix4d ndcFromAxes(const Camera& camera) {
  constexpr double kNear = 0.01, kFar = 1000;
  Eigen::Matrix4d ndc_from_axes = Eigen::Matrix4d::Zero();
  ndc_from_axes(0, 0) = camera.fx / camera.width;
  ndc_from_axes(0, 2) = camera.cx / camera.width;
  ndc_from_axes(1, 1) = -camera.fy / camera.height;
  ndc_from_axes(1, 2) = camera.cy / camera.height;
  ndc_from_axes(2, 2) = kFar / (kFar - kNear);
  ndc_from_axes(2, 3) = -kFar * kNear / (kFar - kNear);
  ndc_from_axes(3, 2) = 1;
  return ndc_from_axes;
}

Imf::M44fAttribute rowMatrix(const Eigen::Matrix4d& m) {
  Imath::M44f result;
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c) result[r][c] = float(m(c, r));
  return Imf::M44fAttribute(result);
}

}  // namespace

struct ExrFile::Impl {
  const char* operation;
  std::string name;
  MemoryStream stream;
  std::unique_ptr<Imf::MultiPartInputFile> file;
  std::vector<std::vector<std::string>> channels;  // [parts]

  Impl(const char* o, const std::string& n, std::vector<uint8_t> bytes)
      : operation(o), name(n), stream(n, std::move(bytes)) {}

  /// What `read` returns; OpenEXR's own exceptions as Errors.
  template <typename Read>
  auto guarded(const Read& read) const {
    try {
      return read();
    } catch (const Error&) {
      throw;
    } catch (const std::exception& error) {
      std::string message = error.what();
      std::replace(message.begin(), message.end(), '\n', ' ');
      throw Error(joinText(operation, ": ", name, ": corrupt EXR: ", message));
    }
  }

  void requirePixels(const Imath::Box2i& window, const char* which) const {
    const int64_t w = widthOf(window), h = heightOf(window);
    require(w > 0 && h > 0 && uint64_t(w) <= kMaxImagePixels && uint64_t(h) <= kMaxImagePixels &&
                uint64_t(w) * uint64_t(h) <= kMaxImagePixels &&
                uint64_t(w) * uint64_t(h) / kMaxPixelsPerByte <= stream.size(),
            operation, ": ", name, ": ", which, " window of ", w, " x ", h, " pixels in ",
            stream.size(), " bytes (expected at most 2^28, and a file to match)");
  }
};

ExrFile::ExrFile(const char* operation, const std::string& name, std::vector<uint8_t> bytes)
    : impl_(std::make_unique<Impl>(operation, name, std::move(bytes))) {
  impl_->guarded([&] {
    impl_->file = std::make_unique<Imf::MultiPartInputFile>(impl_->stream);
    for (int part = 0; part < parts(); ++part) {
      const Imf::Header& header = impl_->file->header(part);
      std::vector<std::string>& names = impl_->channels.emplace_back();
      if (!isFlat(header)) continue;
      for (auto c = header.channels().begin(); c != header.channels().end(); ++c)
        names.emplace_back(c.name());
    }
  });
}

ExrFile::~ExrFile() = default;

int ExrFile::parts() const { return impl_->file->parts(); }

const std::vector<std::string>& ExrFile::channels(int part) const {
  return impl_->channels[size_t(part)];
}

bool ExrFile::hasChannel(int part, const std::string& channel) const {
  return std::binary_search(channels(part).begin(), channels(part).end(), channel);
}

bool ExrFile::sameWindow(int part, int other) const {
  return impl_->file->header(part).displayWindow() == impl_->file->header(other).displayWindow();
}

void ExrFile::size(int part, int* width, int* height) const {
  const Imath::Box2i& display = impl_->file->header(part).displayWindow();
  impl_->requirePixels(display, "display");
  *width = int(widthOf(display)), *height = int(heightOf(display));
}

Image ExrFile::read(int part, const std::vector<std::string>& channels, float outside) const {
  const Imf::Header& header = impl_->file->header(part);
  const Imath::Box2i data = header.dataWindow(), display = header.displayWindow();
  impl_->requirePixels(data, "data");
  int width = 0, height = 0;
  size(part, &width, &height);
  const size_t n = channels.size(), w = size_t(widthOf(data)), h = size_t(heightOf(data));
  std::vector<float> values(w * h * n, outside);
  impl_->guarded([&] {
    Imf::FrameBuffer buffer;
    for (size_t c = 0; c < n; ++c) {
      const Imf::Channel& channel = header.channels()[channels[c]];
      require(channel.xSampling == 1 && channel.ySampling == 1, impl_->operation, ": ", impl_->name,
              ": channel ", channels[c], " is subsampled (expected full resolution)");
      buffer.insert(channels[c], Imf::Slice::Make(Imf::FLOAT, values.data() + c, data,
                                                  n * sizeof(float), w * n * sizeof(float)));
    }
    Imf::InputPart input(*impl_->file, part);
    input.setFrameBuffer(buffer);
    input.readPixels(data.min.y, data.max.y);
  });

  Image image(width, height, int(n), outside);
  const int x0 = std::max(data.min.x, display.min.x), x1 = std::min(data.max.x, display.max.x);
  for (int y = std::max(data.min.y, display.min.y); y <= std::min(data.max.y, display.max.y); ++y) {
    if (x1 < x0) break;
    const size_t row = size_t(int64_t(y) - data.min.y), first = size_t(int64_t(x0) - data.min.x);
    std::copy_n(values.data() + (row * w + first) * n, size_t(int64_t(x1) - x0 + 1) * n,
                &image.at(int(int64_t(x0) - display.min.x), int(int64_t(y) - display.min.y), 0));
  }
  return image;
}

std::optional<Eigen::Matrix4d> ExrFile::matrix(const char* attribute) const {
  const auto transposed = [](const auto& rows) {
    Eigen::Matrix4d m;
    for (int r = 0; r < 4; ++r)
      for (int c = 0; c < 4; ++c) m(c, r) = double(rows[r][c]);
    return m;
  };
  for (int part = 0; part < parts(); ++part) {
    const Imf::Header& header = impl_->file->header(part);
    if (const auto* f = header.findTypedAttribute<Imf::M44fAttribute>(attribute))
      return transposed(f->value());
    if (const auto* d = header.findTypedAttribute<Imf::M44dAttribute>(attribute))
      return transposed(d->value());
  }
  return {};
}

void writeExr(const Camera& camera, const std::vector<ExrChannel>& channels,
              const std::string& path) {
  constexpr const char* kOperation = "writeExr";
  require(camera.width > 0 && camera.height > 0 && camera.fx > 0 && camera.fy > 0, kOperation, ": ",
          path, ": expected a camera with pixels, found ", camera.width, " x ", camera.height);
  const size_t w = size_t(camera.width), pixels = w * size_t(camera.height);

  Imf::Header header(camera.width, camera.height);
  header.compression() = Imf::ZIP_COMPRESSION;
  const Eigen::Matrix4d axes_from_world = axesFromWorld(camera);
  header.insert("worldToCamera", rowMatrix(axes_from_world));
  header.insert("worldToNDC", rowMatrix(ndcFromAxes(camera) * axes_from_world));
  Imf::FrameBuffer buffer;
  std::vector<std::vector<half>> halves;
  for (const ExrChannel& c : channels) {
    header.channels().insert(c.name, Imf::Channel(c.is_half ? Imf::HALF : Imf::FLOAT));
    if (!c.is_half) {
      const size_t stride = c.stride * sizeof(float);
      buffer.insert(c.name,
                    Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(const_cast<float*>(c.values)),
                               stride, stride * w));
      continue;
    }
    std::vector<half>& values = halves.emplace_back(pixels);
    for (size_t i = 0; i < pixels; ++i)
      values[i] = half(std::clamp(c.values[i * c.stride], -65504.f, 65504.f));
    buffer.insert(c.name, Imf::Slice(Imf::HALF, reinterpret_cast<char*>(values.data()),
                                     sizeof(half), sizeof(half) * w));
  }
  TemporaryFile temporary(kOperation, path);
  try {
    Imf::OutputFile file(temporary.path().c_str(), header);
    file.setFrameBuffer(buffer);
    file.writePixels(camera.height);
  } catch (const std::exception& error) {
    throw Error(joinText(kOperation, ": ", path, ": cannot write: ", error.what()));
  }
  temporary.commit();
}

}  // namespace vdbc
