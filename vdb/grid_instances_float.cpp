// See grid_instances.h.
#include "vdb/grid_instances.h"

template class openvdb::tree::Tree<vdbc::FloatTree::RootNodeType>;
template class openvdb::Grid<vdbc::FloatTree>;
