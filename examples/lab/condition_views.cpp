#include "examples/lab/condition_views.h"

#include <algorithm>
#include <cmath>

#include "vdb/fit_volume.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Random = std::mt19937_64;

// The standard's normal distribution differs between libraries.
double normal(Random& random) {
  const double u = uniform(random, 1e-12, 1), v = uniform(random, 0, 1);
  return std::sqrt(-2 * std::log(u)) * std::cos(2 * M_PI * v);
}
// Drawn one after the other: the order of a constructor's arguments is the compiler's choice.
Vector3d uniforms(Random& random, const Vector3d& low, const Vector3d& high) {
  Vector3d v;
  for (int k = 0; k < 3; ++k) v[k] = uniform(random, low[k], high[k]);
  return v;
}
Vector3d normals(Random& random) {
  Vector3d v;
  for (int k = 0; k < 3; ++k) v[k] = normal(random);
  return v;
}

// A camera near `base`, in the same hand.
Camera neighbour(const Camera& base, Random& random) {
  const double yaw = uniform(random, -.6, .6), pitch = uniform(random, -.5, .1);
  Camera c = base;
  c.world_from_camera.linear() = Eigen::AngleAxisd(yaw, Vector3d::UnitZ()).toRotationMatrix() *
                                 base.world_from_camera.linear() *
                                 Eigen::AngleAxisd(pitch, Vector3d::UnitX()).toRotationMatrix();
  const Vector3d reach(.4, .4, .2);
  c.world_from_camera.translation() += uniforms(random, -reach, reach);
  return c;
}

bool isFreePlace(const Room& room, const Camera& camera) {
  constexpr float kMargin = .15f;  // metres
  const Eigen::Vector3f eye = camera.world_from_camera.translation().cast<float>();
  return isFree(room, room.world_from_room.inverse() * eye, kMargin);
}

// Bilinear colour at a place of the picture, pixel centres at whole numbers.
Eigen::Vector3f colourAt(const Image& image, double x, double y) {
  const int i = std::clamp(int(std::floor(x)), 0, image.width - 2),
            j = std::clamp(int(std::floor(y)), 0, image.height - 2);
  const float fx = float(std::clamp(x - i, 0., 1.)), fy = float(std::clamp(y - j, 0., 1.));
  const auto at = [&](int column, int row) {
    return Eigen::Map<const Eigen::Vector3f>(
        image.data.data() + 3 * (size_t(row) * size_t(image.width) + size_t(column)));
  };
  return (1 - fy) * ((1 - fx) * at(i, j) + fx * at(i + 1, j)) +
         fy * ((1 - fx) * at(i, j + 1) + fx * at(i + 1, j + 1));
}

// Pixels of the holes in a depth picture: ellipses, as of what is black or shiny.
std::vector<uint8_t> drawHoles(int width, int height, Random& random) {
  std::vector<uint8_t> hole(size_t(width) * size_t(height), 0);
  for (int n = int(uniform(random, 0, 14)); n > 0; --n) {
    const double x = uniform(random, 0, width), y = uniform(random, 0, height);
    const double a = width * uniform(random, .018, .18), b = width * uniform(random, .018, .18);
    for (int j = 0; j < height; ++j)
      for (int i = 0; i < width; ++i)
        if (std::pow((i - x) / a, 2) + std::pow((j - y) / b, 2) < 1)
          hole[size_t(j) * size_t(width) + size_t(i)] = 1;
  }
  return hole;
}

void addDepthFaults(View* view, Random& random) {
  const double far_m = uniform(random, 2.5, 7), near_m = uniform(random, .3, .6);
  const double noise = uniform(random, .3, 1.5);
  const std::vector<uint8_t> hole = drawHoles(view->camera.width, view->camera.height, random);
  for (size_t p = 0; p < view->depth.size(); ++p) {
    const double z = double(view->depth[p]);
    const bool measured = !hole[p] && z >= near_m && z <= far_m;
    const double deviation = noise * (.0012 + .0019 * (z - .4) * (z - .4));
    view->depth[p] = measured ? float(z + deviation * normal(random)) : 0.f;
  }
}

void addColourFaults(View* view, Random& random) {
  const double gain = uniform(random, .8, 1.2);
  const Vector3d tint = uniforms(random, Vector3d::Constant(.93), Vector3d::Constant(1.07));
  for (size_t k = 0; k < view->colour.data.size(); ++k) {
    float& c = view->colour.data[k];
    c = float(std::clamp(double(c) * gain * tint[int(k % 3)] + .01 * normal(random), 0., 1.));
  }
}

void addPoseError(View* view, Random& random) {
  const double angle = .25 * M_PI / 180 * normal(random);
  const Vector3d axis = normals(random).normalized();
  Eigen::Isometry3d& pose = view->camera.world_from_camera;
  pose.linear() = Eigen::AngleAxisd(angle, axis).toRotationMatrix() * pose.linear();
  pose.translation() += .005 * normals(random);
}

// The coordinate that a share of the values lies below.
double quantile(std::vector<double>* values, double share) {
  const auto at = values->begin() + std::ptrdiff_t(share * double(values->size() - 1));
  std::nth_element(values->begin(), at, values->end());
  return *at;
}

}  // namespace

