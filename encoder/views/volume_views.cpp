// Views of a level set or fog volume: cameras in its free space, rays to its surface
// (docs/formats.md, Views).
#include <openvdb/math/BBox.h>
#include <openvdb/math/DDA.h>
#include <openvdb/math/Maps.h>
#include <openvdb/math/Ray.h>
#include <openvdb/tree/ValueAccessor.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <random>
#include <set>

#include "encoder/views/view_reading.h"
#include "vdb/fit_volume.h"
#include "vdb/uniform.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr uint64_t kMaxVolumeBytes = uint64_t(1) << 32;
constexpr uint64_t kMaxBlocks = uint64_t(1) << 20;  // of 8^3 voxels: 2 GiB of values
constexpr double kMinVoxelM = 1e-4, kMaxVoxelM = 100;
constexpr double kMaxShear = 1e-3;  // files by others keep transforms in float

constexpr int kViews = 12;
constexpr int kViewSide = 224;  // pixels
constexpr double kFieldOfView = 75 * M_PI / 180;
constexpr double kClearanceM = 0.3;  // of cameras from surfaces
constexpr int kAttempts = 8192, kMaxPlaces = 192;
constexpr int kScanRays = 1024;         // from each place, to see what it sees
constexpr int kLooks = 32;              // directions a camera may look in
constexpr double kSceneryPatches = 24;  // a patch's edge is the scene's diagonal over this
constexpr double kOpenShare = 0.5;  // a place that sees less than this share of what the best place
                                    // sees is not used: outside of a room, or beside a cut

/// What cannot be free space: a field whose sign tells inside from outside, and what is known of
/// it.
struct Volume {
  FloatGrid::Ptr field;
  bool is_level_set = false;
  double unit = 1;  // of field values: metres a voxel (level set), the value of the surface (fog)
  double voxel_m = 0;
  Eigen::Affine3d world_from_index, index_from_world;
  MaskTree::Ptr cells;    // ijk: the cube [ijk, ijk + 1] between samples, where the sign changes
  CoordBBox bounds;       // of the cells
  Vec3SGrid::Ptr colour;  // scene-linear, may be null
  Eigen::Affine3d colour_from_world;
  BoolGrid::Ptr seen_empty;  // may be null
  Eigen::Affine3d empty_from_world;
  Vector3d up;

  /// Positive in free space, negative in the solid; near the surface of a level set in voxels.
  double height(float value) const { return is_level_set ? value / unit : 1 - value / unit; }
};

/// The grid that says what is solid.
FloatGrid::Ptr geometryGrid(const openvdb::GridPtrVec& grids, const std::string& path) {
  const auto first = [&](const auto& fits) -> FloatGrid::Ptr {
    for (const auto& grid : grids)
      if (grid && grid->isType<FloatGrid>() && fits(*grid))
        return openvdb::gridPtrCast<FloatGrid>(grid);
    return nullptr;
  };
  FloatGrid::Ptr found =
      first([](const auto& g) { return g.getGridClass() == openvdb::GRID_LEVEL_SET; });
  if (!found) found = first([](const auto& g) { return g.getName() == "density"; });
  if (!found)
    found = first([](const auto& g) { return g.getGridClass() == openvdb::GRID_FOG_VOLUME; });
  std::set<std::string> types;
  for (const auto& grid : grids)
    if (grid) types.insert(grid->type());
  std::string listed;
  for (const std::string& type : types) listed += " " + type;
  require(bool(found), kReadViews, ": ", path,
          ": nothing to look at (expected a float grid that is a level set, ",
          "a fog volume or named density, found", listed.empty() ? " no grids" : listed, ")");
  require(!found->tree().empty(), kReadViews, ": ", path, ": its ",
          found->getGridClass() == openvdb::GRID_LEVEL_SET ? "level set" : "fog volume",
          " is empty");
  return found;
}

