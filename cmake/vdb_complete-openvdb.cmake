# Finds OpenVDB and TBB. Debian keeps FindOpenVDB.cmake outside CMake's search path. That module sets
# BUILD_SHARED_LIBS, which ends with this function, and defines one of TBB's targets unless TBB was found before,
# after which TBB could not be found any more.
function(vdb_complete_find_openvdb)
  if(NOT TARGET TBB::tbb)
    find_package(TBB ${ARGN})
  endif()
  list(APPEND CMAKE_MODULE_PATH "/usr/lib/${CMAKE_LIBRARY_ARCHITECTURE}/cmake/OpenVDB")
  find_package(OpenVDB ${ARGN} COMPONENTS openvdb)
endfunction()
