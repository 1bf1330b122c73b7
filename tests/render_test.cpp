// Laws of the room renderer, against closed forms and a brute-force path tracer.
#include <gtest/gtest.h>
#include <tbb/global_control.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "examples/rooms/rooms.h"
#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;

const Vector3f kX = Vector3f::UnitX(), kY = Vector3f::UnitY(), kZ = Vector3f::UnitZ();

int addMaterial(Room* room, const Vector3f& colour, float emission = 0) {
  Material m;
  m.colour_a = colour, m.emission = emission;
  room->surface.materials.push_back(m);
  return int(room->surface.materials.size()) - 1;
}

/// Parallelogram; uv 0-1 along u and v.
void addQuad(Room* room, const Vector3f& corner, const Vector3f& u, const Vector3f& v,
             int material) {
  SurfaceMesh& s = room->surface;
  const int first = int(s.mesh.vertices.size());
  for (const Vector3f& p :
       {corner, Vector3f(corner + u), Vector3f(corner + u + v), Vector3f(corner + v)})
    s.mesh.vertices.push_back(p);
  const Vector2f a(0, 0), b(1, 0), c(1, 1), d(0, 1);
  s.mesh.triangles.emplace_back(first, first + 1, first + 2);
  s.mesh.triangles.emplace_back(first, first + 2, first + 3);
  s.uv.push_back({a, b, c}), s.uv.push_back({a, c, d});
  for (int k = 0; k < 2; ++k) {
    s.material.push_back(material);
    s.normal.push_back({Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()});
  }
}

void addBox(Room* room, const Vector3f& low, const Vector3f& high, int material) {
  const Vector3f d = high - low, x = d.x() * kX, y = d.y() * kY, z = d.z() * kZ;
  addQuad(room, low, y, x, material), addQuad(room, low + z, x, y, material);
  addQuad(room, low, x, z, material), addQuad(room, low + y, z, x, material);
  addQuad(room, low, z, y, material), addQuad(room, low + x, y, z, material);
}

/// A closed box [0, size] of one material (index 0) without lights.
Room emptyBox(const Vector3f& size, const Vector3f& colour = Vector3f::Constant(.6f)) {
  Room room;
  room.name = "box";
  addMaterial(&room, colour);
  addBox(&room, Vector3f::Zero(), size, 0);
  room.floor = {{0, 0}, {size.x(), 0}, {size.x(), size.y()}, {0, size.y()}};
  room.ceilings = {{0, 0, size.z()}};
  return room;
}

RoomLight sphere(const Vector3f& centre, float radius, const Vector3f& radiance) {
  RoomLight light;
  light.centre = centre, light.radius_m = radius, light.radiance = radiance;
  return light;
}

RoomLight rectangle(const Vector3f& centre, const Vector3f& half_u, const Vector3f& half_v,
                    const Vector3f& radiance) {
  RoomLight light;
  light.centre = centre, light.half_u = half_u, light.half_v = half_v, light.radiance = radiance;
  return light;
}

/// At `eye` looking at `target`; focal length in heights of the picture.
Camera cameraAt(const Vector3d& eye, const Vector3d& target, int width, int height, double focal) {
  Camera c;
  c.width = width, c.height = height;
  c.fx = c.fy = focal * height, c.cx = width / 2., c.cy = height / 2.;
  const bool is_level = std::abs((target - eye).normalized().z()) <= .99;
  c.world_from_camera = lookAt(eye, target, is_level ? Vector3d::UnitZ() : Vector3d::UnitY());
  return c;
}

Vector3d mean(const Image& image) {
  Vector3d sum = Vector3d::Zero();
  for (size_t i = 0; i < image.data.size(); ++i) sum[int(i % 3)] += image.data[i];
  return sum / (double(image.data.size()) / 3);
}