Eigen::Affine3d worldFromIndex(const openvdb::math::Transform& transform, const std::string& path) {
  require(transform.isLinear(), kReadViews, ": ", path, ": expected a linear transform, found a ",
          transform.mapType());
  // Not as an AffineMap, whose constructor throws an exception of its own on singular matrices.
  const openvdb::math::MapBase& map = *transform.baseMap();
  Eigen::Affine3d world_from_index = Eigen::Affine3d::Identity();
  const openvdb::Vec3d origin = map.applyMap(openvdb::Vec3d(0));
  for (int axis = 0; axis < 3; ++axis) {
    openvdb::Vec3d step(0);
    step[axis] = 1;
    step = map.applyJacobian(step);
    world_from_index.linear().col(axis) << step.x(), step.y(), step.z();
    world_from_index.translation()[axis] = origin[axis];
  }
  require(world_from_index.matrix().allFinite(), kReadViews, ": ", path,
          ": its transform is not finite");
  const Matrix3d& linear = world_from_index.linear();
  const double edge = std::cbrt(linear.determinant());
  require(edge >= kMinVoxelM && edge <= kMaxVoxelM, kReadViews, ": ", path, ": expected voxels of ",
          kMinVoxelM, " to ", kMaxVoxelM, " m that are not mirrored, found ", edge, " m");
  const Matrix3d r = linear / edge;
  const double shear = (r.transpose() * r - Matrix3d::Identity()).cwiseAbs().maxCoeff();
  require(shear <= kMaxShear, kReadViews, ": ", path, ": expected cubic voxels, found ",
          linear.col(0).norm(), " x ", linear.col(1).norm(), " x ", linear.col(2).norm(), " m");
  return world_from_index;
}

/// Half of the largest value.
double fogSurface(const FloatTree& tree, const std::string& path) {
  float most = 0;
  for (auto value = tree.cbeginValueOn(); value; ++value) most = std::max(most, *value);
  require(most > 0 && std::isfinite(most), kReadViews, ": ", path,
          ": expected a fog volume with positive, finite values, found at most ", most);
  return 0.5 * most;
}

/// Origins of the 8^3 blocks that hold leaves or active tiles, and of their lower neighbours: cells
/// between two blocks belong to the lower one. Sorted.
std::vector<Coord> blockOrigins(const FloatTree& tree, const std::string& path) {
  constexpr int kDim = int(FloatTree::LeafNodeType::DIM);
  CoordBBox extent;
  uint64_t blocks = 0;
  const auto count = [&](const CoordBBox& box) {
    extent.expand(box);
    blocks += box.volume() / (kDim * kDim * kDim);
    require(blocks <= kMaxBlocks, kReadViews, ": ", path, ": too large (expected at most ",
            kMaxBlocks, " blocks of 8 x 8 x 8 voxels)");
  };
  std::vector<CoordBBox> boxes;
  for (auto leaf = tree.cbeginLeaf(); leaf; ++leaf)
    boxes.push_back(leaf->getNodeBoundingBox()), count(boxes.back());
  auto tile = tree.cbeginValueOn();
  tile.setMaxDepth(FloatTree::ValueOnCIter::LEAF_DEPTH - 1);
  for (; tile; ++tile) {
    tile.getBoundingBox(boxes.emplace_back());
    count(boxes.back());
  }
  require(blocks > 0, kReadViews, ": ", path, ": its grid is empty");
  for (int axis = 0; axis < 3; ++axis)
    require(extent.min()[axis] >= -kMaxVolumeIndex && extent.max()[axis] <= kMaxVolumeIndex,
            kReadViews, ": ", path, ": expected voxels within ", kMaxVolumeIndex,
            " of the grid's origin, found ", extent);
  std::vector<Coord> origins;
  for (const CoordBBox& box : boxes)
    for (int x = box.min().x() - kDim; x <= box.max().x(); x += kDim)
      for (int y = box.min().y() - kDim; y <= box.max().y(); y += kDim)
        for (int z = box.min().z() - kDim; z <= box.max().z(); z += kDim)
          origins.emplace_back(x, y, z);
  std::sort(origins.begin(), origins.end());
  origins.erase(std::unique(origins.begin(), origins.end()), origins.end());
  return origins;
}

