# Who includes whom (docs/architecture.md): vdb <- splat <- encoder <- mar <- houdini_style_tools <- examples/lab,
# only leftwards; examples/rooms stands on vdb, splat and encoder/views, and only the lab includes it; vdb, splat,
# encoder/views and examples/rooms know no torch, nothing includes all of torch.
#   cmake -DROOT=<repository> -P include_order_test.cmake       checks the sources
#   cmake -DSELF_TEST=<scratch> -P include_order_test.cmake     checks that the check finds violations
cmake_minimum_required(VERSION 3.25)

# A folder includes itself and what comes before it.
set(ORDER vdb splat encoder/views examples/rooms encoder mar houdini_style_tools examples/lab)

# All violations under `root`, one line each, in the variable `out`.
function(find_violations root out)
  set(found)
  foreach(folder ${ORDER} tests examples)
    file(GLOB files ${root}/${folder}/*.h ${root}/${folder}/*.cpp)
    list(FIND ORDER ${folder} own)
    foreach(file ${files})
      file(RELATIVE_PATH name ${root} ${file})
      set(torch_free FALSE)
      if(folder MATCHES "^(vdb|splat|encoder/views|examples/rooms)$" AND NOT name MATCHES "^splat/rasterize_torch\\.")
        set(torch_free TRUE)
      endif()
      file(STRINGS ${file} lines REGEX "^[ \t]*#[ \t]*include")
      foreach(line ${lines})
        string(REGEX REPLACE "^[ \t]*#[ \t]*include[ \t]*[<\"]([^>\"]*)[>\"].*" "\\1" header ${line})
        if(header STREQUAL "torch/torch.h")
          list(APPEND found "${name}: ${header} (takes 12 s to compile: include what is used)")
        elseif(torch_free AND header MATCHES "^(torch|ATen|c10)/")
          list(APPEND found "${name}: ${header} (this folder builds without torch)")
        elseif(torch_free AND header STREQUAL "splat/rasterize_torch.h")
          list(APPEND found "${name}: ${header} (this folder builds without torch)")
        elseif(name MATCHES "\\.h$" AND header STREQUAL "openvdb/openvdb.h")
          list(APPEND found "${name}: ${header} (3 s for everyone: take openvdb/Types.h or one grid)")
        elseif(folder STREQUAL "mar" AND header MATCHES "^encoder/(encoder|network|encoder_train)\\.h$")
          list(APPEND found "${name}: ${header} (the pipelines meet in houdini_style_tools only)")
        elseif(folder MATCHES "^(encoder|mar|houdini_style_tools)$" AND header MATCHES "^examples/rooms/")
          list(APPEND found "${name}: ${header} (only the lab knows the rooms)")
        elseif(own GREATER -1)
          get_filename_component(other ${header} DIRECTORY)
          list(FIND ORDER "${other}" rank)
          if(rank GREATER own)
            list(APPEND found "${name}: ${header} (${folder} comes before ${other})")
          endif()
        endif()
      endforeach()
    endforeach()
  endforeach()
  set(${out} ${found} PARENT_SCOPE)
endfunction()

if(SELF_TEST)
  set(bad "vdb/a.h|splat/image.h" "vdb/a.cpp|ATen/ATen.h" "splat/a.cpp|torch/types.h"
    "splat/a.cpp|splat/rasterize_torch.h" "splat/a.h|encoder/layers.h" "encoder/a.cpp|mar/heads.h"
    "mar/a.cpp|encoder/network.h" "mar/a.cpp|examples/rooms/rooms.h" "houdini_style_tools/a.cpp|examples/rooms/rooms.h"
    "houdini_style_tools/a.cpp|examples/lab/evaluate.h" "examples/rooms/a.cpp|examples/lab/scenes.h" "mar/a.h|torch/torch.h"
    "tests/a_test.cpp|torch/torch.h" "examples/rooms/rooms.h|encoder/encoder.h"
    "encoder/a.h|houdini_style_tools/blas.h" "encoder/views/a.cpp|encoder/encoder.h" "splat/a.cpp|encoder/views/view.h"
    "splat/a.h|openvdb/openvdb.h" "encoder/views/a.h|ATen/ATen.h"
    "encoder/views/a.cpp|splat/rasterize_torch.h" "encoder/views/a.cpp|examples/rooms/rooms.h")
  set(good "vdb/a.h|vdb/error.h" "splat/a.cpp|vdb/camera.h" "splat/rasterize_torch.cpp|ATen/ATen.h"
    "encoder/a.cpp|splat/rasterize_torch.h" "mar/a.cpp|encoder/layers.h" "vdb/a.cpp|openvdb/openvdb.h"
    "examples/lab/a.cpp|examples/rooms/rooms.h" "examples/lab/a.cpp|houdini_style_tools/complete.h" "tests/a_test.cpp|mar/heads.h"
    "examples/rooms/a.cpp|encoder/views/view.h" "encoder/a.h|encoder/views/view.h"
    "encoder/views/a.cpp|splat/view.h")
  foreach(case ${bad} ${good})
    string(REPLACE "|" ";" parts "${case}")
    list(GET parts 0 file)
    list(GET parts 1 header)
    file(REMOVE_RECURSE ${SELF_TEST})
    file(WRITE ${SELF_TEST}/${file} "// a comment\n#include \"${header}\"\n")
    find_violations(${SELF_TEST} violations)
    list(LENGTH violations count)
    if(case IN_LIST bad AND NOT count EQUAL 1 OR case IN_LIST good AND NOT count EQUAL 0)
      message(SEND_ERROR "${case}: expected the check to find it only if bad, found: ${violations}")
    endif()
  endforeach()
  file(REMOVE_RECURSE ${SELF_TEST})
else()
  find_violations(${ROOT} violations)
  foreach(violation ${violations})
    message(SEND_ERROR "${violation}")
  endforeach()
endif()
