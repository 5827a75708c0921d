# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
#
# Every third-party library of the runtime, and the only place where versions are pinned.

# ggml: the graph library of llama.cpp, from the package registry unless VLA_GGML_DIR names a tree.
set(VLA_GGML_ARCHIVE llama_cpp_python-0.3.36)
set(VLA_GGML_SHA256 832db0699007f1be95a7e41ef12e88926b02ba836461e36a36372db2760c1a2e)

function(vla_fetch_ggml out)
  set(cache ${CMAKE_SOURCE_DIR}/.cache)
  set(archive ${cache}/${VLA_GGML_ARCHIVE}.tar.gz)
  set(tree ${cache}/${VLA_GGML_ARCHIVE}/vendor/llama.cpp/ggml)
  set(${out} ${tree} PARENT_SCOPE)
  if(EXISTS ${tree}/.complete)
    return()
  endif()
  if(NOT EXISTS ${archive})
    message(STATUS "Downloading ggml (75 MB, once)")
    if(EXISTS ${CMAKE_SOURCE_DIR}/.venv/.complete)  # before, it may lack pip
      find_program(VLA_PYTHON NAMES python3 PATHS ${CMAKE_SOURCE_DIR}/.venv/bin NO_DEFAULT_PATH)
    endif()
    find_program(VLA_PYTHON NAMES python3 REQUIRED)
    execute_process(
      COMMAND ${VLA_PYTHON} -m pip download --quiet --disable-pip-version-check --no-deps --no-binary llama-cpp-python
              --require-hashes -r ${CMAKE_SOURCE_DIR}/cmake/ggml-requirements.txt -d ${cache}
      RESULT_VARIABLE failed ERROR_VARIABLE why)
    if(failed)
      message(FATAL_ERROR "ggml could not be downloaded with pip:\n${why}\n"
                          "Without a network, pass -DVLA_GGML_DIR=/path/to/llama.cpp/ggml")
    endif()
  endif()
  file(SHA256 ${archive} found)
  if(NOT found STREQUAL VLA_GGML_SHA256)
    message(FATAL_ERROR "${archive}: expected SHA-256 ${VLA_GGML_SHA256}, found ${found}; delete it and configure again")
  endif()
  file(ARCHIVE_EXTRACT INPUT ${archive} DESTINATION ${cache} PATTERNS "${VLA_GGML_ARCHIVE}/vendor/llama.cpp/ggml/*")
  file(TOUCH ${tree}/.complete)
endfunction()

set(vla_ggml_tree ${VLA_GGML_DIR})
if(NOT vla_ggml_tree)
  vla_fetch_ggml(vla_ggml_tree)