/// Sets `cells` and `bounds` from the field.
void findSurface(Volume* volume, const std::string& path) {
  using Leaf = MaskTree::LeafNodeType;
  constexpr int kSide = int(Leaf::DIM) + 1;
  const std::vector<Coord> origins = blockOrigins(volume->field->tree(), path);
  std::vector<Leaf*> leaves(origins.size(), nullptr);
  std::atomic<bool> finite{true};
  tbb::parallel_for(size_t(0), origins.size(), [&](size_t i) {
    const openvdb::tree::ValueAccessor<const FloatTree, false> values(volume->field->tree());
    std::array<uint8_t, kSide * kSide * kSide> solid;
    size_t k = 0;
    for (int x = 0; x < kSide; ++x)
      for (int y = 0; y < kSide; ++y)
        for (int z = 0; z < kSide; ++z, ++k) {
          const float value = values.getValue(origins[i].offsetBy(x, y, z));
          if (!std::isfinite(value)) finite = false;
          solid[k] = volume->height(value) < 0;
        }
    auto leaf = std::make_unique<Leaf>(origins[i], false, false);
    for (openvdb::Index offset = 0; offset < Leaf::SIZE; ++offset) {
      const Coord p = Leaf::offsetToLocalCoord(offset);
      int corners = 0;
      for (int c = 0; c < 8; ++c)
        corners += solid[size_t(((p.x() + (c >> 2)) * kSide + p.y() + (c >> 1 & 1)) * kSide +
                                p.z() + (c & 1))];
      if (corners > 0 && corners < 8) leaf->setValueOn(offset);
    }
    if (!leaf->isEmpty()) leaves[i] = leaf.release();
  });
  volume->cells = std::make_shared<MaskTree>();
  for (Leaf* leaf : leaves)
    if (leaf) volume->cells->addLeaf(leaf);
  require(finite, kReadViews, ": ", path, ": its grid has values that are not finite");
  require(volume->cells->evalActiveVoxelBoundingBox(volume->bounds), kReadViews, ": ", path,
          ": no surface (expected values at both sides of ",
          volume->is_level_set ? 0 : volume->unit, ")");
}

/// Where up is in the world of a volume: +Z of the grid in our own files, which are turned so; +Y
/// of Houdini's files; +Z of all others.
Vector3d upOf(const VdbFile& file, const FloatGrid& field,
              const Eigen::Affine3d& world_from_index) {
  if (field.getCreator() == "vdb_complete") return world_from_index.linear().col(2).normalized();
  const auto creator = file.metadata.getMetadata<openvdb::StringMetadata>("creator");
  const bool houdini = creator && creator->value().rfind("Houdini", 0) == 0;
  return houdini ? Vector3d::UnitY() : Vector3d::UnitZ();
}

/// What the file holds; the surface is still to be found.
Volume loadVolume(const std::string& path) {
  const VdbFile file = readVdb(kReadViews, path, kMaxVolumeBytes);
  Volume v;
  v.field = geometryGrid(file.grids, path);
  v.is_level_set = v.field->getGridClass() == openvdb::GRID_LEVEL_SET;
  v.world_from_index = worldFromIndex(v.field->transform(), path);
  v.index_from_world = v.world_from_index.inverse();
  v.voxel_m = std::cbrt(v.world_from_index.linear().determinant());
  v.unit = v.is_level_set ? v.voxel_m : fogSurface(v.field->tree(), path);
  v.up = upOf(file, *v.field, v.world_from_index);
  const auto has = [&](const char* name) {
    return std::any_of(file.grids.begin(), file.grids.end(),
                       [&](const auto& g) { return g && g->getName() == name; });
  };
  if (has("Cd")) {
    v.colour = findGrid<Vec3SGrid>(kReadViews, file.grids, "Cd", path);
    v.colour_from_world = worldFromIndex(v.colour->transform(), path).inverse();
    for (auto value = v.colour->tree().cbeginValueOn(); value; ++value)
      require(std::isfinite(value->lengthSqr()), kReadViews, ": ", path,
              ": its grid Cd has values that are not finite");
  }
  if (has("seen_empty")) {
    v.seen_empty = findGrid<BoolGrid>(kReadViews, file.grids, "seen_empty", path);
    v.empty_from_world = worldFromIndex(v.seen_empty->transform(), path).inverse();
  }
  return v;
}

