#pragma once
// The grid and tree types that this project creates, instantiated once each, in
// grid_instances.cpp.
//
// Creating a grid or a tree emits its whole vtable (copying, reading, writing, merging, ...): 9 to
// 16 s of compiling per type and file. Include this wherever one is created or copied (TokenMask
// and TokenIndexTree are covered by token_grid.h).
#include <openvdb/Grid.h>
#include <openvdb/tree/Tree.h>

#include "vdb/token_grid.h"

namespace vdbc {

// The names openvdb.h gives; that header costs 3 s more (point grids, registration).
using FloatTree = openvdb::tree::Tree4<float, 5, 4, 3>::Type;
using BoolTree = openvdb::tree::Tree4<bool, 5, 4, 3>::Type;
using Vec3STree = openvdb::tree::Tree4<openvdb::Vec3f, 5, 4, 3>::Type;
using MaskTree = openvdb::tree::Tree4<openvdb::ValueMask, 5, 4, 3>::Type;
using FloatGrid = openvdb::Grid<FloatTree>;
using BoolGrid = openvdb::Grid<BoolTree>;
using Vec3SGrid = openvdb::Grid<Vec3STree>;
using MaskGrid = openvdb::Grid<MaskTree>;

}  // namespace vdbc

extern template class openvdb::tree::Tree<vdbc::FloatTree::RootNodeType>;
extern template class openvdb::tree::Tree<vdbc::BoolTree::RootNodeType>;
extern template class openvdb::tree::Tree<vdbc::Vec3STree::RootNodeType>;
extern template class openvdb::tree::Tree<vdbc::MaskTree::RootNodeType>;
extern template class openvdb::Grid<vdbc::FloatTree>;
extern template class openvdb::Grid<vdbc::BoolTree>;
extern template class openvdb::Grid<vdbc::Vec3STree>;
extern template class openvdb::Grid<vdbc::MaskTree>;
