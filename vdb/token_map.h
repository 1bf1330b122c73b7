#pragma once
// Values by token: an index tree that leads to rows, and a vector.
#include <vector>

#include "vdb/token_grid.h"

namespace vdbc {

/// A map from coordinates of one tree level to values; rows are in the order of insertion.
template <typename T>
class TokenMap {
 public:
  TokenMap() = default;
  /// tokens[i] -> values[i]; the tokens are different.
  TokenMap(const std::vector<Coord>& tokens, std::vector<T> values) {
    for (size_t i = 0; i < tokens.size(); ++i) insert(tokens[i], values[i]);
  }

  /// False, and nothing changes, where the token has a value.
  bool insert(const Coord& token, const T& value) {
    if (find(token)) return false;
    rows_.setValue(token, openvdb::Int32(values_.size()));
    tokens_.push_back(token), values_.push_back(value);
    return true;
  }
  void set(const Coord& token, const T& value) {
    if (!insert(token, value)) values_[size_t(rows_.getValue(token))] = value;
  }
  /// Null where the token has no value. Safe to call from several threads.
  const T* find(const Coord& token) const {
    const openvdb::Int32 row = rows_.getValue(token);
    return row < 0 ? nullptr : &values_[size_t(row)];
  }

  const std::vector<Coord>& tokens() const { return tokens_; }
  const std::vector<T>& values() const { return values_; }
  size_t size() const { return values_.size(); }

 private:
  TokenIndexTree rows_{-1};
  std::vector<Coord> tokens_;
  std::vector<T> values_;
};

}  // namespace vdbc
