// Laws of tables (vdb/columns.h), for every type that is one: a row moves with all that it holds,
// what does not fit is refused, any change is noticed.
#include "vdb/columns.h"

#include <gtest/gtest.h>

#include <numeric>
#include <tuple>

#include "splat/gaussians.h"
#include "splat/points_vdb.h"
#include "vdb/place.h"
#include "vdb/scene_vdb.h"

namespace vdbc {
namespace {

// --- tables of which no two values are equal, and their rows read by hand
// --------------------------

using Rows = std::vector<std::vector<double>>;

struct Counter {
  int last = 0;
  int operator()() { return ++last; }
  float real() { return float(++last); }
};

void fill(int64_t rows, Counter next, Place* p) {
  p->frame.voxel_m = .3f, p->frame.bounds = CoordBBox(Coord(-9), Coord(7));
  p->seen = std::make_shared<SeenSpace>();
  p->encoder_hash = "0123456789abcdef", p->growth = "level 3 of a run";
  p->level = 2, p->dim = 3;
  for (int64_t i = 0; i < rows; ++i) {
    p->ijk.emplace_back(next(), next(), next());
    for (int c = 0; c < p->dim; ++c) p->z.push_back(next.real());
    p->probability.push_back(next.real());
    p->bfs_level.push_back(next());
    p->generated.push_back(uint8_t(next()));
  }
}
auto besidesRows(const Place& p) {
  return std::make_tuple(p.frame.voxel_m, p.frame.bounds, p.seen, p.encoder_hash, p.growth, p.level,
                         p.dim);
}
Rows rowsOf(const Place& p) {
  Rows rows;
  for (size_t i = 0; i < p.ijk.size(); ++i)
    rows.push_back({double(p.ijk[i].x()), double(p.ijk[i].y()), double(p.ijk[i].z()), p.z.at(3 * i),
                    p.z.at(3 * i + 1), p.z.at(3 * i + 2), p.probability.at(i),
                    double(p.bfs_level.at(i)), double(p.generated.at(i))});
  return rows;
}

void fill(int64_t rows, Counter next, SceneVoxels* v) {
  v->frame.voxel_m = .3f, v->frame.bounds = CoordBBox(Coord(-9), Coord(7));
  v->empty.setValueOn(Coord(1, 2, 3));
  for (int64_t i = 0; i < rows; ++i) {
    v->ijk.emplace_back(next(), next(), next());
    v->colour_linear.emplace_back(next.real(), next.real(), next.real());
    v->density.push_back(next.real());
    v->observed.push_back(uint8_t(next()));
    v->probability.push_back(next.real());
    v->bfs_level.push_back(next());
  }
}
auto besidesRows(const SceneVoxels& v) {
  return std::make_tuple(v.frame.voxel_m, v.frame.bounds, activeCoords(v.empty));
}
Rows rowsOf(const SceneVoxels& v) {
  Rows rows;
  for (size_t i = 0; i < v.ijk.size(); ++i) {
    const Eigen::Vector3f& colour = v.colour_linear.at(i);
    rows.push_back({double(v.ijk[i].x()), double(v.ijk[i].y()), double(v.ijk[i].z()), colour.x(),
                    colour.y(), colour.z(), v.density.at(i), double(v.observed.at(i)),
                    v.probability.at(i), double(v.bfs_level.at(i))});
  }
  return rows;
}

void fill(int64_t rows, Counter next, Gaussians* g) {
  g->origin = {4.5e5, -3, 1e-9}, g->sh_degree = 1, g->antialias = true;
  for (int64_t i = 0; i < rows; ++i) {
    g->mean.emplace_back(next.real(), next.real(), next.real());
    g->log_scale.emplace_back(next.real(), next.real(), next.real());
    g->rotation.emplace_back(next.real(), next.real(), next.real(), next.real());
    g->opacity_logit.push_back(next.real());
    for (int c = 0; c < 12; ++c) g->sh.push_back(next.real());
  }
}
auto besidesRows(const Gaussians& g) { return std::make_tuple(g.origin, g.sh_degree, g.antialias); }
Rows rowsOf(const Gaussians& g) {
  Rows rows;
  for (size_t i = 0; i < g.mean.size(); ++i) {
    const Eigen::Vector3f &mean = g.mean[i], &scale = g.log_scale.at(i);
    const Eigen::Vector4f& turn = g.rotation.at(i);
    rows.push_back({mean.x(), mean.y(), mean.z(), scale.x(), scale.y(), scale.z(), turn[0], turn[1],
                    turn[2], turn[3], g.opacity_logit.at(i)});
    for (size_t c = 0; c < 12; ++c) rows.back().push_back(g.sh.at(12 * i + c));
  }
  return rows;
}

void fill(int64_t rows, Counter next, Provenance* p) {
  p->recorded = true;
  for (int64_t i = 0; i < rows; ++i) {
    p->generated.push_back(uint8_t(next()));
    p->probability.push_back(next.real());
  }
}
auto besidesRows(const Provenance& p) { return std::make_tuple(p.recorded); }
Rows rowsOf(const Provenance& p) {
  Rows rows;
  for (size_t i = 0; i < p.generated.size(); ++i)
    rows.push_back({double(p.generated[i]), p.probability.at(i)});
  return rows;
}

template <typename T>
T tableOf(int64_t rows) {
  T t;
  fill(rows, Counter(), &t);
  return t;
}

Rows chosen(const Rows& from, const std::vector<int64_t>& rows) {
  Rows to;
  for (int64_t row : rows) to.push_back(from.at(size_t(row)));
  return to;
}

// --- changes to one column
// -------------------------------------------------------------------------

void change(float* v) { *v += 1; }
void change(int32_t* v) { ++*v; }
void change(uint8_t* v) { ++*v; }
void change(Coord* v) { ++v->z(); }
template <int N>
void change(Eigen::Matrix<float, N, 1>* v) {
  (*v)[N - 1] += 1;
}

/// Calls visit(a copy of `t`, its k-th column) for each column.
template <typename T, typename Visit>
void forEachCopy(const T& t, const Visit& visit) {
  int columns = 0;
  forEachColumn([&](const auto&) { ++columns; }, t);
  for (int k = 0; k < columns; ++k) {
    T copy = t;
    int at = 0;
    forEachColumn(
        [&](auto column) {
          if (at++ == k) visit(copy, column);
        },
        copy);
  }
}

// --- the laws
// --------------------------------------------------------------------------------------

template <typename T>
class Columns : public testing::Test {};
using Tables = testing::Types<Place, SceneVoxels, Gaussians, Provenance>;
TYPED_TEST_SUITE(Columns, Tables);

TYPED_TEST(Columns, AllRowsSelectedAreTheTable) {
  const TypeParam t = tableOf<TypeParam>(7);
  std::vector<int64_t> all(7);
  std::iota(all.begin(), all.end(), 0);
  for (const TypeParam& same : {selectRows(t, all), keepRows(t, [](size_t) { return true; })}) {
    EXPECT_EQ(rowsOf(same), rowsOf(t));
    EXPECT_EQ(besidesRows(same), besidesRows(t));
    EXPECT_TRUE(equalRows(same, t));
  }
}

TYPED_TEST(Columns, RowsComeInTheOrderOfTheSelection) {
  const TypeParam t = tableOf<TypeParam>(7);
  for (const std::vector<int64_t>& rows :
       {std::vector<int64_t>{6, 0, 3}, {}, {2}, {5, 5, 1, 5}, {6, 5, 4, 3, 2, 1, 0}}) {
    const TypeParam some = selectRows(t, rows);
    EXPECT_EQ(some.size(), int64_t(rows.size()));
    EXPECT_NO_THROW(requireRows(some, "test"));
    EXPECT_EQ(rowsOf(some), chosen(rowsOf(t), rows));
    EXPECT_EQ(besidesRows(some), besidesRows(t));
  }
  const TypeParam kept = keepRows(t, [](size_t i) { return i % 3 == 1; });
  EXPECT_EQ(rowsOf(kept), chosen(rowsOf(t), {1, 4}));
  EXPECT_EQ(besidesRows(kept), besidesRows(t));
}

TYPED_TEST(Columns, SelectedAndAppendedArePermuted) {
  const TypeParam t = tableOf<TypeParam>(7);
  TypeParam parts = selectRows(t, {4, 1});
  appendRows(&parts, selectRows(t, {}));
  appendRows(&parts, selectRows(t, {0, 6, 2}));
  appendRows(&parts, selectRows(t, {5, 3}));
  EXPECT_TRUE(equalRows(parts, selectRows(t, {4, 1, 0, 6, 2, 5, 3})));
  EXPECT_EQ(rowsOf(parts), chosen(rowsOf(t), {4, 1, 0, 6, 2, 5, 3}));
  EXPECT_EQ(besidesRows(parts), besidesRows(t));
}

TYPED_TEST(Columns, ATableIsAppendedToItself) {
  const TypeParam t = tableOf<TypeParam>(3);
  TypeParam twice = t;
  appendRows(&twice, twice);
  EXPECT_EQ(rowsOf(twice), chosen(rowsOf(t), {0, 1, 2, 0, 1, 2}));
  EXPECT_NO_THROW(requireRows(twice, "test"));
}

TYPED_TEST(Columns, AnyOtherLengthIsRefused) {
  const TypeParam t = tableOf<TypeParam>(3);
  EXPECT_NO_THROW(requireRows(t, "test"));
  for (const bool longer : {false, true}) {
    bool first = true;  // the column that size() counts: the others are named then
    forEachCopy(t, [&](const TypeParam& copy, auto column) {
      SCOPED_TRACE(column.name);
      column.values.resize(longer ? column.values.size() + 1 : column.values.size() - 1);
      try {
        requireRows(copy, "the test");
        ADD_FAILURE() << "was accepted";
      } catch (const Error& e) {
        const std::string text = e.what();
        EXPECT_EQ(text.rfind("the test: ", 0), 0u) << text;
        EXPECT_TRUE(first || text.find(column.name) != std::string::npos) << text;
      }
      TypeParam whole = t;
      EXPECT_THROW(appendRows(&whole, copy), Error);
      EXPECT_EQ(rowsOf(whole), rowsOf(t));
      TypeParam uneven = copy;
      EXPECT_THROW(appendRows(&uneven, t), Error);
      EXPECT_TRUE(equalRows(uneven, copy));
      first = false;
    });
  }
}

TYPED_TEST(Columns, AnyChangedValueIsNoticed) {
  const TypeParam t = tableOf<TypeParam>(3);
  EXPECT_TRUE(equalRows(t, TypeParam(t)));
  forEachCopy(t, [&](const TypeParam& copy, auto column) {
    SCOPED_TRACE(column.name);
    ASSERT_FALSE(column.values.empty());
    for (auto& value : column.values) {
      const auto before = value;
      change(&value);
      EXPECT_FALSE(equalRows(copy, t));
      EXPECT_FALSE(equalRows(t, copy));
      value = before;
    }
    EXPECT_TRUE(equalRows(copy, t));
  });
  EXPECT_FALSE(equalRows(t, selectRows(t, {0, 1})));
  EXPECT_FALSE(equalRows(t, selectRows(t, {0, 2, 1})));
}

/// `wide` has longer rows than `t`.
template <typename T>
void expectOtherWidthsRefused(const T& t, const T& wide) {
  ASSERT_NO_THROW(requireRows(t, "test"));
  ASSERT_NO_THROW(requireRows(wide, "test"));
  for (const auto& [to, more] : {std::make_pair(t, wide), std::make_pair(wide, t)}) {
    T whole = to;
    EXPECT_THROW(appendRows(&whole, more), Error);
    EXPECT_TRUE(equalRows(whole, to)) << "part of the rows was appended";
  }
  EXPECT_FALSE(equalRows(t, wide));
}

TEST(ColumnWidths, OthersAreRefused) {
  Place wide = tableOf<Place>(3);
  wide.dim = 4, wide.z.resize(12);
  expectOtherWidthsRefused(tableOf<Place>(3), wide);
  Gaussians bands = tableOf<Gaussians>(3);
  bands.sh_degree = 2, bands.sh.resize(3 * 27);
  expectOtherWidthsRefused(tableOf<Gaussians>(3), bands);
}

TEST(Place, ObservedPartIsWhatWasNotGenerated) {
  Place place = tableOf<Place>(5);
  place.generated = {0, 1, 0, 0, 1};
  const Place observed = observedPart(place);
  EXPECT_EQ(rowsOf(observed), chosen(rowsOf(place), {0, 2, 3}));
  EXPECT_EQ(besidesRows(observed), besidesRows(place));
}

}  // namespace
}  // namespace vdbc