openvdb::Vec3d vdbVector(const Vector3d& v) { return {v.x(), v.y(), v.z()}; }

/// Rays against a volume. Keeps its accessors' caches: one for each thread.
class RayCaster {
 public:
  explicit RayCaster(const Volume& volume)
      : volume_(volume),
        values_(volume.field->tree()),
        cells_(*volume.cells),
        box_(volume.bounds.min().asVec3d() - openvdb::Vec3d(1),
             volume.bounds.max().asVec3d() + openvdb::Vec3d(2)) {}

  /// How many times `direction` (world) from `origin`, in free space, the surface is met. 0 where
  /// the ray meets none, or enters the solid of a level set where that was cut: there is no
  /// surface.
  double cast(const Vector3d& origin, const Vector3d& direction) const {
    Ray ray(vdbVector(volume_.index_from_world * origin),
            vdbVector(volume_.index_from_world.linear() * direction), 0);
    if (!ray.clip(box_)) return 0;
    openvdb::math::DDA<Ray, MaskTree::LeafNodeType::LOG2DIM> blocks(ray);
    do {
      if (!cells_.probeConstLeaf(blocks.voxel())) continue;
      openvdb::math::DDA<Ray, 0> cell;
      cell.init(ray, blocks.time(), blocks.next());
      do {
        if (!cells_.isValueOn(cell.voxel())) continue;
        double t = 0;
        if (entersSolid(ray, cell.voxel(), cell.time(), cell.next(), &t)) return t;
      } while (cell.step());
    } while (blocks.step());
    return 0;
  }

  bool isFree(const Coord& ijk) const { return volume_.height(values_.getValue(ijk)) > 0; }

 private:
  using Ray = openvdb::math::Ray<double>;

  /// Whether the ray is in the solid at some time of [t0, t1], which it spends in `cell`; then `t`
  /// is what cast() returns. The field is trilinear between the samples.
  bool entersSolid(const Ray& ray, const Coord& cell, double t0, double t1, double* t) const {
    constexpr double kDeep = 1e-2;  // no rounding reaches that far behind the surface
    std::array<double, 8> corners;
    for (int c = 0; c < 8; ++c)
      corners[size_t(c)] =
          volume_.height(values_.getValue(cell.offsetBy(c >> 2, c >> 1 & 1, c & 1)));
    const auto height = [&](double time) {
      const openvdb::Vec3d p = ray(time) - cell.asVec3d();
      double sum = 0;
      for (int c = 0; c < 8; ++c)
        sum += corners[size_t(c)] * (c >> 2 ? p.x() : 1 - p.x()) *
               (c >> 1 & 1 ? p.y() : 1 - p.y()) * (c & 1 ? p.z() : 1 - p.z());
      return sum;
    };
    const double first = height(t0);
    if (first > 0 && height(t1) > 0) return false;
    *t = 0;
    if (first < -kDeep) return true;  // it came in where no cell has a sample of either sign
    for (int i = 0; i < 40 && first > 0; ++i) {
      const double middle = 0.5 * (t0 + t1);
      (height(middle) > 0 ? t0 : t1) = middle;
    }
    if (isMeasured(cell)) *t = t0;
    return true;
  }

