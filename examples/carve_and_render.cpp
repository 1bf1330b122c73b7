// The library without the networks: carve_and_render VIEWS PICTURE.png says how much of the place
// was seen, and renders what all views saw from where the first one was taken.
#include <cmath>
#include <cstdio>

#include "encoder/views/read_views.h"
#include "splat/image_files.h"
#include "splat/rasterize.h"
#include "vdb/carve.h"
#include "vdb/fit_volume.h"

int main(int argc, char** argv) try {
  using namespace vdbc;
  if (argc != 3) throw UsageError("usage: carve_and_render VIEWS PICTURE.png");
  const std::vector<View> views = readViews(argv[1]);
  std::vector<DepthView> depths;
  for (const View& view : views) depths.push_back(view.depthView());

  VolumeSettings volume;
  volume.up = conventionalUp(argv[1]);
  const CarveSettings carving;
  Progress silent;
  const VoxelFrame frame = fitVolume(depths, volume, carving);
  const SeenSpace space = carve(frame, depths, carving, silent);
  std::printf("%llu voxels filled, %llu seen empty\n",
              static_cast<unsigned long long>(space.filled.activeVoxelCount()),
              static_cast<unsigned long long>(space.empty.activeVoxelCount()));

  Gaussians pixels;  // a ball as wide as its pixel at every usable depth
  for (const View& view : views) {
    const Camera& camera = view.camera;
    const std::vector<float> depth = usableDepth(view.depthView(), carving);
    for (int y = 0; y < camera.height; ++y)
      for (int x = 0; x < camera.width; ++x) {
        const double z = depth[size_t(y) * size_t(camera.width) + size_t(x)];
        if (z == 0) continue;
        pixels.mean.push_back(camera.unproject(x + .5, y + .5, z).cast<float>());
        pixels.log_scale.push_back(Eigen::Vector3f::Constant(float(std::log(z / camera.fx))));
        pixels.rotation.push_back({1, 0, 0, 0});
        pixels.opacity_logit.push_back(4);
        for (int c = 0; c < 3; ++c) pixels.sh.push_back((view.colour.at(x, y, c) - .5f) / kSh0);
      }
  }
  writePng(rasterize(pixels, views[0].camera, {}).colour, argv[2]);
} catch (const std::exception& e) {
  std::fprintf(stderr, "%s\n", e.what());
  return 1;
}
