#include "vdb/fuse.h"

#include <openvdb/Metadata.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "vdb/continuation.h"
#include "vdb/error.h"
#include "vdb/median.h"
#include "vdb/narrow_band.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Leaf = FloatTree::LeafNodeType;

constexpr double kPixelsAVoxel = 8, kSigmasAVoxel = 4;
constexpr double kFinest = .01, kCoarsest = .05;  // metres
constexpr int kCell = 4;                          // pixels over whose means slopes are taken
constexpr double kSameSurface = .03;              // of 1/z: neighbours within are one surface
constexpr double kLeastRayCosine = .1;
// Voxels: a measured surface goes on so far beyond its border, and from there on bends to the solid
// ones' boundary; so far before it must be open; so far beyond solid voxels it may go.
constexpr float kHold = .5f, kEnd = 2.5f, kFill = .25f;
constexpr double kLook = 1.5;
constexpr float kSmallest = .1f;  // metres: smaller parts that nobody measured are none

// Round distances make small files, and those most whose last bits are 0.
float stepOf(float band) {
  int exponent = 0;
  std::frexp(band, &exponent);
  return std::ldexp(1.f, exponent - 6);  // a 32nd to a 64th of the band
}
float roundedTo(float step, float distance) { return std::round(distance / step) * step; }

// --- what a view measured -----------------------------------------------------------------------

struct FuseView {
  Camera camera;
  Eigen::Isometry3d camera_from_grid;  // metres
  std::vector<float> q;                // [H * W] 1/z, metres^-1; 0 where there is none
  std::vector<float> cosine;  // [H / kCell, W / kCell] of ray and normal; 0 where there is none
  int cells_x = 0, cells_y = 0;
  double noise = 0;  // sigma of 1/z

  float at(int x, int y) const { return q[size_t(y) * size_t(camera.width) + size_t(x)]; }
};

// Mean 1/z of each cell of kCell^2 pixels; 0 where there is none.
std::vector<float> cellMeans(const FuseView& v) {
  std::vector<float> means(size_t(v.cells_x) * size_t(v.cells_y), 0.f);
  for (int cy = 0; cy < v.cells_y; ++cy)
    for (int cx = 0; cx < v.cells_x; ++cx) {
      float sum = 0;
      int n = 0;
      for (int y = cy * kCell; y < (cy + 1) * kCell; ++y)
        for (int x = cx * kCell; x < (cx + 1) * kCell; ++x)
          if (v.at(x, y) > 0) sum += v.at(x, y), ++n;
      if (n > 0) means[size_t(cy) * size_t(v.cells_x) + size_t(cx)] = sum / float(n);
    }
  return means;
}

// The slope of 1/z a pixel between a cell and its neighbours (0: none there): across an edge of
// depth only the neighbour of the same surface counts. Not a number without any.
double slopeOf(double before, double here, double after) {
  const double low = before > 0 ? here - before : NAN, high = after > 0 ? after - here : NAN;
  if (std::isnan(low)) return high / kCell;
  if (std::isnan(high)) return low / kCell;
  const bool smooth = std::abs(high - low) < kSameSurface * here;
  return (smooth ? (low + high) / 2 : std::abs(low) < std::abs(high) ? low : high) / kCell;
}

// 1/z is affine on a plane, n . (x, y, 1): its slopes give the normal.
void findCosines(FuseView* v) {
  const std::vector<float> means = cellMeans(*v);
  v->cosine.assign(means.size(), 0.f);
  const Camera& c = v->camera;
  const auto at = [&](int x, int y) {
    if (x < 0 || y < 0 || x >= v->cells_x || y >= v->cells_y) return 0.;
    return double(means[size_t(y) * size_t(v->cells_x) + size_t(x)]);
  };
  for (int y = 0; y < v->cells_y; ++y)
    for (int x = 0; x < v->cells_x; ++x) {
      const double q = at(x, y);
      if (!(q > 0)) continue;
      const double nx = slopeOf(at(x - 1, y), q, at(x + 1, y)) * c.fx,
                   ny = slopeOf(at(x, y - 1), q, at(x, y + 1)) * c.fy;
      if (std::isnan(nx) || std::isnan(ny)) continue;
      const double rx = ((x + .5) * kCell - c.cx) / c.fx, ry = ((y + .5) * kCell - c.cy) / c.fy;
      const double nz = q - nx * rx - ny * ry;
      const double length = std::sqrt((nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1));
      v->cosine[size_t(y) * size_t(v->cells_x) + size_t(x)] =
          float(std::clamp(q / length, kLeastRayCosine, 1.));
    }
}

