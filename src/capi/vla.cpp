// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The functions of include/vla/vla.h: they translate and decide nothing.
#include <vla/vla.h>

#include <mutex>

#include "capi/description.h"
#include "capi/last_error.h"
#include "capi/observation.h"
#include "capi/structs.h"
#include "engine/engine.h"

struct vla_policy {
  vla_policy(std::unique_ptr<vla::Engine> loaded, bool rejects_out_of_range)
      : engine(std::move(loaded)), strict_state(rejects_out_of_range), description(describe_robots(*engine)) {}
  static std::vector<vla::Description> describe_robots(const vla::Engine& engine) {
    std::vector<vla::Description> robots;
    for (const vla::Robot* robot : engine.robots()) robots.push_back(vla::describe(engine, *robot));
    return robots;
  }
  std::unique_ptr<vla::Engine> engine;
  bool strict_state;
  vla::capi::Description description;
  std::mutex mutex;  // the engine answers one observation at a time
};

struct vla_chunk {
  vla::ActionChunk answer;
  double queue_ms = 0;
};

namespace vla::capi {
namespace {

static_assert(VLA_INTERNAL == exit_code(Code::internal) && VLA_USAGE == exit_code(Code::usage) &&
              VLA_BAD_BUNDLE == exit_code(Code::bad_bundle) &&
              VLA_BAD_OBSERVATION == exit_code(Code::bad_observation) &&
              VLA_BAD_ACTION == exit_code(Code::bad_action) && VLA_UNSUPPORTED == exit_code(Code::unsupported) &&
              VLA_OUT_OF_MEMORY == exit_code(Code::out_of_memory) && VLA_DEVICE == exit_code(Code::device) &&
              VLA_IO == exit_code(Code::io));

constexpr int kMaxThread = 512;

struct Options {
  EngineOptions engine;
  bool strict_state = false;
};

Result<Options> read_options(const vla_options* given) {
  if (given == nullptr) return Options{{.all_robots = true}};
  VLA_TRY(const vla_options known, read_struct<vla_options>(given, "options"));
  if (known.n_thread < 0 || known.n_thread > kMaxThread)
    return usage("options.n_thread", fmt::format("0 to {}", kMaxThread), std::to_string(known.n_thread));
  if (known.strict_state != 0 && known.strict_state != 1)
    return usage("options.strict_state", "0 or 1", std::to_string(known.strict_state));
  Options options{{.n_thread = known.n_thread, .all_robots = true, .memory = static_cast<std::size_t>(known.memory)},
                  known.strict_state == 1};
  if (known.kernels != nullptr) {
    VLA_TRY(options.engine.kernels, read_name(known.kernels, "options.kernels"));
  }
  if (known.device != nullptr) {
    VLA_TRY(options.engine.device, read_name(known.device, "options.device"));
  }
  if (known.embodiment != nullptr) {
    VLA_TRY(options.engine.embodiment, read_name(known.embodiment, "options.embodiment"));
  }
  return options;
}

Status open(const char* path, const vla_options* options, vla_policy** out) {
  if (out == nullptr) return usage("out", "a place for the policy", "NULL");
  *out = nullptr;
  VLA_TRY(const std::string file, read_name(path, "path"));
  VLA_TRY(const Options known, read_options(options));
  VLA_TRY(std::unique_ptr<Engine> engine, Engine::load(file, known.engine));
  *out = new vla_policy(std::move(engine), known.strict_state);
  return {};
}

/// Decodes images before it takes the engine's lock, so that callers wait for the engine only.
Status act(vla_policy* policy, const vla_observation* observation, vla_chunk** out) {
  if (out == nullptr) return usage("out", "a place for the chunk", "NULL");
  *out = nullptr;
  if (policy == nullptr) return usage("policy", "an open policy", "NULL");
  auto chunk = std::make_unique<vla_chunk>();
  StageClock clock;
  Timing before, queue;
  VLA_TRY(Request request, read_observation(observation, *policy->engine));
  request.observation.reject_out_of_range = policy->strict_state;
  clock.lap(before, "decode");
  const std::lock_guard<std::mutex> turn(policy->mutex);
  clock.lap(queue, "queue");
  VLA_TRY(chunk->answer, policy->engine->act(request.observation, request.noise, request.leftover));
  Timing& timing = chunk->answer.timing;
  timing.insert(timing.begin(), before.begin(), before.end());
  chunk->queue_ms = queue.front().second;
  *out = chunk.release();
  return {};
}

/// The i-th stage, or nothing.
const std::pair<std::string, double>* stage(const vla_chunk* chunk, std::size_t i) {
  return chunk != nullptr && i < chunk->answer.timing.size() ? &chunk->answer.timing[i] : nullptr;
}

}  // namespace
}  // namespace vla::capi

using namespace vla::capi;

uint32_t vla_abi_version(void) { return VLA_ABI_VERSION; }
const char* vla_version(void) { return VLA_VERSION; }
const vla_error* vla_last_error(const vla_policy* policy) { return last_error(policy); }

vla_status vla_open(const char* path, const vla_options* options, vla_policy** out) {
  return guarded(nullptr, [&] { return vla::capi::open(path, options, out); });
}
void vla_policy_close(vla_policy* policy) { delete policy; }
const vla_description* vla_describe(const vla_policy* policy) {
  return policy == nullptr ? nullptr : policy->description.get();
}

vla_status vla_act(vla_policy* policy, const vla_observation* observation, vla_chunk** out) {
  return guarded(policy, [&] { return vla::capi::act(policy, observation, out); });
}
void vla_chunk_close(vla_chunk* chunk) { delete chunk; }

const float* vla_chunk_actions(const vla_chunk* chunk) { return chunk ? chunk->answer.actions.data() : nullptr; }
const float* vla_chunk_normalized(const vla_chunk* chunk) { return chunk ? chunk->answer.normalized.data() : nullptr; }
size_t vla_chunk_horizon(const vla_chunk* chunk) { return chunk ? static_cast<std::size_t>(chunk->answer.horizon) : 0; }
size_t vla_chunk_d_action(const vla_chunk* chunk) {
  return chunk ? static_cast<std::size_t>(chunk->answer.d_action) : 0;
}
size_t vla_chunk_n_note(const vla_chunk* chunk) { return chunk ? chunk->answer.notes.size() : 0; }
const char* vla_chunk_note(const vla_chunk* chunk, size_t i) {
  return i < vla_chunk_n_note(chunk) ? chunk->answer.notes[i].c_str() : nullptr;
}
size_t vla_chunk_n_stage(const vla_chunk* chunk) { return chunk ? chunk->answer.timing.size() : 0; }
const char* vla_chunk_stage_name(const vla_chunk* chunk, size_t i) {
  const auto* found = stage(chunk, i);
  return found ? found->first.c_str() : nullptr;
}
double vla_chunk_stage_ms(const vla_chunk* chunk, size_t i) {
  const auto* found = stage(chunk, i);
  return found ? found->second : 0.0;
}
double vla_chunk_queue_ms(const vla_chunk* chunk) { return chunk ? chunk->queue_ms : 0.0; }