/// A patch of radiance 1, millimetres above the point of the floor: pictures of it tell the
/// exposure.
void addProbe(Room* room, const Vector3f& at) {
  const int glow = addMaterial(room, Vector3f::Ones(), 1);
  addQuad(room, at + Vector3f(-.01f, -.01f, .003f), .02f * kX, .02f * kY, glow);
}
double exposure(const RoomRenderer& renderer, const Vector3d& probe) {
  const Camera c = cameraAt(probe + Vector3d(0, 0, .5), probe, 4, 4, 100);
  return mean(renderer.picture(c, 1, 1).radiance).x();
}

/// Radiance of the small surroundings of a point, looked at from `eye`, before exposure.
Vector3d radianceAt(const RoomRenderer& renderer, const Vector3d& eye, const Vector3d& point,
                    const Vector3d& probe, int samples = 64) {
  const Camera c = cameraAt(eye, point, 16, 16, 50);
  return mean(renderer.picture(c, samples, 1).radiance) / exposure(renderer, probe);
}

/// A room with a window with sun, a lamp, a block, a shelf at a wall and a sheet of glass.
Room smallRoom() {
  Room room = emptyBox({3, 4, 2.5f}, {.7f, .6f, .5f});
  const int pane = addMaterial(&room, {.8f, .9f, 1}, 4),
            block = addMaterial(&room, {.3f, .5f, .7f});
  const int glass = addMaterial(&room, {.7f, 1, .8f});
  room.surface.materials[size_t(glass)].opacity = .2f;
  addQuad(&room, {2.99f, 1.2f, .9f}, 1.2f * kZ, 1.4f * kY, pane);
  addBox(&room, {.4f, .5f, 0}, {1.2f, 1.4f, .8f}, block);
  addBox(&room, {0, 2.f, 1.2f}, {.3f, 3.4f, 1.25f}, block);
  addQuad(&room, {.8f, 1.8f, .5f}, 1.f * kX, 1.f * kY, glass);
  room.lights = {rectangle({2.99f, 1.9f, 1.5f}, .6f * kZ, .7f * kY, {3.2f, 3.6f, 4}),
                 sphere({.6f, 3.5f, 1.9f}, .08f, {40, 30, 20})};
  room.lights[0].bound_m = .002f;
  if (room.lights[0].half_u.cross(room.lights[0].half_v).x() > 0)
    std::swap(room.lights[0].half_u, room.lights[0].half_v);
  room.sun.towards = Vector3f(.7f, .1f, .6f).normalized();
  room.sun.irradiance = Vector3f(8, 7, 6);
  addProbe(&room, {2.6f, .3f, 0});
  return room;
}
const Vector3d kSmallRoomProbe(2.6, .3, .003);

std::vector<Camera> smallRoomCameras(int width, int height) {
  return {cameraAt({2.6, .5, 1.5}, {.8, 2.8, .8}, width, height, .8),
          cameraAt({.6, 3.4, 1.4}, {2.2, 1, .7}, width, height, .8),
          cameraAt({1.8, 3.6, 1.6}, {1, 1, .6}, width, height, .8)};
}

/// The plainest path tracer: every triangle is tried for every ray, one ray at a time, directions
/// uniform on the hemisphere, points of lights uniform on their area. Diffuse and glass only.
class BruteForce {
 public:
  explicit BruteForce(const Room& room) : room_(room) {}

  Vector3d radiance(Vector3d origin, Vector3d direction, uint64_t seed) const {
    std::mt19937_64 random(seed * 0x9e3779b97f4a7c15ull + 1);
    Vector3d throughput = Vector3d::Ones(), sum = Vector3d::Zero();
    bool is_eye = true;
    for (int depth = 0; depth < 200; ++depth) {
      const std::optional<Hit> hit = nearest(origin, direction);
      if (!hit) break;
      const Material& m = *hit->material;
      const Vector3d colour = m.colour_a.cast<double>();
      if (m.emission > 0) {
        if (is_eye) sum += m.emission * throughput.cwiseProduct(colour);
        break;
      }
      if (uniform(random) >= m.opacity) {
        throughput = throughput.cwiseProduct(tint(m)) / (1 - m.opacity);
        origin = hit->point + 1e-5 * direction;
        continue;
      }
      throughput = throughput.cwiseProduct(colour);
      sum += throughput.cwiseProduct(direct(*hit, random)) / M_PI;
      const double survive = std::min(.95, throughput.maxCoeff());
      if (uniform(random) >= survive) break;
      const Vector3d out = onHemisphere(hit->normal, random);
      throughput *= 2 * out.dot(hit->normal) / survive;
      origin = hit->point + 1e-5 * hit->normal, direction = out, is_eye = false;
    }
    return sum;
  }