// Second differences of 1/z vanish on planes: sigma from their median, along rows.
double noiseOf(const FuseView& v) {
  std::vector<double> second;
  for (int y = 0; y < v.camera.height; y += 2)
    for (int x = 1; x + 1 < v.camera.width; x += 2)
      if (v.at(x - 1, y) > 0 && v.at(x, y) > 0 && v.at(x + 1, y) > 0)
        second.push_back(
            std::abs(double(v.at(x - 1, y)) - 2 * double(v.at(x, y)) + double(v.at(x + 1, y))));
  return second.empty() ? 0 : median(&second) / (.6745 * std::sqrt(6.));
}

FuseView fuseView(const DepthView& view, const VoxelFrame& frame, const CarveSettings& carving) {
  FuseView v;
  v.camera = view.camera;
  const Camera local = cameraFrom(frame.world_from_grid.translation(), view.camera);
  Eigen::Isometry3d origin_from_grid = Eigen::Isometry3d::Identity();
  origin_from_grid.linear() = frame.world_from_grid.linear();
  v.camera_from_grid = local.world_from_camera.inverse() * origin_from_grid;
  v.q = usableDepth(view, carving);
  for (float& q : v.q) q = q > 0 ? 1 / q : 0;
  v.cells_x = view.camera.width / kCell, v.cells_y = view.camera.height / kCell;
  v.noise = noiseOf(v);
  findCosines(&v);
  return v;
}

// Whole parts of a voxel along its edge.
int partsOf(const VoxelFrame& frame, const std::vector<FuseView>& views, float given) {
  double edge = double(given);
  if (given == 0) {
    std::vector<double> edges;
    for (const FuseView& v : views)
      for (size_t i = 0; i < v.q.size(); i += 7)
        if (v.q[i] > 0) {
          const double z = 1 / double(v.q[i]);
          edges.push_back(
              std::max(kPixelsAVoxel * z / v.camera.fx, kSigmasAVoxel * v.noise * z * z));
        }
    require(!edges.empty(), "fuseDepth: expected a view with a usable depth, found none");
    edge = std::clamp(median(&edges), kFinest, kCoarsest);
  }
  require(std::isfinite(edge) && edge > 0 && edge <= double(frame.voxel_m) * 1.0001,
          "fuseDepth: expected detail voxels of at most ", frame.voxel_m, " m, found ", edge);
  const int parts = int(std::ceil(double(frame.voxel_m) / edge - 1e-3));
  require(parts <= 64, "fuseDepth: expected detail voxels of at least a 64th of a voxel, found ",
          edge, " m");
  return parts;
}

VoxelFrame detailFrame(const VoxelFrame& frame, int parts) {
  VoxelFrame detail = frame;
  detail.voxel_m = frame.voxel_m / float(parts);
  detail.bounds = CoordBBox(
      Coord(frame.bounds.min().x() * parts, frame.bounds.min().y() * parts,
            frame.bounds.min().z() * parts),
      Coord(frame.bounds.max().x() * parts + parts - 1, frame.bounds.max().y() * parts + parts - 1,
            frame.bounds.max().z() * parts + parts - 1));
  return detail;
}

