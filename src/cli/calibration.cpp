// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cli/calibration.h"

#include "observe/recording.h"
#include "serve/native/codec.h"

namespace vla::cli {
namespace {

/// The act of a record that was answered with a chunk, with the answer's seed; none for other records.
std::optional<v1::Act> answered_act(const observe::Recording::Record& record) {
  v1::Request request;
  v1::Response response;
  if (!request.ParseFromString(record.request) || !request.has_act()) return std::nullopt;
  if (!response.ParseFromString(record.response) || !response.has_chunk()) return std::nullopt;
  if (request.act().start_case() == v1::Act::START_NOT_SET) request.mutable_act()->set_seed(response.chunk().seed());
  return request.act();
}

Result<observe::Recording> open_recording(const std::string& folder, const Bundle& bundle) {
  VLA_TRY(observe::Recording recording, observe::Recording::open(folder));
  VLA_TRY(const std::string arch, bundle.keys().string("vla.arch"));
  if (const std::string& recorded = recording.description().bundle().arch(); recorded != arch)
    return Error{Code::bad_request, folder, "a recording of " + arch, "one of " + recorded};
  return recording;
}

Result<std::size_t> count(const std::string& folder, const Bundle& bundle) {
  VLA_TRY(observe::Recording recording, open_recording(folder, bundle));
  for (std::size_t n = 0;;) {
    VLA_TRY(const auto record, recording.next());
    if (!record) return n;
    n += answered_act(*record).has_value();
  }
}

Result<Judged> decode(const v1::Act& act, const Engine& engine) {
  VLA_TRY(const Robot* robot, engine.robot(act.embodiment()));
  const std::string bytes = act.SerializeAsString();
  const serve::ServerOptions limits;
  VLA_TRY(serve::ActRequest request,
          serve::decode_act(std::as_bytes(std::span(bytes)), serve::act_limits(limits, *robot),
                            robot->processor().views(), robot->processor().states()));
  return Judged{std::move(request.observation), std::move(request.noise)};
}

}  // namespace

Result<std::vector<Judged>> read_observations(const std::string& folder, const std::string& path, std::size_t n_most) {
  VLA_TRY(const Bundle bundle, Bundle::open(path));
  VLA_TRY(const std::size_t n, count(folder, bundle));
  if (n == 0) return Error{Code::bad_request, folder, "acts that were answered with a chunk", "none"};
  VLA_TRY(const std::unique_ptr<Engine> engine, Engine::load(path, {.dry = true, .all_robots = true}));
  VLA_TRY(observe::Recording recording, open_recording(folder, bundle));
  std::vector<Judged> judged;
  const std::size_t n_wanted = std::min(n, n_most);
  for (std::size_t i = 0; judged.size() < n_wanted;) {
    VLA_TRY(const auto record, recording.next());
    if (!record) break;
    const std::optional<v1::Act> act = answered_act(*record);
    if (!act || i++ != judged.size() * n / n_wanted) continue;
    Result<Judged> one = decode(*act, *engine);
    if (!one) return Error{Code::bad_request, folder, "acts of this policy", one.error().message()};
    judged.push_back(std::move(*one));
  }
  return judged;
}

}  // namespace vla::cli