 private:
  struct Hit {
    Vector3d point, normal;
    const Material* material;
    double t;
  };
  static Vector3d onSphere(std::mt19937_64& random) {
    const double z = 2 * uniform(random) - 1, a = 2 * M_PI * uniform(random),
                 r = std::sqrt(1 - z * z);
    return {r * std::cos(a), r * std::sin(a), z};
  }
  static Vector3d onHemisphere(const Vector3d& n, std::mt19937_64& random) {
    const Vector3d d = onSphere(random);
    return d.dot(n) < 0 ? Vector3d(-d) : d;
  }
  static Vector3d tint(const Material& m) {
    const Vector3d c = m.colour_a.cast<double>();
    return (1 - m.opacity) / c.maxCoeff() * c;
  }

  std::optional<Hit> nearest(const Vector3d& o, const Vector3d& d) const {
    const SurfaceMesh& s = room_.surface;
    std::optional<Hit> best;
    for (size_t i = 0; i < s.mesh.triangles.size(); ++i) {
      const Eigen::Vector3i& t = s.mesh.triangles[i];
      const Vector3d a = s.mesh.vertices[size_t(t[0])].cast<double>();
      const Vector3d p = s.mesh.vertices[size_t(t[1])].cast<double>() - a;
      const Vector3d q = s.mesh.vertices[size_t(t[2])].cast<double>() - a;
      const Vector3d n = p.cross(q);
      const double across = d.dot(n);
      if (across == 0) continue;
      const double at = (a - o).dot(n) / across;
      if (at <= 0 || (best && at >= best->t)) continue;
      const Vector3d x = o + at * d - a;
      const double u = x.cross(q).dot(n) / n.squaredNorm(), v = p.cross(x).dot(n) / n.squaredNorm();
      if (u < 0 || v < 0 || u + v > 1) continue;
      best = {o + at * d, n.normalized() * (across > 0 ? -1 : 1),
              &s.materials[size_t(s.material[i])], at};
    }
    return best;
  }

  /// Light that passes from p over a distance: 0 where something stands in between.
  Vector3d passed(Vector3d p, const Vector3d& d, double distance) const {
    Vector3d share = Vector3d::Ones();
    while (const std::optional<Hit> hit = nearest(p, d)) {
      if (hit->t >= distance) break;
      if (hit->material->opacity >= 1) return Vector3d::Zero();
      share = share.cwiseProduct(tint(*hit->material));
      p = hit->point + 1e-5 * d, distance -= hit->t + 1e-5;
    }
    return share;
  }

  Vector3d direct(const Hit& hit, std::mt19937_64& random) const {
    const Vector3d p = hit.point + 1e-5 * hit.normal;
    Vector3d sum = Vector3d::Zero();
    for (const RoomLight& l : room_.lights) {
      Vector3d q = l.centre.cast<double>(), n = l.half_u.cross(l.half_v).cast<double>();
      double area = 4 * n.norm();
      if (area > 0) {
        q += (2 * uniform(random) - 1) * l.half_u.cast<double>() +
             (2 * uniform(random) - 1) * l.half_v.cast<double>();
        n.normalize();
      } else {
        n = onSphere(random), q += l.radius_m * n, area = 4 * M_PI * l.radius_m * l.radius_m;
      }
      const Vector3d d = (q - p).normalized();
      const double distance = (q - p).norm(), here = d.dot(hit.normal), there = -d.dot(n);
      if (here <= 0 || there <= 0) continue;
      sum += here * there * area / (distance * distance) *
             l.radiance.cast<double>().cwiseProduct(passed(p, d, distance - l.bound_m));
    }
    const Vector3d s = room_.sun.towards.cast<double>();
    if (hit.normal.dot(s) > 0) sum += hit.normal.dot(s) * sunlight(p, s);
    return sum;
  }

