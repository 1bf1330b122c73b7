#include "vdb/grid_instances.h"

template class openvdb::tree::Tree<vdbc::TokenMask::RootNodeType>;
template class openvdb::tree::Tree<vdbc::TokenIndexTree::RootNodeType>;
template class openvdb::tree::Tree<vdbc::FloatTree::RootNodeType>;
template class openvdb::tree::Tree<vdbc::BoolTree::RootNodeType>;
template class openvdb::tree::Tree<vdbc::Vec3STree::RootNodeType>;
template class openvdb::tree::Tree<vdbc::MaskTree::RootNodeType>;
template class openvdb::Grid<vdbc::FloatTree>;
template class openvdb::Grid<vdbc::BoolTree>;
template class openvdb::Grid<vdbc::Vec3STree>;
template class openvdb::Grid<vdbc::MaskTree>;
