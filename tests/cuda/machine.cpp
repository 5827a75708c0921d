// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/machine.h"

#include <cstdlib>
#include <fstream>
#include <sstream>

#include "cuda/emulation.h"
#include "cuda/fake_driver.h"
#include "cuda/fault.h"
#include "cuda/ptx.h"

namespace vla::test::cuda {
namespace {

std::vector<std::string> read_texts() {
  std::vector<std::string> all;
  const char* files = std::getenv("VLA_CUDA_PTX");
  std::istringstream names(files == nullptr ? "" : files);
  for (std::string name; std::getline(names, name, ':');) {
    std::ifstream in(name);
    if (!in) throw Fault("cannot read " + name);
    std::ostringstream text;
    text << in.rdbuf();
    all.push_back(text.str());
  }
  return all;
}
const std::vector<std::string>& texts() {
  static const std::vector<std::string> all = read_texts();
  return all;
}

const std::vector<PtxModule>& modules() {
  static const std::vector<PtxModule> all = [] {
    std::vector<PtxModule> loaded;
    for (const std::string& text : texts()) loaded.emplace_back(text);
    return loaded;
  }();
  return all;
}

}  // namespace

bool runs_ptx() { return !modules().empty(); }
bool is_hopper() { return true; }
double bf16_sum_error(int) { return 0; }
std::vector<std::string> modules_of_tests() { return runs_ptx() ? texts() : std::vector<std::string>{kHostModule}; }

vla::cuda::TensorMap map_rows(const vla::cuda::MappedRows& of) {
  vla::cuda::TensorMap map = {};
  const Status made = vla::cuda::map_rows(tensor_map_driver(), of, map);
  if (!made.ok()) throw Fault(made.error().message());
  return map;
}

vla::cuda::TensorMap map_heads(const vla::cuda::MappedHeads& of) {
  vla::cuda::TensorMap map = {};
  const Status made = vla::cuda::map_heads(tensor_map_driver(), of, map);
  if (!made.ok()) throw Fault(made.error().message());
  return map;
}

void launch(const vla::cuda::Launch& how, const void* job, std::size_t job_size) {
  const std::string name = how.kernel;
  const auto refuse = [&](const std::string& why) { throw Fault(name + ": " + why); };
  const vla::cuda::Grid& grid = how.grid;
  if (grid.x == 0 || grid.y == 0 || grid.z == 0) refuse("a grid without blocks");
  if (grid.y > vla::cuda::kMaxGridYZ || grid.z > vla::cuda::kMaxGridYZ)
    refuse("more blocks in y or z than a grid may have");
  if (how.shared > (name.starts_with("hopper_") ? vla::cuda::kHopperShared : vla::cuda::kMaxShared))
    refuse("more shared memory than every device has");
  if (how.cluster == 0 || how.cluster > vla::cuda::kMaxCluster || grid.z % how.cluster != 0)
    refuse("a cluster that no device has, or that does not divide the grid");
  device_memory().begin_launch();
  const Extent extent = {grid.x, grid.y, grid.z, how.cluster};
  for (const PtxModule& module : modules())
    if (const PtxKernel* kernel = module.find(name)) {
      if (kernel->param_size != job_size) refuse("a job of another size");
      return run_ptx(*kernel, extent, how.n_thread, how.shared, job);
    }
  const Entry* entry = find_entry(how.kernel);
  if (entry == nullptr || runs_ptx()) refuse("no kernel of this name");
  if (entry->job_size != job_size) refuse("a job of another size");
  run_entry(*entry, extent, how.n_thread, how.shared, job);
}

}  // namespace vla::test::cuda