  Vector3d sunlight(Vector3d p, const Vector3d& s) const {
    Vector3d share = room_.sun.irradiance.cast<double>();
    while (const std::optional<Hit> hit = nearest(p, s)) {
      if (hit->material->emission > 0) return share;
      if (hit->material->opacity >= kSolidOpacity) break;
      share = share.cwiseProduct(tint(*hit->material));
      p = hit->point + 1e-5 * s;
    }
    return Vector3d::Zero();
  }

  const Room& room_;
};

TEST(Render, DepthOfAnEmptyBoxIsTheClosedForm) {
  const Vector3f size(4, 3, 2.5f);
  const RoomRenderer renderer(emptyBox(size));
  for (const Vector3d& target : {Vector3d(3, 2, 1), Vector3d(.2, .3, 2.4), Vector3d(2, 3, .2)}) {
    const Camera c = cameraAt({1.3, 1.1, 1.4}, target, 50, 37, .7);
    const View view = renderer.renderDepth(c);
    EXPECT_EQ(view.depth, renderer.picture(c, 1, 1).view.depth);
    EXPECT_EQ(view.colour.data.size(), size_t(50 * 37 * 3));
    const Vector3d eye = c.world_from_camera.translation();
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        const Vector3d d = c.unproject(x + .5, y + .5, 1) - eye;  // planar: z of 1
        double t = 1e9;
        for (int a = 0; a < 3; ++a)
          t = std::min(t, ((d[a] > 0 ? double(size[a]) : 0.) - eye[a]) / d[a]);
        EXPECT_NEAR(view.depth[size_t(y) * size_t(c.width) + size_t(x)], t, 2e-5 * t);
      }
  }
}

TEST(Render, NormalsFaceTheCameraAndMaterialsAreThoseOfTheSurface) {
  const Room room = smallRoom();
  const RoomRenderer renderer(room);
  for (const Camera& c : smallRoomCameras(40, 30)) {
    const RoomPicture p = renderer.picture(c, 1, 1);
    const Vector3d eye = c.world_from_camera.translation();
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        const size_t i = size_t(y * c.width + x);
        const Vector3d n(p.normal.at(x, y, 0), p.normal.at(x, y, 1), p.normal.at(x, y, 2));
        EXPECT_NEAR(n.norm(), 1, 1e-5);
        EXPECT_LT(n.dot(c.unproject(x + .5, y + .5, 1) - eye), 0);
        ASSERT_TRUE(p.material[i] >= 0 && p.material[i] < int(room.surface.materials.size()));
        EXPECT_NE(p.material[i], 3);  // glass
      }
  }
}

TEST(Render, SameSeedSamePictureWhateverTheThreads) {
  const Room room = smallRoom();
  const RoomRenderer renderer(room);
  const Camera c = smallRoomCameras(50, 34)[0];
  const RoomPicture a = renderer.picture(c, 3, 5);
  std::vector<RoomPicture> again(3);
  {
    const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
    again[0] = RoomRenderer(room).picture(c, 3, 5);
  }
  {
    // Many pictures at a time that all wait for the light of a fresh renderer.
    const RoomRenderer fresh(room);
    tbb::parallel_for(1, 3, [&](int i) { again[size_t(i)] = fresh.picture(c, 3, 5); });
  }
  for (const RoomPicture& b : again) {
    EXPECT_EQ(a.radiance.data, b.radiance.data);
    EXPECT_EQ(a.view.colour.data, b.view.colour.data);
    EXPECT_EQ(a.view.depth, b.view.depth);
    EXPECT_EQ(a.normal.data, b.normal.data);
    EXPECT_EQ(a.material, b.material);
  }
  EXPECT_EQ(renderer.render(c, 3, 5).colour.data, a.view.colour.data);
  const RoomPicture other = renderer.picture(c, 3, 6);
  EXPECT_NE(a.radiance.data, other.radiance.data);
  EXPECT_EQ(a.view.depth, other.view.depth);  // of the pixel's centre, whatever the jitter
}