// Leaves of the detail grid that touch the voxels, grown by so many detail voxels; in order.
std::vector<Coord> leavesOver(const std::vector<Coord>& voxels, int parts, int grown) {
  std::vector<Coord> origins;
  for (const Coord& ijk : voxels) {
    const Coord low(ijk.x() * parts - grown, ijk.y() * parts - grown, ijk.z() * parts - grown);
    const Coord high = low.offsetBy(parts - 1 + 2 * grown);
    const int mask = ~int(Leaf::DIM - 1), step = int(Leaf::DIM);
    for (int x = low.x() & mask; x <= high.x(); x += step)
      for (int y = low.y() & mask; y <= high.y(); y += step)
        for (int z = low.z() & mask; z <= high.z(); z += step) origins.emplace_back(x, y, z);
  }
  std::sort(origins.begin(), origins.end());
  origins.erase(std::unique(origins.begin(), origins.end()), origins.end());
  return origins;
}

// --- voxels -------------------------------------------------------------------------------------

// Measured 1/z at a pixel position: between four pixels of one surface, else of the nearest.
float measuredAt(const FuseView& v, double u, double w) {
  const int nx = int(u), ny = int(w);
  const float nearest = v.at(nx, ny);
  const int x = int(std::floor(u - .5)), y = int(std::floor(w - .5));
  if (!(nearest > 0) || x < 0 || y < 0 || x + 1 >= v.camera.width || y + 1 >= v.camera.height)
    return nearest;
  const float a = v.at(x, y), b = v.at(x + 1, y), c = v.at(x, y + 1), d = v.at(x + 1, y + 1);
  const float low = std::min({a, b, c, d}), high = std::max({a, b, c, d});
  if (!(low > 0) || high - low > float(kSameSurface) * high + 6 * float(v.noise)) return nearest;
  const auto fx = float(u - .5 - x), fy = float(w - .5 - y);
  return (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy;
}

// What views say of a point: the surface is near, or it is free.
struct Evidence {
  float sum = 0, near = 0, free = 0;  // of weighted distances; weights

  bool any() const { return near > 0 || free > 0; }
  // Free space that a flat view of a surface nearby passes through tells nothing of that surface;
  // where others look through what some say is behind one, nothing is there.
  float distance(float band) const {
    if (!(near > 0)) return band;
    if (sum < 0 && free > near) return (sum + band * free) / (near + free);
    return sum / near;
  }
};

// What a view says of a point in camera axes.
void addDistance(const FuseView& v, const Vector3d& p, double band, Evidence* e) {
  const double u = v.camera.fx * p.x() / p.z() + v.camera.cx,
               w = v.camera.fy * p.y() / p.z() + v.camera.cy;
  if (v.camera.pixelAt({u, w, p.z()}) < 0) return;
  const float q = measuredAt(v, u, w);
  if (!(q > 0)) return;
  const double z = 1 / double(q);
  const int cx = std::min(int(u) / kCell, v.cells_x - 1),
            cy = std::min(int(w) / kCell, v.cells_y - 1);
  if (cx < 0 || cy < 0) return;
  const double known = double(v.cosine[size_t(cy) * size_t(v.cells_x) + size_t(cx)]);
  const double cosine = known > 0 ? known : 1;
  const double distance = (z - p.z()) * p.norm() / p.z() * cosine;
  if (distance < -band) return;  // hidden
  if (distance > band) {
    e->free += float(1 / (p.z() * p.z()));
    return;
  }
  const auto weight = float(std::pow(known > 0 ? known : kLeastRayCosine, 4) / (z * z));
  e->sum += weight * float(distance), e->near += weight;
}

// Whether a leaf's ball may fall into the view.
bool mayShow(const FuseView& v, const Vector3d& centre, double radius) {
  if (centre.z() < -radius) return false;
  if (centre.z() <= radius) return true;
  const double z = centre.z() - radius;
  const double u = v.camera.fx * centre.x() / centre.z() + v.camera.cx,
               w = v.camera.fy * centre.y() / centre.z() + v.camera.cy;
  const double reach = 2 * std::max(v.camera.fx, v.camera.fy) * radius / z;
  return u > -reach && w > -reach && u < v.camera.width + reach && w < v.camera.height + reach;
}

Leaf* fuseLeaf(const VoxelFrame& detail, const Coord& origin, const std::vector<FuseView>& views) {
  const double band = kDetailBand * double(detail.voxel_m);
  const double radius = .5 * std::sqrt(3.) * Leaf::DIM * double(detail.voxel_m);
  std::array<Evidence, Leaf::SIZE> voxels{};
  bool any = false;
  for (const FuseView& v : views) {
    const auto place = [&](double x, double y, double z) -> Vector3d {
      return v.camera_from_grid *
             (Vector3d(origin.x() + x, origin.y() + y, origin.z() + z) * double(detail.voxel_m));
    };
    if (!mayShow(v, place(4, 4, 4), radius)) continue;
    any = true;
    const Vector3d first = place(.5, .5, .5);
    const Eigen::Matrix3d step = v.camera_from_grid.linear() * double(detail.voxel_m);
    for (openvdb::Index n = 0; n < Leaf::SIZE; ++n) {
      const Coord c = Leaf::offsetToLocalCoord(n);
      addDistance(v, first + step * Vector3d(c.x(), c.y(), c.z()), band, &voxels[n]);
    }
  }
  if (!any) return nullptr;
  auto* leaf = new Leaf(origin, float(band), false);
  const float step = stepOf(float(band));
  for (openvdb::Index n = 0; n < Leaf::SIZE; ++n)
    if (voxels[n].any()) leaf->setValueOn(n, roundedTo(step, voxels[n].distance(float(band))));
  if (leaf->isEmpty()) {
    delete leaf;
    return nullptr;
  }
  return leaf;
}

FloatGrid::Ptr gridOf(const std::vector<Leaf*>& leaves, const VoxelFrame& detail) {
  auto grid = FloatGrid::create(float(kDetailBand) * detail.voxel_m);
  for (Leaf* leaf : leaves)
    if (leaf) grid->tree().addLeaf(leaf);
  grid->setTransform(fileTransform(detail));
  return grid;
}

// --- the closed surface -------------------------------------------------------------------------

// Signed distance to the boundary of the solid voxels, metres, as trilinear between voxel centres
// as it is there: -1/2 voxel inside, 1/2 outside, which rounds the steps off.
class SmoothSolid {
 public:
  SmoothSolid(const std::vector<Coord>& solid, double voxel_m) : voxel_m_(voxel_m) {
    openvdb::tree::ValueAccessor<MaskTree, false> cells(mask_);
    for (const Coord& ijk : solid) cells.setValueOn(ijk);
  }

  // One a thread.
  class Lookup {
   public:
    explicit Lookup(const SmoothSolid& s) : cells_(s.mask_), voxel_m_(s.voxel_m_) {}
    // `p` in voxels, corner-based.
    float distance(const Vector3d& p) {
      const Vector3d low = (p.array() - .5).floor();
      const Vector3d f = p.array() - .5 - low.array();
      look(Coord(int(low.x()), int(low.y()), int(low.z())));
      double share = 0;
      for (size_t k = 0; k < 8; ++k)
        if (solid_[k])
          share += (k & 1 ? f.x() : 1 - f.x()) * (k >> 1 & 1 ? f.y() : 1 - f.y()) *
                   (k >> 2 ? f.z() : 1 - f.z());
      return float((.5 - share) * voxel_m_);
    }

   private:
    // Neighbouring places mostly lie between the same voxels.
    void look(const Coord& low) {
      if (low == low_) return;
      low_ = low;
      for (int k = 0; k < 8; ++k)
        solid_[size_t(k)] = cells_.isValueOn(low.offsetBy(k & 1, k >> 1 & 1, k >> 2));
    }

    openvdb::tree::ValueAccessor<const MaskTree, false> cells_;
    double voxel_m_;
    Coord low_ = Coord::max();
    std::array<bool, 8> solid_{};
  };

 private:
  MaskTree mask_;
  double voxel_m_;
};

}  // namespace

