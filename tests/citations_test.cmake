# What comments and pages cite can be opened: each page (NAME.md) is in the repository, each section of docs/method.md that is
# cited by its number is there, and nothing cites numbers of pages that are not here ("spec A8", "decision 2").
#   cmake -DROOT=<repository> -P citations_test.cmake         checks the sources
#   cmake -DSELF_TEST=<scratch> -P citations_test.cmake       checks that the check finds violations
cmake_minimum_required(VERSION 3.25)

set(FOLDERS vdb splat encoder mar houdini_style_tools tests examples docs)

# All violations under `root`, one line each, in the variable `out`.
function(find_violations root out)
  set(found)
  # A heading "### 3.2 Guided attention" is section 3.2.
  set(sections)
  if(EXISTS ${root}/docs/method.md)
    file(STRINGS ${root}/docs/method.md headings REGEX "^##+ [0-9]")
    foreach(heading ${headings})
      string(REGEX REPLACE "^##+ ([0-9.]+).*" "\\1" number "${heading}")
      list(APPEND sections ${number})
    endforeach()
  endif()

  set(files)
  foreach(folder ${FOLDERS})
    file(GLOB_RECURSE some ${root}/${folder}/*.h ${root}/${folder}/*.cpp ${root}/${folder}/*.inl ${root}/${folder}/*.cmake
      ${root}/${folder}/*.sh ${root}/${folder}/*.md ${root}/${folder}/CMakeLists.txt)
    list(APPEND files ${some})
  endforeach()
  file(GLOB some ${root}/*.md ${root}/CMakeLists.txt)
  list(APPEND files ${some})
  list(FILTER files EXCLUDE REGEX "/tests/citations_test\\.cmake$|/docs/ATTRIBUTION\\.md$")

  foreach(file ${files})
    file(RELATIVE_PATH name ${root} ${file})
    get_filename_component(folder ${file} DIRECTORY)
    file(READ ${file} text)
    string(REGEX REPLACE "[][;]" " " text "${text}")  # they mean something to CMake's lists
    set(is_page FALSE)
    if(name MATCHES "\\.md$")
      set(is_page TRUE)
    else()
      # Comments without the breaks between their lines; of scripts, whose paths have variables, nothing else.
      set(mark "//+")
      if(name MATCHES "\\.(cmake|sh|txt)$")
        set(mark "#+")
        string(REGEX REPLACE "\n[ \t]*[^# \t\n][^\n]*" "" text "\n${text}")
      endif()
      string(REGEX REPLACE "\n[ \t]*${mark}" " " text "${text}")
      string(REGEX REPLACE "[ \t]+" " " text "${text}")
    endif()

    string(REGEX MATCHALL "[Ss]pec:? [EA][0-9]+|[( ][EA][0-9]+[),-]|// [EA][0-9]+|[Dd]ecisions? [0-9]+" numbers "${text}")
    if(is_page)
      set(numbers)
    endif()
    foreach(number ${numbers})
      list(APPEND found "${name}: '${number}' (the page with these numbers is not in the repository)")
    endforeach()

    # Pages: as seen from the root; in pages and scripts also from docs/ or from where they lie.
    string(REGEX MATCHALL "[A-Za-z0-9_./-]*[A-Za-z0-9_]\\.md" pages "${text}")
    list(REMOVE_DUPLICATES pages)
    foreach(page ${pages})
      if(NOT EXISTS ${root}/${page} AND
         (name MATCHES "\\.(h|cpp|inl)$" OR NOT EXISTS ${root}/docs/${page} AND NOT EXISTS ${folder}/${page}))
        list(APPEND found "${name}: ${page} (not in the repository)")
      endif()
    endforeach()

    # Sections: everywhere in comments, "section 3.2" is one of docs/method.md; in pages where the page's name stands before.
    set(list "[0-9][0-9.]*(,? (and|to) [0-9][0-9.]*|, [0-9][0-9.]*)*")
    set(before "docs/method\\.md,[ \n]+")
    if(NOT is_page OR name STREQUAL "docs/method.md")
      set(before "")
    endif()
    string(REGEX MATCHALL "${before}[Ss]ections?[ \n]+${list}" cited "${text}")
    foreach(citation ${cited})
      string(REGEX MATCHALL "[0-9][0-9.]*" numbers "${citation}")
      foreach(number ${numbers})
        string(REGEX REPLACE "\\.$" "" number "${number}")
        if(NOT number IN_LIST sections)
          list(APPEND found "${name}: section ${number} (not in docs/method.md)")
        endif()
      endforeach()
    endforeach()
  endforeach()
  set(${out} ${found} PARENT_SCOPE)
endfunction()

if(SELF_TEST)
  set(bad "vdb/a.h|// As spec A8 says." "vdb/a.h|// F, E, U. Spec:\n// E4." "vdb/a.h|// A split (E9) of a node."
    "tests/a_test.cpp|TEST(A, B) {  // A11" "vdb/a.h|// See decision 2 of the design." "mar/a.cpp|// training.md"
    "vdb/a.h|// The format: method.md 2.3." "docs/other.md|See gone.md." "vdb/a.h|// docs/method.md, section 3.4."
    "vdb/a.h|// docs/method.md,\n// sections 3.3\n// and 9." "mar/a.cpp|int f() {  // section 7.1"
    "docs/other.md|As docs/method.md, section 5 says." "tests/a.cmake|# docs/method.md, section 4" "README.md|docs/gone.md")
  set(good "vdb/a.h|// docs/method.md, section 3.3." "vdb/a.h|// docs/method.md, sections 3 and\n// 3.3, paper sec. 4, eq. 2"
    "mar/a.cpp|int f() {  // section 3" "vdb/a.h|// docs/method.md" "docs/other.md|method.md and docs/method.md"
    "docs/notes/a.md|a section 9 of my own" "vdb/a.h|// F, E and U, 1e-4, E of the views" "README.md|docs/method.md")
  foreach(case ${bad} ${good})
    string(REPLACE "|" ";" parts "${case}")
    list(GET parts 0 file)
    list(GET parts 1 line)
    file(REMOVE_RECURSE ${SELF_TEST})
    file(WRITE ${SELF_TEST}/docs/method.md "# The method\n\n## 3 Encoder\n\n### 3.3 Latents\n\nAs in section 3.\n")
    file(WRITE ${SELF_TEST}/${file} "${line}\n")
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