TEST(Render, SphereLightsAPlaneByTheClosedForm) {
  Room room = emptyBox({4, 4, 3}, Vector3f::Zero());
  room.surface.materials.push_back(Material());  // the floor: .6
  room.surface.material[0] = room.surface.material[1] = 1;
  const Vector3d lamp(2, 2, 1.5);
  room.lights = {sphere(lamp.cast<float>(), .2f, {10, 20, 30})};
  addProbe(&room, {.5f, .5f, 0});
  const RoomRenderer renderer(room);
  for (double x : {2., 2.8, 3.5}) {
    const Vector3d p(x, 1.6, 0), to = lamp - p;
    const double d = to.norm(), irradiance = M_PI * .04 * to.z() / (d * d * d);  // of radiance 1
    const Vector3d l = radianceAt(renderer, {3, 3, 1}, p, {.5, .5, .003});
    for (int c = 0; c < 3; ++c)
      EXPECT_NEAR(l[c], .6 / M_PI * irradiance * 10 * (c + 1), .005 * l[c]);
  }
}

TEST(Render, RectangleLightsAPlaneByTheClosedForm) {
  // Irradiance under the middle of a parallel rectangle at height h (Lambert): four corners.
  const auto corner = [](double a, double b) {
    const double p = std::sqrt(1 + a * a), q = std::sqrt(1 + b * b);
    return (a / p * std::atan(b / p) + b / q * std::atan(a / q)) / 2;
  };
  // Near and far: sampled by solid angle and by area.
  for (const float half : {.9f, .5f, .05f}) {
    Room room = emptyBox({4, 4, 3}, Vector3f::Zero());
    room.surface.materials.push_back(Material());
    room.surface.material[0] = room.surface.material[1] = 1;
    room.lights = {rectangle({2, 2, 1.2f}, half * kY, .5f * half * kX, Vector3f::Constant(5))};
    addProbe(&room, {.5f, .5f, 0});
    const Vector3d l = radianceAt(RoomRenderer(room), {3.5, 3.5, .8}, {2, 2, 0}, {.5, .5, .003});
    const double irradiance = 5 * 4 * corner(half / 1.2, .5 * half / 1.2);
    EXPECT_NEAR(l.x(), .6 / M_PI * irradiance, .006 * l.x()) << half;
    // It does not shine backwards.
    std::swap(room.lights[0].half_u, room.lights[0].half_v);
    EXPECT_EQ(radianceAt(RoomRenderer(room), {3.5, 3.5, .8}, {2, 2, 0}, {.5, .5, .003}).x(), 0);
  }
}