FloatGrid::Ptr fuseDepth(const VoxelFrame& frame, const SeenSpace& seen,
                         const std::vector<DepthView>& views, const FuseSettings& settings) {
  std::vector<FuseView> fuse_views(views.size());
  tbb::parallel_for(size_t(0), views.size(),
                    [&](size_t i) { fuse_views[i] = fuseView(views[i], frame, settings.carving); });
  const int parts = partsOf(frame, fuse_views, settings.voxel_m);
  const VoxelFrame detail = detailFrame(frame, parts);
  const std::vector<Coord> origins = leavesOver(filledNodes(seen), parts, kDetailBand);
  std::vector<Leaf*> leaves(origins.size(), nullptr);
  tbb::parallel_for(size_t(0), origins.size(),
                    [&](size_t i) { leaves[i] = fuseLeaf(detail, origins[i], fuse_views); });
  return gridOf(leaves, detail);
}

int detailPartsOf(const VoxelFrame& frame, const openvdb::GridBase& fused) {
  const double parts = double(frame.voxel_m) / fused.voxelSize()[0];
  const int whole = int(std::lround(parts));
  require(whole >= 1 && whole <= 64 && std::abs(parts - whole) < 1e-3,
          "closedSurface: expected detail voxels that are a whole part of ", frame.voxel_m,
          " m, found ", fused.voxelSize()[0]);
  return whole;
}