  /// The band of a level set holds its surface; a change of sign that leaves the band is a cut.
  bool isMeasured(const Coord& cell) const {
    if (!volume_.is_level_set) return true;
    for (int c = 0; c < 8; ++c)
      if (!values_.isValueOn(cell.offsetBy(c >> 2, c >> 1 & 1, c & 1))) return false;
    return true;
  }

  const Volume& volume_;
  openvdb::tree::ValueAccessor<const FloatTree, false> values_;
  openvdb::tree::ValueAccessor<const MaskTree, false> cells_;
  openvdb::math::BBox<openvdb::Vec3d> box_;
};

/// Display sRGB of the colour voxel nearest to a point of the surface.
class ColourLookup {
 public:
  explicit ColourLookup(const Volume& volume) : volume_(volume) {
    if (!volume.colour) return;
    colours_ = std::make_unique<Accessor>(volume.colour->tree());
    // A surface lies up to a voxel of its own beside the coloured ones.
    const double voxel_m = 1 / std::cbrt(volume.colour_from_world.linear().determinant());
    reach_ = std::clamp(int(std::ceil(1.5 * volume.voxel_m / voxel_m)), 2, 6);
  }

  Eigen::Vector3f at(const Vector3d& p_world) const {
    constexpr float kGrey = 0.5f;  // without colour
    if (!colours_) return Eigen::Vector3f::Constant(kGrey);
    const Vector3d p = volume_.colour_from_world * p_world;
    if (!(p.cwiseAbs().maxCoeff() < kMaxVolumeIndex))
      return Eigen::Vector3f::Constant(kGrey);  // no such index
    const Coord centre = Coord::round(vdbVector(p));
    if (colours_->isValueOn(centre)) return display(centre);
    double best = std::numeric_limits<double>::max();
    Coord nearest;
    for (const Coord& ijk : CoordBBox(centre.offsetBy(-reach_), centre.offsetBy(reach_))) {
      if (!colours_->isValueOn(ijk)) continue;
      const double distance = (ijk.asVec3d() - vdbVector(p)).lengthSqr();
      if (distance < best) best = distance, nearest = ijk;
    }
    return best < std::numeric_limits<double>::max() ? display(nearest)
                                                     : Eigen::Vector3f::Constant(kGrey);
  }

 private:
  using Accessor = openvdb::tree::ValueAccessor<const Vec3STree, false>;

  Eigen::Vector3f display(const Coord& ijk) const {
    const openvdb::Vec3f linear = colours_->getValue(ijk);
    Eigen::Vector3f colour;
    for (int c = 0; c < 3; ++c) colour[c] = srgbFromLinear(std::clamp(linear[c], 0.f, 1.f));
    return colour;
  }

  const Volume& volume_;
  std::unique_ptr<Accessor> colours_;
  int reach_ = 0;  // voxels
};

