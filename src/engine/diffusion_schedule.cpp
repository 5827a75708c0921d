// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// The build compiles this file with -ffp-contract=off, so every operation rounds once on every machine.
#include "engine/diffusion_schedule.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <numbers>

namespace vla {
namespace {

constexpr int kMaxTrainSteps = 100'000;
constexpr Range kBeta = {0, 1};

Error bad(const char* key, std::string expected, std::string found) {
  return {Code::bad_bundle, key, std::move(expected), std::move(found),
          "this bundle needs a newer vla, or was not made by vla-convert"};
}

struct Betas {
  std::string schedule;
  double start = 0, end = 0;
};

/// torch.linspace: the second half is counted from the end.
float evenly(double start, double end, int i, int n) {
  const auto first = static_cast<float>(start), last = static_cast<float>(end);
  if (n == 1) return first;
  const float step = (last - first) / static_cast<float>(n - 1);
  return i < n / 2 ? first + step * static_cast<float>(i) : last - step * static_cast<float>(n - i - 1);
}

float beta(const Betas& of, int i, int n) {
  if (of.schedule == "linear") return evenly(of.start, of.end, i, n);
  if (of.schedule == "scaled_linear") {
    const float root = evenly(std::sqrt(of.start), std::sqrt(of.end), i, n);
    return root * root;
  }
  if (of.schedule == "sigmoid") {
    const auto range = static_cast<float>(of.end - of.start), start = static_cast<float>(of.start);
    return 1.0f / (1.0f + std::exp(-evenly(-6, 6, i, n))) * range + start;
  }
  const auto alpha_bar = [n](int k) {  // squaredcos_cap_v2
    const double root = std::cos((static_cast<double>(k) / n + 0.008) / 1.008 * std::numbers::pi / 2);
    return root * root;
  };
  return static_cast<float>(std::min(1 - alpha_bar(i + 1) / alpha_bar(i), 0.999));
}

/// Products of 1 - beta up to each training step. torch accumulates the product in double and rounds each result to
/// float32.
std::vector<float> cumulative_alphas(const Betas& betas, int n) {
  std::vector<float> alphas;
  double product = 1;
  for (int i = 0; i < n; ++i) {
    product *= static_cast<double>(1.0f - beta(betas, i, n));
    alphas.push_back(static_cast<float>(product));
  }
  return alphas;
}

/// `alpha`, `next`: cumulative alphas at the times of this step and of the next one; 1 after the last step.
DiffusionSchedule::Step step_between(int time, float alpha, float next, const DiffusionSchedule& of) {
  DiffusionSchedule::Step step = {time, 0, 0, 0, 0, 0};
  const float beta = 1.0f - alpha, next_beta = 1.0f - next;
  step.p = std::sqrt(of.predicts_noise ? beta : alpha);
  step.q = 1.0f / std::sqrt(of.predicts_noise ? alpha : beta);
  if (!of.draws) {
    step.of_sample = std::sqrt(next), step.of_rest = std::sqrt(next_beta);
    return step;
  }
  const float current_alpha = alpha / next, current_beta = 1.0f - current_alpha;
  step.of_sample = std::sqrt(next) * current_beta / beta;
  step.of_rest = std::sqrt(current_alpha) * next_beta / beta;
  if (time > 0) step.of_drawn = std::sqrt(std::max(next_beta / beta * current_beta, 1e-20f));
  return step;
}

}  // namespace

Result<DiffusionSchedule> DiffusionSchedule::read(const Keys& keys, bool draws, int n_step) {
  DiffusionSchedule of;
  Betas betas;
  of.draws = draws;
  VLA_TRY(const int n_train, keys.integer("solver.n_train_step", {1, kMaxTrainSteps}));
  VLA_TRY(betas.schedule, keys.string("solver.beta_schedule"));
  VLA_TRY(betas.start, keys.number("solver.beta_start", kBeta));
  VLA_TRY(betas.end, keys.number("solver.beta_end", kBeta));
  VLA_TRY(const std::string predicts, keys.string("solver.predicts"));
  VLA_TRY(const double clip, keys.number("solver.clip", {0, 1e9}));
  const bool known = betas.schedule == "linear" || betas.schedule == "scaled_linear" ||
                     betas.schedule == "squaredcos_cap_v2" || (draws && betas.schedule == "sigmoid");
  if (!known)
    return bad(
        "solver.beta_schedule",
        draws ? "linear, scaled_linear, squaredcos_cap_v2 or sigmoid" : "linear, scaled_linear or squaredcos_cap_v2",
        betas.schedule);
  if (predicts != "noise" && predicts != "sample") return bad("solver.predicts", "noise or sample", predicts);
  if (n_step > n_train)
    return bad("solver.steps", fmt::format("at most the {} of solver.n_train_step", n_train), std::to_string(n_step));
  of.predicts_noise = predicts == "noise", of.clip = static_cast<float>(clip);
  const std::vector<float> alphas = cumulative_alphas(betas, n_train);
  const int stride = n_train / n_step;
  for (int k = n_step - 1; k >= 0; --k) {
    const int time = k * stride;
    const float next = k > 0 ? alphas[static_cast<std::size_t>(time - stride)] : 1.0f;
    const Step step = step_between(time, alphas[static_cast<std::size_t>(time)], next, of);
    for (const float number : {step.p, step.q, step.of_sample, step.of_rest, step.of_drawn})
      if (!std::isfinite(number))
        return bad("solver.beta_schedule", "betas between 0 and 1", fmt::format("no finite step at time {}", time));
    of.steps.push_back(step);
  }
  return of;
}

}  // namespace vla