namespace {

// Free space is cut out. Behind what was measured there is something, as far as the views can tell:
// it begins at a distance of 0 and ends where they tell no more.
float cutBack(float solid, float measured, float band) {
  if (measured > 0) return std::max(solid, measured);
  const float begins = std::min(measured, -1e-3f * band), ends = -band - begins;
  return std::clamp(solid, begins, std::max(begins, ends));
}

float smoothStep(float t) { return t <= 0 ? 0.f : t >= 1 ? 1.f : t * t * (3 - 2 * t); }

// How far before a plane (behind: negative) the boundary of the solid voxels lies, in voxels, on
// the way from `kLook` before it; 0 where there is none.
double boundaryBefore(const Vector3d& foot, const Vector3d& normal, SmoothSolid::Lookup* solids) {
  const auto at = [&](double s) { return double(solids->distance(foot + s * normal)); };
  double inside = .5, outside = kLook;
  while (inside >= -1 && at(inside) >= 0) outside = inside, inside -= .5;
  if (inside < -1) return 0;
  for (int k = 0; k < 4; ++k) {
    const double middle = (inside + outside) / 2;
    (at(middle) < 0 ? inside : outside) = middle;
  }
  return (inside + outside) / 2;
}

// The boundary of the solid voxels lies up to a voxel before or behind the surface that is in them.
// Beyond the borders of what was measured a slope leads to it from the measured surface's plane.
float distanceAtBorder(const ContinuedVoxel& v, const SmoothSolid& smooth, int parts,
                       float voxel_m) {
  SmoothSolid::Lookup solids(smooth);
  const float band = float(kDetailBand) * voxel_m / float(parts);
  const Vector3d p = Vector3d(v.ijk.x() + .5, v.ijk.y() + .5, v.ijk.z() + .5) / parts,
                 normal = v.normal.cast<double>(), foot = p - double(v.distance / voxel_m) * normal;
  const float solid = solids.distance(p);
  const float weight = smoothStep((kEnd - v.reach / voxel_m) / (kEnd - kHold));
  if (weight == 0) return solid;
  const float slope =
      weight == 1 ? 0 : (1 - weight) * float(boundaryBefore(foot, normal, &solids)) * voxel_m;
  // Where no voxel is at the plane or before it, nothing goes on.
  const float sheet = std::min(solids.distance(foot), solids.distance(foot + .5 * normal));
  const float goes_on =
      std::max(cutBack(solid, v.distance - slope, band), std::min(solid, sheet - kFill * voxel_m));
  // Where voxels stand on the plane, what they are is not told from it.
  const float open = .5f + solids.distance(foot + kLook * normal) / voxel_m;
  return solid + open * std::min(1.f, 2 * weight) * (goes_on - solid);
}

// Active where a measured surface goes on.
FloatTree distancesAtBorders(const FloatTree& measured, const SmoothSolid& smooth, int parts,
                             float voxel_m) {
  ContinuationSettings s;
  s.plane_voxels = (parts + 1) / 2;
  s.reach = kEnd * voxel_m, s.before = float(kLook) * voxel_m, s.behind = measured.background();
  const std::vector<ContinuedVoxel> continued =
      continueDistance(measured, voxel_m / float(parts), s);
  std::vector<float> distances(continued.size());
  tbb::parallel_for(size_t(0), continued.size(), [&](size_t i) {
    distances[i] = distanceAtBorder(continued[i], smooth, parts, voxel_m);
  });
  FloatTree tree(measured.background());
  openvdb::tree::ValueAccessor<FloatTree, false> values(tree);
  for (size_t i = 0; i < continued.size(); ++i) values.setValueOn(continued[i].ijk, distances[i]);
  return tree;
}

// Distances of the right sign, right where they are near 0, in all voxels of a leaf.
Leaf* surfaceLeaf(const Coord& origin, const SmoothSolid& smooth, int parts, float band,
                  const Leaf* measured, const Leaf* at_border) {
  SmoothSolid::Lookup solids(smooth);
  auto* leaf = new Leaf(origin, band, true);
  for (openvdb::Index n = 0; n < Leaf::SIZE; ++n) {
    if (at_border && at_border->isValueOn(n)) {
      leaf->setValueOnly(n, at_border->getValue(n));
      continue;
    }
    const Coord ijk = leaf->offsetToGlobalCoord(n);
    const float solid = solids.distance(Vector3d(ijk.x() + .5, ijk.y() + .5, ijk.z() + .5) / parts);
    const bool is_measured = measured && measured->isValueOn(n);
    leaf->setValueOnly(n, is_measured ? cutBack(solid, measured->getValue(n), band) : solid);
  }
  return leaf;
}

void roundDistances(FloatGrid* grid) {
  const float band = grid->background(), step = stepOf(band);
  std::vector<Leaf*> leaves;
  grid->tree().getNodes(leaves);
  tbb::parallel_for(size_t(0), leaves.size(), [&](size_t i) {
    for (auto value = leaves[i]->beginValueOn(); value; ++value)
      value.setValue(roundedTo(step, *value));
  });
}

}  // namespace

