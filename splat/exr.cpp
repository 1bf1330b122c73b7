#include "splat/exr.h"

// OpenEXR's headers include each other by bare name; its CMake target provides the folder.
#include <ImfChannelList.h>
#include <ImfCompression.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfMatrixAttribute.h>
#include <ImfOutputFile.h>

#include <Eigen/LU>
#include <algorithm>

#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {

void writeExr(const Camera& camera, const std::vector<ExrChannel>& channels,
              const std::string& path) {
  constexpr const char* kOperation = "writeExr";
  require(camera.width > 0 && camera.height > 0 && camera.fx > 0 && camera.fy > 0, kOperation, ": ",
          path, ": expected a camera with pixels, found ", camera.width, " x ", camera.height);
  const size_t w = size_t(camera.width), pixels = w * size_t(camera.height);

  // Axes x right, y up, z forward; NDC from (0, 0) upper left to (1, 1) lower right, z / w in [0,
  // 1] between 1 cm and 1 km, w = z.
  Eigen::Matrix4d axes_from_world = camera.world_from_camera.inverse().matrix();
  axes_from_world.row(1) *= -1;
  constexpr double kNear = 0.01, kFar = 1000;
  Eigen::Matrix4d ndc_from_axes = Eigen::Matrix4d::Zero();
  ndc_from_axes(0, 0) = camera.fx / camera.width;
  ndc_from_axes(0, 2) = camera.cx / camera.width;
  ndc_from_axes(1, 1) = -camera.fy / camera.height;
  ndc_from_axes(1, 2) = camera.cy / camera.height;
  ndc_from_axes(2, 2) = kFar / (kFar - kNear);
  ndc_from_axes(2, 3) = -kFar * kNear / (kFar - kNear);
  ndc_from_axes(3, 2) = 1;
  const Eigen::Matrix4d ndc_from_world = ndc_from_axes * axes_from_world;
  const auto rowMatrix = [](const Eigen::Matrix4d& m) {
    Imath::M44f result;
    for (int r = 0; r < 4; ++r)
      for (int c = 0; c < 4; ++c) result[r][c] = float(m(c, r));
    return result;
  };

  Imf::Header header(camera.width, camera.height);
  header.compression() = Imf::ZIP_COMPRESSION;
  header.insert("worldToCamera", Imf::M44fAttribute(rowMatrix(axes_from_world)));
  header.insert("worldToNDC", Imf::M44fAttribute(rowMatrix(ndc_from_world)));
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
