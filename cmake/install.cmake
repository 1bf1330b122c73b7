# What `cmake --install` and `cpack -G DEB` give: the program with its weights, and the library with the headers
# listed here. No other header is public, and none of these includes torch.
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

target_sources(vdbc_core PUBLIC FILE_SET HEADERS BASE_DIRS ${PROJECT_SOURCE_DIR} FILES
  vdb/camera.h vdb/carve.h vdb/columns.h vdb/error.h vdb/fit_volume.h vdb/frame.h vdb/frontier.h vdb/fuse.h
  vdb/grid_instances.h vdb/latent_vdb.h vdb/mask_vdb.h vdb/place.h vdb/progress.h vdb/scene_vdb.h vdb/seen.h
  vdb/threads.h vdb/token_grid.h vdb/token_map.h
  splat/detail.h splat/detail_grids.h splat/exr.h splat/gaussians.h splat/image.h splat/image_files.h splat/join.h
  splat/metrics.h splat/ply.h splat/points_vdb.h splat/rasterize.h splat/rays.h splat/view.h
  encoder/views/read_views.h)
set(core_libraries vdbc_core)
if(VDBC_NN)
  target_sources(vdbc_nn PUBLIC FILE_SET HEADERS BASE_DIRS ${PROJECT_SOURCE_DIR} FILES
    encoder/config.h encoder/encoder.h encoder/observation.h encoder/positions.h mar/calibration.h mar/completer.h
    mar/config.h)
  target_sources(vdbc_tools PUBLIC FILE_SET HEADERS BASE_DIRS ${PROJECT_SOURCE_DIR} FILES
    houdini_style_tools/blas.h houdini_style_tools/checkpoint.h houdini_style_tools/complete.h
    houdini_style_tools/render.h)
  set(tools_libraries vdbc_nn vdbc_tools)
endif()

# The files of the package are in two parts, as only a library user needs the second.
set(package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/vdb_complete)
foreach(part core tools)
  if(${part}_libraries)
    foreach(library ${${part}_libraries})
      string(REPLACE vdbc_ "" name ${library})
      set_target_properties(${library} PROPERTIES EXPORT_NAME ${name} VERSION ${PROJECT_VERSION}
        SOVERSION ${PROJECT_VERSION_MAJOR}.${PROJECT_VERSION_MINOR} INSTALL_RPATH "$ORIGIN")
    endforeach()
    install(TARGETS ${${part}_libraries} EXPORT ${part}
      LIBRARY COMPONENT program NAMELINK_COMPONENT library
      ARCHIVE COMPONENT library
      FILE_SET HEADERS DESTINATION ${CMAKE_INSTALL_INCLUDEDIR}/vdb_complete COMPONENT library)
    install(EXPORT ${part} NAMESPACE vdb_complete:: FILE vdb_complete-${part}.cmake
      DESTINATION ${package_dir} COMPONENT library)
  endif()
endforeach()

set(weights_dir ${CMAKE_INSTALL_DATADIR}/vdb_complete/weights/indoor)
configure_package_config_file(cmake/vdb_complete-config.cmake.in vdb_complete-config.cmake
  INSTALL_DESTINATION ${package_dir} PATH_VARS weights_dir)
write_basic_package_version_file(vdb_complete-config-version.cmake COMPATIBILITY SameMinorVersion)
install(FILES cmake/vdb_complete-openvdb.cmake ${PROJECT_BINARY_DIR}/vdb_complete-config.cmake
  ${PROJECT_BINARY_DIR}/vdb_complete-config-version.cmake
  DESTINATION ${package_dir} COMPONENT library)

if(VDBC_NN)
  set_target_properties(vdb_complete PROPERTIES INSTALL_RPATH "$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
  install(TARGETS vdb_complete RUNTIME COMPONENT program)
  install(DIRECTORY weights/indoor/ DESTINATION ${weights_dir} COMPONENT program)
  install(FILES docs/ATTRIBUTION.md DESTINATION ${CMAKE_INSTALL_DOCDIR} COMPONENT program)
  install(FILES LICENSE RENAME copyright DESTINATION ${CMAKE_INSTALL_DOCDIR} COMPONENT program)
endif()

# The Debian package holds what an artist needs: the program. OpenBLAS multiplies 20 to 60 times faster than the
# libblas3 that libtorch asks for.
set(CPACK_COMPONENTS_ALL program)
set(CPACK_DEB_COMPONENT_INSTALL ON)
set(CPACK_PACKAGE_NAME vdb-complete)
set(CPACK_PACKAGE_CONTACT "the maintainers of vdb_complete")
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "completes places seen in a few RGB-D views, as VDB grids and Gaussians")
set(CPACK_DEBIAN_PROGRAM_PACKAGE_NAME vdb-complete)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_SECTION graphics)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PACKAGE_DEPENDS "libopenblas0-openmp")
set(CPACK_STRIP_FILES ON)
include(CPack)