endif()
set(BUILD_SHARED_LIBS OFF)
set(GGML_NATIVE ${VLA_NATIVE} CACHE BOOL "" FORCE)
# Of a build for any machine: written here, since ggml's own defaults stay as they were when a folder was configured first.
set(vla_ggml_avx2 ON)
if(VLA_NATIVE OR NOT CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
  set(vla_ggml_avx2 OFF)
endif()
foreach(instructions SSE42 AVX AVX2 BMI2 FMA F16C)
  set(GGML_${instructions} ${vla_ggml_avx2} CACHE BOOL "" FORCE)
endforeach()
set(GGML_OPENMP OFF CACHE BOOL "" FORCE)
set(GGML_LLAMAFILE ON CACHE BOOL "" FORCE)    # blocked float32 products
set(GGML_CPU_REPACK OFF CACHE BOOL "" FORCE)  # quantized formats that no bundle uses
set(GGML_BUILD_TESTS OFF CACHE BOOL "" FORCE)
set(GGML_BUILD_EXAMPLES OFF CACHE BOOL "" FORCE)
set(GGML_VULKAN ${VLA_VULKAN} CACHE BOOL "" FORCE)
if(VLA_VULKAN)
  find_program(VLA_GLSLC glslc HINTS $ENV{VULKAN_SDK}/bin REQUIRED)
  configure_file(${CMAKE_CURRENT_LIST_DIR}/glslc.sh.in ${CMAKE_BINARY_DIR}/glslc.sh @ONLY)
  set(Vulkan_GLSLC_EXECUTABLE ${CMAKE_BINARY_DIR}/glslc.sh CACHE FILEPATH "" FORCE)
endif()
set(GGML_CUDA ${VLA_CUDA_GGML} CACHE BOOL "" FORCE)
# CUDA's compiler, or with `what` cuda also its libraries, unless VLA_CUDA_DIR names a toolkit.
function(vla_fetch_cuda out what)
  set(${out} ${VLA_CUDA_DIR} PARENT_SCOPE)
  if(VLA_CUDA_DIR)
    return()
  endif()
  set(folder ${CMAKE_SOURCE_DIR}/.cache/${what})
  execute_process(COMMAND ${CMAKE_SOURCE_DIR}/scripts/cuda.sh ${folder} ${what} RESULT_VARIABLE failed)
  if(failed)
    message(FATAL_ERROR "CUDA's compiler could not be downloaded with pip; pass -DVLA_CUDA_DIR=/path/to/a/toolkit instead")
  endif()
  set(${out} ${folder}/nvidia/cu13 PARENT_SCOPE)
endfunction()
if(VLA_CUDA)
  vla_fetch_cuda(vla_nvcc nvcc)
  find_program(VLA_PYTHON NAMES python3 REQUIRED)
endif()
if(VLA_CUDA_GGML)
  vla_fetch_cuda(vla_cuda_toolkit cuda)
  set(CMAKE_CUDA_COMPILER ${vla_cuda_toolkit}/bin/nvcc)
  set(CUDAToolkit_ROOT ${vla_cuda_toolkit})
  if(NOT DEFINED CMAKE_CUDA_ARCHITECTURES)
    set(CMAKE_CUDA_ARCHITECTURES 80-virtual)  # the driver compiles the rest of the way, for any device from Ampere on
  endif()
  enable_language(CUDA)
  set(GGML_CUDA_GRAPHS ON CACHE BOOL "" FORCE)
  set(GGML_CUDA_NCCL OFF CACHE BOOL "" FORCE)
  set(GGML_CUDA_NO_VMM ON CACHE BOOL "" FORCE)  # it would need the driver at link time
endif()
add_subdirectory(${vla_ggml_tree} ${CMAKE_BINARY_DIR}/ggml EXCLUDE_FROM_ALL)
# Training, a reader of GGUF, and formats that no bundle uses: nothing calls them.
foreach(target ggml-base ggml-cpu)
  get_target_property(sources ${target} SOURCES)
  list(FILTER sources EXCLUDE REGEX "(^|/)(ggml-opt|gguf|repack)[.]cpp$")
  set_property(TARGET ${target} PROPERTY SOURCES ${sources})
  if(VLA_SANITIZE MATCHES address)  # its tensors lie side by side in one piece of memory, inside which it sees nothing
    target_compile_options(${target} PRIVATE -fno-sanitize=all)
  endif()
endforeach()
target_compile_options(ggml-base PRIVATE -O1)  # it makes graphs, once
# Where a driver fails, ggml's abort is an exception that leaves its functions (src/ggml/guard.h).
target_compile_options(ggml-base PRIVATE $<$<COMPILE_LANGUAGE:C>:-fexceptions>)
foreach(target ggml ggml-base ggml-cpu)  # its headers are not ours to warn about
  get_target_property(headers ${target} INTERFACE_INCLUDE_DIRECTORIES)
  if(headers)
    set_target_properties(${target} PROPERTIES INTERFACE_SYSTEM_INCLUDE_DIRECTORIES "${headers}")
  endif()
endforeach()

# Debian packages: README.md lists them, `make packages` installs them.
find_package(fmt REQUIRED)
find_package(nlohmann_json REQUIRED)
find_package(JPEG REQUIRED)
find_package(PNG REQUIRED)
find_package(Threads REQUIRED)
find_path(VLA_CLI11_DIR CLI/CLI.hpp REQUIRED)
find_path(VLA_XXHASH_DIR xxhash.h REQUIRED)
find_library(VLA_XXHASH_LIBRARY xxhash REQUIRED)
find_path(VLA_UTF8PROC_DIR utf8proc.h REQUIRED)
find_library(VLA_UTF8PROC_LIBRARY utf8proc REQUIRED)

if(VLA_BUILD_SERVER)
  # The wire: the schema is compiled at build time, and the server needs the small runtime of Protobuf only.
  find_package(Protobuf REQUIRED)
  find_package(cppzmq REQUIRED)  # replay's client
  find_library(VLA_SODIUM_LIBRARY sodium REQUIRED)
  # What watches the server: metrics and the HTTP that shows them.
  find_path(VLA_PROMETHEUS_DIR prometheus/registry.h REQUIRED)
  find_library(VLA_PROMETHEUS_LIBRARY prometheus-cpp-core REQUIRED)
  find_path(VLA_BOOST_DIR boost/beast/http.hpp REQUIRED)  # Asio and Beast, headers only
  find_path(VLA_MSGPACK_DIR msgpack.hpp REQUIRED)         # headers only
  find_path(VLA_NGHTTP2_DIR nghttp2/nghttp2.h REQUIRED)  # LeRobot's protocol
  find_library(VLA_NGHTTP2_LIBRARY nghttp2 REQUIRED)
endif()