std::vector<View> handHeldViews(const Room& room, const RoomRenderer& renderer, int side,
                                int samples, uint64_t seed, Random& random) {
  constexpr int kTries = 60;
  const Camera base = randomCameras(room, renderer.rayTarget(), 1, side, side, random)[0];
  std::vector<View> views = {renderer.render(base, samples, seed)};
  for (int tries = 0; int(views.size()) < kHandViews && tries < kTries; ++tries) {
    const Camera camera = neighbour(base, random);
    if (isFreePlace(room, camera))
      views.push_back(renderer.render(camera, samples, seed + views.size()));
  }
  return views;
}

View cropped(const View& view, double zoom, Random& random) {
  const int width = view.camera.width, height = view.camera.height;
  const int w = int(width / zoom), h = int(height / zoom);
  const int x0 = int(uniform(random, 0, width - w + 1)),
            y0 = int(uniform(random, 0, height - h + 1));
  View out = view;
  Camera window = view.camera;
  window.width = w, window.height = h, window.cx -= x0, window.cy -= y0;
  out.camera = resized(window, width, height);
  for (int j = 0; j < height; ++j)
    for (int i = 0; i < width; ++i) {
      const double x = x0 + (i + .5) * w / width - .5, y = y0 + (j + .5) * h / height - .5;
      const size_t pixel = size_t(j) * size_t(width) + size_t(i);
      Eigen::Map<Eigen::Vector3f>(out.colour.data.data() + 3 * pixel) = colourAt(view.colour, x, y);
      // Depth is not mixed: between two surfaces there is none.
      const size_t column = size_t(std::clamp(int(std::lround(x)), 0, width - 1)),
                   row = size_t(std::clamp(int(std::lround(y)), 0, height - 1));
      out.depth[pixel] = view.depth[row * size_t(width) + column];
    }
  return out;
}

void addSensorFaults(View* view, Random& random) {
  addDepthFaults(view, random);
  addColourFaults(view, random);
  addPoseError(view, random);
}

std::vector<View> conditionViews(int kind, const std::vector<View>& far,
                                 const std::vector<View>& hand, Random& random) {
  const auto spread = [&](int count) {
    std::vector<View> few;
    for (int i = 0; i < count; ++i) few.push_back(far[size_t(3 * kind + 5 * i) % far.size()]);
    return few;
  };
  const auto anyCrop = [&](double least, double most) {
    const View& view = far[size_t(random() % far.size())];
    return cropped(view, uniform(random, least, most), random);
  };
  std::vector<View> few;
  switch (kind) {
    case 0:
    case 1:
      few = spread(2);
      break;
    case 2:
      few = spread(1);
      if (random() % 2) few[0] = cropped(few[0], uniform(random, 1, 1.6), random);
      break;
    case 3:
      few = spread(int(3 + random() % 4));
      break;
    case 4:
      few = hand;
      break;
    case 5:
      few.assign(hand.begin(), hand.begin() + std::ptrdiff_t(std::min<size_t>(2, hand.size())));
      few.push_back(anyCrop(1, 1.7));
      break;
    default:
      for (uint64_t n = 1 + random() % 3; n > 0; --n) few.push_back(anyCrop(1.1, 1.9));
  }
  if (kind >= 4)
    for (View& view : few) addSensorFaults(&view, random);
  return few;
}

CoordBBox boundsOf(const std::vector<View>& views, const VoxelFrame& frame) {
  constexpr size_t kFewest = 100;  // points
  constexpr double kTrimmed = .005;
  std::array<std::vector<double>, 3> along;
  for (const View& view : views) {
    const std::vector<float> depth = usableDepth(view.depthView(), CarveSettings());
    for (int j = 0; j < view.camera.height; j += 2)
      for (int i = 0; i < view.camera.width; i += 2) {
        const float z = depth[size_t(j) * size_t(view.camera.width) + size_t(i)];
        if (!(z > 0)) continue;
        const Vector3d p = frame.toIndex(view.camera.unproject(i + .5, j + .5, double(z)));
        for (int axis = 0; axis < 3; ++axis) along[size_t(axis)].push_back(p[axis]);
      }
  }
  if (along[0].size() < kFewest) return CoordBBox();
  const VolumeSettings volume;
  CoordBBox box;
  for (int axis = 0; axis < 3; ++axis) {
    std::vector<double>& values = along[size_t(axis)];
    double first = quantile(&values, kTrimmed), last = quantile(&values, 1 - kTrimmed);
    for (const View& view : views) {
      const double eye = frame.toIndex(view.camera.world_from_camera.translation())[axis];
      first = std::min(first, eye), last = std::max(last, eye);
    }
    const double margin =
        double(axis < 2 ? volume.margin_m : volume.vertical_margin_m) / double(frame.voxel_m);
    box.min()[axis] = std::max(int(std::floor((first - margin) / 4)) * 4, frame.bounds.min()[axis]);
    box.max()[axis] =
        std::min(int(std::ceil((last + margin) / 4)) * 4 - 1, frame.bounds.max()[axis]);
  }
  return box;
}

}  // namespace vdbc
