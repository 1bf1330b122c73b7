// See grid_instances.h.
#include "vdb/grid_instances.h"

template class openvdb::tree::Tree<vdbc::TokenMask::RootNodeType>;
template class openvdb::tree::Tree<vdbc::TokenIndexTree::RootNodeType>;
