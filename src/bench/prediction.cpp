// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/prediction.h"

#include <fmt/format.h>

#include <nlohmann/json.hpp>
#include <optional>

#include "policies/policy.h"

namespace vla::bench {
namespace {

constexpr double kMs = 1e3;

Result<RandomBundle> make_zeros(const Request& request) {
  VLA_TRY(const PolicyEntry entry, find_policy(request.arch));
  RandomSizes sizes = random_sizes(request);
  sizes.is_filled = false;
  return RandomBundle::make(request.arch, entry.published(), sizes);
}

}  // namespace

Program::Prediction GpuPrediction::total() const {
  Program::Prediction sum;
  for (const auto& [stage, prediction] : stages) sum += prediction;
  return sum;
}

Result<GpuPrediction> predict(const Request& request, const std::string& model) {
  std::optional<RandomBundle> zeros;
  if (request.bundle.empty()) {
    VLA_TRY(RandomBundle made, make_zeros(request));
    zeros.emplace(std::move(made));
  }
  VLA_TRY(const std::unique_ptr<Engine> engine,
          Engine::load(zeros ? zeros->path() : request.bundle, {.kernels = request.kernels,
                                                                .model = model,
                                                                .device = request.device,
                                                                .dry = true,
                                                                .embodiment = request.embodiment}));
  if (!request.steps.empty()) VLA_CHECK(engine->set_steps(request.steps.back()));
  const Robot& robot = engine->robot();
  const InputShape shape = robot.largest_shape();
  GpuPrediction found;
  found.policy = *robot.bundle().keys().string("vla.arch"), found.device = engine->device().name();
  found.linear_kernels = engine->linear_kernels();
  found.n_view = static_cast<int>(shape.n_view), found.n_text = static_cast<int>(shape.n_text);
  found.n_step = robot.solver().n_step, found.memory = engine->memory().total();
  VLA_TRY(found.stages, engine->predict());
  return found;
}

std::string to_text(const GpuPrediction& prediction) {
  std::string text = fmt::format(
      "prediction, not a measurement: {} on a {}\n{} views, {} tokens, {} steps; {}; {:.2f} GB\n\n"
      "{:<10} {:>9} {:>9} {:>9} {:>9}  {}\n",
      prediction.policy, prediction.device, prediction.n_view, prediction.n_text, prediction.n_step,
      prediction.linear_kernels, 1e-9 * static_cast<double>(prediction.memory), "stage", "ms", "products", "memory",
      "launches", "kernels");
  const auto add = [&](const std::string& stage, const Program::Prediction& of) {
    text += fmt::format("{:<10} {:>9.2f} {:>9.2f} {:>9.2f} {:>9.2f}  {}\n", stage, kMs * of.seconds, kMs * of.products,
                        kMs * of.bytes, kMs * of.launches, of.n_launch);
  };
  for (const auto& [stage, of] : prediction.stages) add(stage, of);
  add("total", prediction.total());
  return text;
}

std::string to_json(const GpuPrediction& prediction) {
  using Json = nlohmann::ordered_json;
  Json stages = Json::object();
  const auto add = [&](const std::string& stage, const Program::Prediction& of) {
    stages[stage] = {{"ms", kMs * of.seconds},
                     {"products_ms", kMs * of.products},
                     {"memory_ms", kMs * of.bytes},
                     {"launches_ms", kMs * of.launches},
                     {"n_kernel", of.n_launch}};
  };
  for (const auto& [stage, of] : prediction.stages) add(stage, of);
  add("total", prediction.total());
  return Json{{"prediction", true},
              {"policy", prediction.policy},
              {"device", prediction.device},
              {"linear_kernels", prediction.linear_kernels},
              {"n_view", prediction.n_view},
              {"n_text", prediction.n_text},
              {"n_step", prediction.n_step},
              {"memory_bytes", prediction.memory},
              {"stages", stages}}
      .dump();
}

}  // namespace vla::bench
