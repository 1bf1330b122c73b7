#pragma once
// Things kept as parallel arrays, a row a thing: tokens, voxels, Gaussians. A type T describes its
// arrays once, as `T::columns(t)`, a tuple of Column; selecting, appending, comparing, checking and
// the files' readers and writers follow from that.
#include <algorithm>
#include <cstdint>
#include <iterator>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "vdb/error.h"

namespace vdbc {

/// One array: `width` values a row. The name is also that of the grid or attribute in files, which
/// hold the values exactly or, where kHalf, in half precision.
template <typename Vector, bool kHalf = false>
struct Column {
  using Value = typename std::remove_const_t<Vector>::value_type;
  static constexpr bool is_half = kHalf;
  const char* name;
  Vector& values;
  size_t width = 1;
};
template <typename Vector>
Column<Vector> column(const char* name, Vector& values, size_t width = 1) {
  return {name, values, width};
}
template <typename Vector>
Column<Vector, true> halfColumn(const char* name, Vector& values, size_t width) {
  return {name, values, width};
}

namespace detail {
template <typename Visit, typename Tuple, typename... More, size_t... I>
void visitColumns(std::index_sequence<I...>, Visit& visit, Tuple a, More... more) {
  const auto visitOne = [&](auto index) {
    visit(std::get<decltype(index)::value>(a), std::get<decltype(index)::value>(more)...);
  };
  (visitOne(std::integral_constant<size_t, I>()), ...);
}
}  // namespace detail

/// Calls visit(column of t, the same column of each of `others`...) for every column in order.
template <typename Visit, typename T, typename... Others>
void forEachColumn(Visit&& visit, T& t, Others&... others) {
  using Tuple = decltype(T::columns(t));
  detail::visitColumns(std::make_index_sequence<std::tuple_size<Tuple>::value>(), visit,
                       T::columns(t), Others::columns(others)...);
}

/// Throws Error unless all columns hold the same number of rows; `where` begins the message.
template <typename T>
void requireRows(const T& t, const std::string& where) {
  const size_t n = size_t(t.size());
  forEachColumn(
      [&](const auto& c) {
        require(c.values.size() == n * c.width, where, ": expected ", n * c.width, " values of ",
                c.name, ", found ", c.values.size());
      },
      t);
}

/// Those rows of `t`, in that order. All that is no column stays.
template <typename T>
T selectRows(T t, const std::vector<int64_t>& rows) {
  forEachColumn(
      [&](auto c) {
        std::decay_t<decltype(c.values)> chosen;
        chosen.reserve(rows.size() * c.width);
        for (int64_t row : rows) {
          const auto first = c.values.begin() + std::ptrdiff_t(size_t(row) * c.width);
          chosen.insert(chosen.end(), first, first + std::ptrdiff_t(c.width));
        }
        c.values = std::move(chosen);
      },
      t);
  return t;
}

/// The rows whose index `keep` accepts.
template <typename T, typename Keep>
T keepRows(T t, const Keep& keep) {
  std::vector<int64_t> rows;
  for (int64_t i = 0; i < t.size(); ++i)
    if (keep(size_t(i))) rows.push_back(i);
  return selectRows(std::move(t), rows);
}

/// Appends the rows of `more`. Throws Error, with nothing appended, where its rows have other
/// widths or the columns of either hold different numbers of rows.
template <typename T>
void appendRows(T* t, const T& more) {
  requireRows(*t, "appendRows");
  requireRows(more, "appendRows");
  forEachColumn(
      [](const auto& to, const auto& from) {
        require(to.width == from.width, "appendRows: expected ", to.width, " values of ", to.name,
                " a row, found ", from.width);
      },
      *t, more);
  forEachColumn(
      [](auto to, const auto& from) {
        // Not insert(): `more` may be `*t`.
        const size_t before = to.values.size(), count = from.values.size();
        to.values.resize(before + count);
        std::copy_n(from.values.begin(), count, to.values.begin() + std::ptrdiff_t(before));
      },
      *t, more);
}

/// Whether all columns are equal, value by value.
template <typename T>
bool equalRows(const T& a, const T& b) {
  bool equal = true;
  forEachColumn([&](const auto& x, const auto& y) { equal = equal && x.values == y.values; }, a, b);
  return equal;
}

}  // namespace vdbc
