// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstring>
#include <string_view>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/rows.h"
#include "lower/cuda/emit.h"

namespace vla::lower {
namespace {

template <class Job>
Job job_of(const Call& call) {
  Job job;
  std::memcpy(&job, call.job.data(), sizeof(job));
  return job;
}

/// Whether an operation is a product of one matrix in strips, without split depth.
bool is_strip(const Calls& calls) {
  if (calls.size() != 1 || !std::string_view(calls[0].how.kernel).starts_with("linear_strip_")) return false;
  const auto job = job_of<cuda::LinearBf16Job>(calls[0]);
  return job.n_split == 1 && job.gate_weight == nullptr;
}
bool is_heads(const Calls& calls) { return calls.size() == 1 && calls[0].how.kernel == std::string_view("head_rows"); }
/// The Hopper tile of a bf16 product, if a kernel computes several products with this tile and no other operation adds
/// the product's shares; else null.
const cuda::HopperTile* tile_of(const Calls& calls) {
  const std::string_view kernel = calls[0].how.kernel;
  const auto* tile = std::ranges::find(cuda::kHopperTiles, kernel, &cuda::HopperTile::kernel);
  if (tile == std::end(cuda::kHopperTiles) || tile->several == nullptr) return nullptr;
  return (job_of<cuda::LinearBf16Job>(calls[0]).partial != nullptr) == (calls.size() == 2) ? tile : nullptr;
}

/// Merges operations for which `fits` holds and that agree with the first one (`agrees`), up to kMostJobs at a time.
/// `merged` makes the calls of the merged jobs and fills in where each job ends.
template <class Job, class Fits, class Agrees, class Merged>
void merge(std::vector<Calls>& phase, Fits fits, Agrees agrees, Merged merged) {
  for (std::size_t first = 0; first < phase.size(); ++first) {
    if (!fits(phase[first])) continue;
    cuda::Several<Job> several = {};
    several.job[several.n++] = job_of<Job>(phase[first][0]);
    for (std::size_t i = first + 1; i < phase.size() && several.n < cuda::kMostJobs;) {
      if (!fits(phase[i]) || !agrees(phase[first], phase[i])) {
        ++i;
        continue;
      }
      several.job[several.n++] = job_of<Job>(phase[i][0]);
      phase.erase(phase.begin() + static_cast<std::ptrdiff_t>(i));
    }
    if (several.n > 1) phase[first] = merged(phase[first], several);
  }
}

/// Whether two products have the same rows, depth and shares.
bool are_alike(const Calls& a, const Calls& b) {
  const auto one = job_of<cuda::LinearBf16Job>(a[0]), other = job_of<cuda::LinearBf16Job>(b[0]);
  return one.n_row == other.n_row && one.depth == other.depth && one.n_split == other.n_split &&
         (one.partial == nullptr) == (other.partial == nullptr);
}

/// Whether two products in strips may be one launch: if it rotates, all must have a multiple of four columns.
bool may_share_strips(const Calls& a, const Calls& b) {
  const auto one = job_of<cuda::LinearBf16Job>(a[0]), other = job_of<cuda::LinearBf16Job>(b[0]);
  const bool rotates = one.rotation.table != nullptr || other.rotation.table != nullptr;
  return are_alike(a, b) && (!rotates || (one.n_column | other.n_column) % 4 == 0);
}

}  // namespace

void merge_calls(std::vector<Calls>& phase, int n_sm) {
  using Products = cuda::Several<cuda::LinearBf16Job>;
  merge<cuda::LinearBf16Job>(phase, is_strip, may_share_strips, [&](const Calls&, Products& jobs) {
    std::int64_t n_column = 0;
    for (int i = 0; i < jobs.n; ++i) n_column += jobs.job[i].n_column;
    const unsigned width = common_width(jobs.job[0].n_row, n_column, jobs.job[0].depth, n_sm);
    const cuda::Launch how = cuda::linear_strips(width, jobs);
    return Calls{call(how, jobs)};
  });
  merge<cuda::LinearBf16Job>(
      phase, [](const Calls& calls) { return tile_of(calls) != nullptr; },
      [](const Calls& a, const Calls& b) { return tile_of(a) == tile_of(b) && are_alike(a, b); },
      [](const Calls& first, Products& jobs) {
        const cuda::Launch product = cuda::hopper_linears_bf16(*tile_of(first), jobs);
        Calls calls = {call(product, jobs)};
        if (jobs.job[0].partial == nullptr) return calls;
        const cuda::Launch finish = cuda::finish_bf16_partials(jobs);
        calls.push_back(call(finish, jobs));
        return calls;
      });
  merge<cuda::HeadJob>(
      phase, is_heads, [](const Calls&, const Calls&) { return true; },
      [](const Calls&, cuda::Several<cuda::HeadJob>& jobs) {
        const cuda::Launch how = cuda::several_head_rows(jobs);
        return Calls{call(how, jobs)};
      });
}

}  // namespace vla::lower