TEST(Render, LightOfAClosedBoxIsKept) {
  // What a lamp gives is absorbed: the mean irradiance is its power / (area * (1 - albedo)).
  const Vector3f size(3, 4, 2.5f);
  for (float albedo : {.3f, .6f, .8f}) {
    Room room = emptyBox(size, Vector3f::Constant(albedo));
    room.lights = {sphere({1.2f, 1.9f, 1.6f}, .1f, Vector3f::Constant(20))};
    addProbe(&room, {.2f, .2f, 0});
    const RoomRenderer renderer(room);
    const double exposed = exposure(renderer, {.2, .2, .003});
    const Vector3d eye(1.5, 2, 1.25);
    double area = 0, sum = 0;  // of the walls, by the solid angles of the pixels of six views
    for (int side = 0; side < 6; ++side) {
      const Vector3d forward = (side & 1 ? 1 : -1) * Vector3d::Unit(side / 2);
      const Camera c = cameraAt(eye, eye + forward, 48, 48, .5);
      const RoomPicture p = renderer.picture(c, 16, uint64_t(side));
      for (int y = 0; y < 48; ++y)
        for (int x = 0; x < 48; ++x) {
          const size_t i = size_t(y * 48 + x);
          const Vector3d d = c.unproject(x + .5, y + .5, 1) - eye;
          const Vector3d n(p.normal.at(x, y, 0), p.normal.at(x, y, 1), p.normal.at(x, y, 2));
          const double z = p.view.depth[i];
          const double da = z * z / (c.fx * c.fy) / std::abs(n.dot(d));
          area += da, sum += da * p.radiance.at(x, y, 1) / exposed * M_PI / albedo;
        }
    }
    const double walls = 2 * (3 * 4 + 3 * 2.5 + 4 * 2.5);
    EXPECT_NEAR(area, walls, .01 * walls);
    const double power = 20 * M_PI * 4 * M_PI * .01;
    EXPECT_NEAR(sum / area, power / (walls * (1 - albedo)), .02 * sum / area) << albedo;
  }
}

TEST(Render, EqualsBruteForce) {
  const Room room = smallRoom();
  const RoomRenderer renderer(room);
  const BruteForce truth(room);
  const double exposed = exposure(renderer, kSmallRoomProbe);
  constexpr int kWidth = 24, kHeight = 18, kPaths = 1200, kBlock = 6;
  for (const Camera& c : smallRoomCameras(kWidth, kHeight)) {
    const Image radiance = renderer.picture(c, 256, 3).radiance;
    Image expected(kWidth, kHeight, 3);
    tbb::parallel_for(0, kWidth * kHeight, [&](int i) {
      std::mt19937_64 random(uint64_t(i) + 17);
      const Vector3d eye = c.world_from_camera.translation();
      Vector3d sum = Vector3d::Zero();
      for (int k = 0; k < kPaths; ++k) {
        const double x = i % kWidth + uniform(random);
        const double y = i / kWidth + uniform(random);
        sum += truth.radiance(eye, (c.unproject(x, y, 1) - eye).normalized(), random());
      }
      for (int k = 0; k < 3; ++k)
        expected.data[size_t(i * 3 + k)] = float(sum[k] * exposed / kPaths);
    });
    const Vector3d a = mean(radiance), b = mean(expected);
    for (int k = 0; k < 3; ++k) EXPECT_NEAR(a[k] / b[k], 1, .02) << "channel " << k;
    for (int by = 0; by < kHeight; by += kBlock)
      for (int bx = 0; bx < kWidth; bx += kBlock) {
        double ours = 0, theirs = 0;
        for (int y = by; y < by + kBlock; ++y)
          for (int x = bx; x < bx + kBlock; ++x)
            ours += radiance.at(x, y, 1), theirs += expected.at(x, y, 1);
        EXPECT_NEAR(ours / theirs, 1, .08) << "block at " << bx << ", " << by;
      }
  }
}

TEST(Render, NoiseFallsWithSamplesTowardsItsOwnReference) {
  const RoomRenderer renderer(smallRoom());
  const Camera c = smallRoomCameras(48, 40)[1];
  const Image reference = renderer.render(c, 4096, 1).colour;
  double before = 0;
  for (int samples : {1, 4, 16, 64}) {
    const double now = psnr(renderer.render(c, samples, 2).colour, reference);
    EXPECT_GT(now, before + 3) << samples;  // 6 dB by theory, more by stratification
    before = now;
  }
  EXPECT_GT(before, 36);
  const double ratio = mean(renderer.picture(c, 16, 2).radiance).sum() /
                       mean(renderer.picture(c, 4096, 1).radiance).sum();
  EXPECT_NEAR(ratio, 1, .02);
}