FloatGrid::Ptr closedSurface(const VoxelFrame& frame, const std::vector<Coord>& solid,
                             const FloatGrid& fused) {
  const int parts = detailPartsOf(frame, fused);
  const VoxelFrame detail = detailFrame(frame, parts);
  const float band = float(kDetailBand) * detail.voxel_m;
  const SmoothSolid smooth(solid, double(frame.voxel_m));
  const FloatTree& measured = fused.constTree();
  const FloatTree at_borders = distancesAtBorders(measured, smooth, parts, frame.voxel_m);
  // What was measured may go on a band behind the voxels, and distances are asked for beyond.
  const std::vector<Coord> origins = leavesOver(solid, parts, 2 * kDetailBand);
  std::vector<Leaf*> leaves(origins.size(), nullptr);
  tbb::parallel_for(size_t(0), origins.size(), [&](size_t i) {
    leaves[i] = surfaceLeaf(origins[i], smooth, parts, band, measured.probeConstLeaf(origins[i]),
                            at_borders.probeConstLeaf(origins[i]));
  });
  FloatGrid::Ptr grid = gridOf(leaves, detail);
  const auto isMeasured = [&](const Coord& ijk) { return measured.getValue(ijk) < 0; };
  const int64_t dropped =
      dropSmallParts(int(std::lround(kSmallest / detail.voxel_m)), isMeasured, &grid->tree());
  grid->insertMeta("dropped_parts", openvdb::Int64Metadata(dropped));
  solveDistances(detail.voxel_m, kDetailBand, &grid->tree());
  roundDistances(grid.get());
  grid->tree().prune();
  grid->setGridClass(openvdb::GRID_LEVEL_SET);
  return grid;
}

}  // namespace vdbc
