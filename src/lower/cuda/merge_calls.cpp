// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/merge_calls.h"

#include <algorithm>
#include <cstring>
#include <string_view>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/rows.h"
#include "lower/cuda/cuda_lowering.h"

namespace vla::lower {
namespace {

template <class Job>
Job job_of(const Call& call) {
  Job job;
  std::memcpy(&job, call.job.data(), sizeof(job));
  return job;
}
template <class Job>
Call call_of(const cuda::Launch& how, const Job& job) {
  const auto* bytes = reinterpret_cast<const std::byte*>(&job);
  return {how, {bytes, bytes + sizeof(job)}};
}

/// Whether an operation is a product of one matrix in strips, without split depth.
bool is_strip(const Calls& calls) {
  if (calls.size() != 1 || !std::string_view(calls[0].how.kernel).starts_with("linear_strip_")) return false;
  const auto job = job_of<cuda::LinearBf16Job>(calls[0]);
  return job.n_split == 1 && job.gate_weight == nullptr;
}
bool is_heads(const Calls& calls) { return calls.size() == 1 && calls[0].how.kernel == std::string_view("head_rows"); }

/// Merges operations for which `fits` holds and `agrees` with the first, up to kMost at a time.
template <class Job, class Fits, class Agrees, class Launch>
void merge(std::vector<Calls>& phase, Fits fits, Agrees agrees, Launch launch) {
  for (std::size_t first = 0; first < phase.size(); ++first) {
    if (!fits(phase[first])) continue;
    cuda::Several<Job> several = {};
    several.job[several.n++] = job_of<Job>(phase[first][0]);
    for (std::size_t i = first + 1; i < phase.size() && several.n < cuda::kMostJobs;) {
      if (!fits(phase[i]) || !agrees(several.job[0], job_of<Job>(phase[i][0]))) {
        ++i;
        continue;
      }
      several.job[several.n++] = job_of<Job>(phase[i][0]);
      phase.erase(phase.begin() + static_cast<std::ptrdiff_t>(i));
    }
    if (several.n == 1) continue;
    const cuda::Launch how = launch(several);  // fills in where each job ends
    phase[first] = {call_of(how, several)};
  }
}

}  // namespace

void merge_calls(std::vector<Calls>& phase, int n_sm) {
  merge<cuda::LinearBf16Job>(
      phase, is_strip, [](const auto& a, const auto& b) { return a.n_row == b.n_row && a.depth == b.depth; },
      [&](cuda::Several<cuda::LinearBf16Job>& jobs) {
        std::int64_t n_column = 0;
        for (int i = 0; i < jobs.n; ++i) n_column += jobs.job[i].n_column;
        return cuda::linear_strips(common_width(jobs.job[0].n_row, n_column, jobs.job[0].depth, n_sm), jobs);
      });
  merge<cuda::HeadJob>(
      phase, is_heads, [](const auto&, const auto&) { return true; },
      [](cuda::Several<cuda::HeadJob>& jobs) { return cuda::several_head_rows(jobs); });
}

}  // namespace vla::lower
