# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0

# Warnings are errors in our own code; third-party headers are not ours to judge.
function(vla_warnings target)
  # -Wrestrict is off because GCC 12 reports std::string's own operator+ at -O3.
  target_compile_options(${target} PRIVATE -Wall -Wextra -Wshadow -Wnon-virtual-dtor -Wold-style-cast -Wno-missing-field-initializers $<$<CXX_COMPILER_ID:GNU>:-Wno-restrict> -Werror)
endfunction()