/// Free places (world) at least kClearanceM from every cell of the surface, at random in its box.
std::vector<Vector3d> freePlaces(const Volume& volume) {
  const double clearance = kClearanceM / volume.voxel_m;  // voxels
  const int edge = std::max(1, int(clearance / 8));       // of blocks that stand for their cells
  const auto blockOf = [&](const Coord& ijk) {
    const auto floored = [&](int i) { return i >= 0 ? i / edge : -((edge - 1 - i) / edge); };
    return Coord(floored(ijk.x()), floored(ijk.y()), floored(ijk.z()));
  };
  MaskTree blocks;
  openvdb::tree::ValueAccessor<MaskTree, false> block(blocks);
  for (auto cell = volume.cells->cbeginValueOn(); cell; ++cell)
    block.setValueOn(blockOf(cell.getCoord()));
  const auto isClear = [&](const openvdb::Vec3d& p) {
    const Coord centre = blockOf(Coord::floor(p));
    const int reach = int(clearance / edge) + 1;
    for (const Coord& b : CoordBBox(centre.offsetBy(-reach), centre.offsetBy(reach))) {
      if (!block.isValueOn(b)) continue;
      double distance2 = 0;
      for (int axis = 0; axis < 3; ++axis) {
        const double low = double(b[axis]) * edge, high = low + edge;
        const double d = std::max({0., low - p[axis], p[axis] - high});
        distance2 += d * d;
      }
      if (distance2 < clearance * clearance) return false;
    }
    return true;
  };

  const RayCaster caster(volume);
  std::mt19937_64 random(0);
  std::vector<Vector3d> places;
  for (int i = 0; i < kAttempts && places.size() < kMaxPlaces; ++i) {
    openvdb::Vec3d p;
    for (int axis = 0; axis < 3; ++axis)
      p[axis] = volume.bounds.min()[axis] + uniform(random) * volume.bounds.dim()[axis];
    // Clear of the surface, all corners of the point's cell are at its side.
    if (!caster.isFree(Coord::floor(p)) || !isClear(p)) continue;
    const Vector3d world = volume.world_from_index * Vector3d(p.x(), p.y(), p.z());
    const Vector3d empty = volume.seen_empty ? volume.empty_from_world * world : world;
    if (volume.seen_empty && !volume.seen_empty->tree().isValueOn(Coord::round(vdbVector(empty))))
      continue;
    places.push_back(world);
  }
  return places;
}

/// Directions spread evenly over the sphere (Fibonacci's lattice).
std::vector<Vector3d> sphereDirections(int count) {
  const double turn = M_PI * (3 - std::sqrt(5.));
  std::vector<Vector3d> directions;
  for (int i = 0; i < count; ++i) {
    const double z = 1 - (2 * i + 1.) / count, r = std::sqrt(1 - z * z);
    directions.emplace_back(r * std::cos(turn * i), r * std::sin(turn * i), z);
  }
  return directions;
}

Camera cameraAt(const Vector3d& place, const Vector3d& look, const Vector3d& up) {
  Camera camera;
  camera.width = camera.height = kViewSide;
  camera.fx = camera.fy = 0.5 * kViewSide / std::tan(0.5 * kFieldOfView);
  camera.cx = camera.cy = 0.5 * kViewSide;
  camera.world_from_camera.linear() = lookAlong(look, up);
  camera.world_from_camera.translation() = place;
  return camera;
}

/// A camera and the patches of surface that it sees, sorted.
struct Candidate {
  Camera camera;
  std::vector<int> patches;
};

/// Cameras at all places that see enough, looking everywhere.
std::vector<Candidate> candidates(const Volume& volume, const std::vector<Vector3d>& places) {
  const std::vector<Vector3d> rays = sphereDirections(kScanRays), looks = sphereDirections(kLooks);
  const double patch_edge = std::max(1., volume.bounds.dim().asVec3d().length() / kSceneryPatches);
  constexpr int kNothing = std::numeric_limits<int>::max();
  std::vector<std::vector<Coord>> seen(places.size());  // patch of each ray, or kNothing
  std::vector<int> hits(places.size());
  tbb::parallel_for(size_t(0), places.size(), [&](size_t i) {
    const RayCaster caster(volume);
    for (const Vector3d& ray : rays) {
      const double t = caster.cast(places[i], ray);
      const Vector3d p = volume.index_from_world * (places[i] + t * ray) / patch_edge;
      seen[i].push_back(t > 0 ? Coord::floor(vdbVector(p)) : Coord(kNothing));
      hits[i] += t > 0;
    }
  });
  const int most = hits.empty() ? 0 : *std::max_element(hits.begin(), hits.end());

  std::vector<std::vector<size_t>> within(looks.size());  // rays inside the picture of each look
  for (size_t j = 0; j < looks.size(); ++j) {
    const Camera camera = cameraAt(Vector3d::Zero(), looks[j], volume.up);
    for (size_t r = 0; r < rays.size(); ++r) {
      const Vector3d p = camera.project(rays[r]);
      if (p.z() > 0 && p.x() >= 0 && p.x() <= kViewSide && p.y() >= 0 && p.y() <= kViewSide)
        within[j].push_back(r);
    }
  }
  std::map<Coord, int> numbers;
  std::vector<Candidate> all;
  for (size_t i = 0; i < places.size(); ++i) {
    if (hits[i] == 0 || hits[i] < kOpenShare * most) continue;
    for (size_t j = 0; j < looks.size(); ++j) {
      Candidate c{cameraAt(places[i], looks[j], volume.up), {}};
      for (size_t r : within[j])
        if (seen[i][r] != Coord(kNothing))
          c.patches.push_back(numbers.try_emplace(seen[i][r], int(numbers.size())).first->second);
      std::sort(c.patches.begin(), c.patches.end());
      c.patches.erase(std::unique(c.patches.begin(), c.patches.end()), c.patches.end());
      if (!c.patches.empty()) all.push_back(std::move(c));
    }
  }
  return all;
}

