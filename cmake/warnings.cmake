# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0

# Errors in our own checks only: a newcomer's compiler may know warnings that ours does not. Third-party headers are not ours to judge.
option(VLA_WERROR "Treat warnings in our own code as errors" OFF)

function(vla_warnings target)
  target_compile_options(${target} PRIVATE -Wall -Wextra -Wshadow -Wnon-virtual-dtor -Wold-style-cast
                         -Wno-missing-field-initializers $<$<BOOL:${VLA_WERROR}>:-Werror>)
  if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    # GCC 12 reports std::string's own operator+ at -O3, and moved variants in instrumented code.
    target_compile_options(${target} PRIVATE -Wno-restrict)
    if(VLA_UNITY)  # GCC warns of unnamed types of every file but the main one, which a group has not
      target_compile_options(${target} PRIVATE -Wno-subobject-linkage)
    endif()
    if(VLA_SANITIZE)
      target_compile_options(${target} PRIVATE -Wno-maybe-uninitialized)
    endif()
  endif()
endfunction()