TEST(Render, MirrorShowsWhatGlowsUnchanged) {
  // White furnace of the gloss: facets of a perfect mirror lose nothing, whatever is in front.
  Room room = emptyBox({3, 3, 3}, Vector3f::Ones());
  room.surface.materials[0].emission = 2;  // every wall glows
  const int mirror = addMaterial(&room, Vector3f::Zero());
  room.surface.materials[size_t(mirror)].specular = 1;
  room.surface.materials[size_t(mirror)].roughness = 0;
  addQuad(&room, {1, 1, 1}, kX, kY, mirror);
  addProbe(&room, {.3f, .3f, 0});
  const RoomRenderer renderer(room);
  const Vector3d l = radianceAt(renderer, {1.6, 1.7, 2.5}, {1.5, 1.5, 1}, {.3, .3, .003});
  EXPECT_NEAR(l.x(), 2, .002);
}

TEST(Render, LampIsBlockedByABoardButNotByGlassOrHoles) {
  const auto lit = [](auto change) {
    Room room = emptyBox({4, 4, 2.5f}, Vector3f::Zero());
    room.surface.materials.push_back(Material());
    room.surface.material[0] = room.surface.material[1] = 1;
    room.lights = {sphere({2, 2, 2}, .1f, Vector3f::Constant(30))};
    const int board = addMaterial(&room, {.2f, .5f, .5f});
    addQuad(&room, {1, 1, 1.5f}, 2 * kX, 2 * kY, board);
    change(&room.surface.materials[size_t(board)]);
    addProbe(&room, {.3f, .3f, 0});
    return radianceAt(RoomRenderer(room), {3.5, 3.5, 1}, {2, 2, 0}, {.3, .3, .003});
  };
  auto sheet = std::make_shared<Texture>();
  sheet->width = sheet->height = 2, sheet->has_alpha = true;
  sheet->rgba.assign(16, 255);
  for (size_t i = 3; i < 16; i += 4) sheet->rgba[i] = 0;
  const Vector3d open = lit([&](Material* m) { m->texture = sheet; });
  EXPECT_GT(open.x(), .01);
  EXPECT_LT(lit([](Material*) {}).x(), 1e-6 * open.x());
  const Vector3d tinted = lit([](Material* m) { m->opacity = .25f; });
  EXPECT_NEAR(tinted.x() / open.x(), .75 * .4, .01);  // tint: colour over its largest channel
  EXPECT_NEAR(tinted.y() / open.y(), .75, .02);
}

TEST(Render, DepthPassesGlassAndHoles) {
  Room room = emptyBox({4, 4, 2.5f});
  const int board = addMaterial(&room, Vector3f::Ones());
  addQuad(&room, {1, 1, 1.5f}, 2 * kX, 2 * kY, board);
  auto half = std::make_shared<Texture>();  // left half open
  half->width = 64, half->height = 1, half->has_alpha = true;
  half->rgba.assign(256, 255);
  for (size_t i = 0; i < 32; ++i) half->rgba[i * 4 + 3] = 0;
  const auto depthAt = [&](double x) {
    const Camera c = cameraAt({x, 2, 2.4}, {x, 2, 0}, 1, 1, 100);
    return RoomRenderer(room).renderDepth(c).depth[0];
  };
  EXPECT_NEAR(depthAt(2), .9, 1e-5);
  room.surface.materials[size_t(board)].opacity = kSolidOpacity - .01f;
  EXPECT_NEAR(depthAt(2), 2.4, 1e-5);
  room.surface.materials[size_t(board)].opacity = kSolidOpacity;
  EXPECT_NEAR(depthAt(2), .9, 1e-5);
  room.surface.materials[size_t(board)].texture = half;
  EXPECT_NEAR(depthAt(1.5), 2.4, 1e-5);
  EXPECT_NEAR(depthAt(2.5), .9, 1e-5);
}