/// One after the other the camera that sees most of what the earlier ones did not.
std::vector<Camera> chooseCameras(const Volume& volume, const std::string& path) {
  constexpr double kSeenAgain = 0.25;  // what a patch is worth with each view that has it
  std::vector<Candidate> all = candidates(volume, freePlaces(volume));
  require(!all.empty(), kReadViews, ": ", path, ": no free place for a camera (expected room ",
          kClearanceM, " m from surfaces that can be seen, inside their box",
          volume.seen_empty ? " and seen_empty" : "", "; units are metres)");
  int last = 0;
  for (const Candidate& c : all) last = std::max(last, c.patches.back());
  std::vector<double> worth(size_t(last) + 1, 1);
  std::vector<Camera> chosen;
  while (chosen.size() < kViews && !all.empty()) {
    size_t best = 0;
    double most = 0;
    for (size_t i = 0; i < all.size(); ++i) {
      double gain = 0;
      for (int patch : all[i].patches) gain += worth[size_t(patch)];
      if (gain > most) most = gain, best = i;
    }
    for (int patch : all[best].patches) worth[size_t(patch)] *= kSeenAgain;
    chosen.push_back(all[best].camera);
    all.erase(all.begin() + std::ptrdiff_t(best));
  }
  return chosen;
}

void lookAround(const Volume& volume, View* view) {
  const RayCaster caster(volume);
  const ColourLookup colours(volume);
  const Camera& camera = view->camera;
  view->colour = Image(camera.width, camera.height, 3);
  view->depth.assign(size_t(camera.width) * size_t(camera.height), 0.f);
  const Vector3d origin = camera.world_from_camera.translation();
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const Vector3d direction = camera.unproject(x + 0.5, y + 0.5, 1) - origin;  // planar depth 1
      const double z = caster.cast(origin, direction);
      if (!(z > 0)) continue;
      view->depth[size_t(y) * size_t(camera.width) + size_t(x)] = float(z);
      const Eigen::Vector3f colour = colours.at(origin + z * direction);
      for (int c = 0; c < 3; ++c) view->colour.at(x, y, c) = colour[c];
    }
}

}  // namespace

std::vector<View> readVolumeViews(const std::string& path, const ReadViewsSettings& settings) {
  Volume volume = loadVolume(path);
  findSurface(&volume, path);
  const std::vector<Camera> cameras = chooseCameras(volume, path);
  return readAll(selectFrames(settings, cameras.size(), path), [&](size_t i) {
    View view;
    view.name = joinText("view ", i);
    view.camera = cameras[i];
    if (settings.cameras_only) return view;
    lookAround(volume, &view);
    requireDepth(view, path);
    return view;
  });
}

Eigen::Vector3d volumeUp(const std::string& path) { return loadVolume(path).up; }

}  // namespace vdbc
