# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# Compiling is mostly reading headers. Sources are compiled in groups and after precompiled headers, in half the time. A
# compiler's cache keeps more of what is compiled one by one, and so does who changes single files all day.
set(vla_unity ON)
if(CMAKE_CXX_COMPILER_LAUNCHER)
  set(vla_unity OFF)
endif()
option(VLA_UNITY "Compile sources in groups, and after precompiled headers" ${vla_unity})

# CMake leaves sources with options of their own out of every group.
function(vla_group target)
  set_target_properties(${target} PROPERTIES UNITY_BUILD ${VLA_UNITY} UNITY_BUILD_BATCH_SIZE 16)
endfunction()

# For code that runs once, at load or in a test: compiling it takes longer than running it.
function(vla_optimize_little target)
  if(VLA_SANITIZE)
    target_compile_options(${target} PRIVATE -O0)
  else()
    target_compile_options(${target} PRIVATE -O1)
  endif()
endfunction()

function(vla_precompile target)
  if(VLA_UNITY)
    target_precompile_headers(${target} PRIVATE ${ARGN})
    if(CMAKE_CXX_COMPILER_ID STREQUAL GNU)  # it forgets that such a header is the system's, whose own code it warns of at -O3
      target_compile_options(${target} PRIVATE -Wno-array-bounds -Wno-stringop-overflow -Wno-stringop-overread)
    endif()
  endif()
endfunction()