TEST(Render, TexturesStandUprightAndAverageInLinearLight) {
  Room room = emptyBox({3, 3, 2.5f}, Vector3f::Zero());
  auto picture = std::make_shared<Texture>();  // rows top-down: red, then checks of black and white
  picture->width = picture->height = 64;
  for (int y = 0; y < 64; ++y)
    for (int x = 0; x < 64; ++x)
      for (int c = 0; c < 4; ++c)
        picture->rgba.push_back(y < 32 ? (c == 0 || c == 3 ? 255 : 0)
                                       : (c == 3 || (x + y) % 2 ? 255 : 0));
  const int image = addMaterial(&room, Vector3f::Ones(), 1);
  room.surface.materials[size_t(image)].texture = picture;
  addQuad(&room, {1.4f, .1f, 1.2f}, .2f * kX, .2f * kZ, image);  // u right, v up
  addProbe(&room, {.3f, .3f, 0});
  const RoomRenderer renderer(room);
  const auto seen = [&](double z) {
    const Camera c = cameraAt({1.5, 2.9, z}, {1.5, .1, z}, 2, 2, 60);  // one pixel: 2 cm
    return Vector3d(mean(renderer.picture(c, 64, 1).radiance) / exposure(renderer, {.3, .3, .003}));
  };
  EXPECT_NEAR((seen(1.35) - Vector3d(1, 0, 0)).norm(), 0, .01);
  EXPECT_NEAR((seen(1.25) - Vector3d(.5, .5, .5)).norm(), 0, .03);
}

TEST(Render, PointsOfOneViewReprojectIntoAnother) {
  const RoomRenderer renderer(smallRoom());
  const std::vector<Camera> two = smallRoomCameras(64, 64);
  int64_t common = 0;
  for (size_t i = 0; i + 1 < two.size(); ++i) {
    const View a = renderer.renderDepth(two[i]);
    const Camera& b = two[i + 1];
    const Vector3d eye = b.world_from_camera.translation();
    for (int y = 0; y < 64; ++y)
      for (int x = 0; x < 64; ++x) {
        const Vector3d p = a.camera.unproject(x + .5, y + .5, a.depth[size_t(y * 64 + x)]);
        const Vector3d q = b.project(p);
        if (q.z() <= .1 || q.x() < 0 || q.x() >= 64 || q.y() < 0 || q.y() >= 64) continue;
        // Either this point is seen, or something nearer hides it: along b's own ray to it, the
        // first hit is never beyond it.
        const float t = renderer.rayTarget().trace({eye.cast<float>()},
                                                   {(p - eye).normalized().cast<float>()})[0];
        EXPECT_LT(t, (p - eye).norm() + 2e-3);
        common += std::abs(t - (p - eye).norm()) < 2e-3;
      }
  }
  EXPECT_GT(common, 500);
}

TEST(Render, BrokenRoomsAreRefused) {
  const auto broken = [](auto change) {
    Room room = emptyBox({3, 3, 2.5f});
    change(&room);
    EXPECT_THROW(RoomRenderer{room}, Error);
  };
  broken([](Room* r) { r->surface.material.pop_back(); });
  broken([](Room* r) { r->surface.uv.pop_back(); });
  broken([](Room* r) { r->surface.normal.pop_back(); });
  broken([](Room* r) { r->surface.material[3] = 1; });
  broken([](Room* r) { r->surface.material[3] = -1; });
  broken([](Room* r) { r->surface.mesh.triangles[2][1] = 100000; });
  broken([](Room* r) { r->surface.mesh.vertices[5].y() = NAN; });
  broken([](Room* r) {
    auto texture = std::make_shared<Texture>();
    texture->width = texture->height = 3;
    r->surface.materials[0].texture = texture;
  });
  const RoomRenderer renderer(emptyBox({3, 3, 2.5f}));
  EXPECT_THROW(renderer.render(Camera(), 4, 1), Error);
  EXPECT_THROW(renderer.render(cameraAt({1, 1, 1}, {2, 2, 1}, 8, 8, 1), 0, 1), Error);
}

}  // namespace
}  // namespace vdbc
