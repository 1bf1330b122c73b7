// See grid_instances.h.
#include "vdb/grid_instances.h"

template class openvdb::tree::Tree<vdbc::Vec3STree::RootNodeType>;
template class openvdb::Grid<vdbc::Vec3STree>;
