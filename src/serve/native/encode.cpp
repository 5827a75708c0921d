// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Encodes the engine's results as messages.
#include "engine/description.h"
#include "processor/unicode.h"
#include "serve/native/codec.h"

namespace vla::serve {
namespace {

/// Replaces invalid bytes by `?`: Protobuf's text must be UTF-8, and a file name may be anything.
std::string utf8(std::string bytes) {
  for (std::size_t bad = 0; (bad += unicode::valid_prefix(std::string_view(bytes).substr(bad))) < bytes.size();)
    bytes[bad] = '?';
  return bytes;
}

std::uint32_t u32(int count) { return static_cast<std::uint32_t>(count); }

void add_number(const Description::Number& number, v1::Dimension& out) {
  out.set_name(number.name);
  out.set_unit(number.unit);
}

void write_features(const Description& d, v1::Description& out) {
  for (const Description::View& view : d.views) {
    v1::ViewSpec& spec = *out.add_views();
    spec.set_name(view.name);
    if (!view.alias.empty()) spec.add_aliases(view.alias);
    spec.set_optional(view.optional);
    spec.set_width(u32(view.width));
    spec.set_height(u32(view.height));
    spec.set_camera_width(u32(view.camera_width));
    spec.set_camera_height(u32(view.camera_height));
  }
  out.set_min_views(u32(d.min_views));
  for (const Description::State& state : d.states) {
    v1::StateSpec& spec = *out.add_states();
    spec.set_name(state.name);
    for (const Description::Number& number : state.numbers) add_number(number, *spec.add_dimensions());
  }
  for (const Description::Number& action : d.actions) add_number(action, *out.add_actions());
}

void write_bundle(const Description& d, v1::Bundle& out) {
  out.set_name(utf8(d.path.substr(d.path.rfind('/') + 1)));
  out.set_arch(d.arch);
  out.set_checksum(d.checksum);
  out.set_dtype(d.dtype);
  out.set_source_name(d.source);
  out.set_source_revision(d.revision);
  out.set_converter(d.converter);
}

/// Writes the part that is the same for all robots.
void write_common(const Description& d, const v1::Limits& limits, v1::Description& out) {
  *out.mutable_limits() = limits;
  write_bundle(d, *out.mutable_bundle());
  v1::Runtime& runtime = *out.mutable_runtime();
  runtime.set_server_version(VLA_VERSION);
  runtime.set_device(d.device);
  runtime.set_precision(d.precision);
  runtime.set_kernels(d.kernels);
}

void write_robot(const Description& d, v1::Description& out) {
  write_features(d, out);
  out.set_horizon(u32(d.horizon));
  out.set_rate_hz(d.rate_hz);
  out.set_n_action_steps(u32(d.n_action_steps));
  if (d.rtc.execution_horizon > 0) {
    out.mutable_rtc()->set_execution_horizon(u32(d.rtc.execution_horizon));
    out.mutable_rtc()->set_schedule(d.rtc.schedule);
    out.mutable_rtc()->set_max_guidance(d.rtc.max_guidance);
  }
  out.set_d_noise(u32(d.d_action_padded));
  out.set_noise_rows(u32(d.noise_rows));
  out.set_noise_kind(d.noise);
  out.set_real_time_chunking(d.real_time_chunking);
  out.set_embodiment(d.embodiment);
  out.set_max_text_tokens(u32(d.max_text_tokens));
}

}  // namespace

v1::Description describe(const Engine& engine, const v1::Limits& limits) {
  v1::Description out;
  const std::vector<const Robot*> robots = engine.robots();
  for (const Robot* robot : robots) {
    const Description d = vla::describe(engine, *robot);
    v1::Description& own = robots.size() > 1 ? *out.add_embodiments() : out;
    write_common(d, limits, own);
    write_robot(d, own);
    if (robots.size() > 1) write_common(d, limits, out);
  }
  return out;
}

const v1::Description& description_of(const v1::Description& all, const std::string& embodiment) {
  for (const v1::Description& robot : all.embodiments())
    if (robot.embodiment() == embodiment) return robot;
  return all;
}

v1::ActionChunk encode_chunk(Reply reply, const v1::Description& description) {
  const ActRequest& request = reply.request;
  ActionChunk& chunk = reply.chunk;
  v1::ActionChunk out;
  out.set_horizon(static_cast<std::uint32_t>(chunk.horizon));
  out.set_d_action(static_cast<std::uint32_t>(chunk.d_action));
  out.mutable_actions()->Add(chunk.actions.begin(), chunk.actions.end());
  if (!description.real_time_chunking().empty())
    out.mutable_normalized()->Add(chunk.normalized.begin(), chunk.normalized.end());
  for (const v1::Dimension& action : description.actions()) out.add_names(action.name());
  out.set_rate_hz(description.rate_hz());
  out.set_capture_time_ns(request.capture_time_ns);
  if (request.seed) out.set_seed(*request.seed);
  for (std::string& note : chunk.notes) out.add_notes(std::move(note));
  double total = 0;
  for (const auto& [name, ms] : chunk.timing) {
    v1::Stage& stage = *out.add_stages();
    stage.set_name(name);
    stage.set_ms(ms);
    total += ms;
  }
  out.set_engine_ms(total);
  out.set_queue_ms(reply.queue_ms);
  *out.mutable_bundle() = description.bundle();
  *out.mutable_runtime() = description.runtime();
  return out;
}

v1::Error encode_error(const Error& error) {
  v1::Error out;
  out.set_code(static_cast<v1::Error::Code>(exit_code(error.code)));
  out.set_where(utf8(error.where));
  out.set_expected(utf8(error.expected));
  out.set_found(utf8(error.found));
  out.set_hint(utf8(error.hint));
  return out;
}

Record record_of(std::uint64_t request_id, const Reply& reply, const v1::Description& description) {
  const ActRequest& given = reply.request;
  v1::Request request;
  request.set_protocol_version(wire::kMaxVersion);
  request.set_request_id(request_id);
  v1::Act& act = *request.mutable_act();
  for (const auto& [name, frame] : given.observation.views) {
    v1::View& view = *act.add_views();
    view.set_name(name);
    const auto* rows = frame ? std::get_if<std::vector<std::uint8_t>>(&frame->rgb) : nullptr;
    if (rows == nullptr) {
      view.mutable_absent();
      continue;
    }
    view.mutable_rgb()->set_width(u32(frame->width));
    view.mutable_rgb()->set_height(u32(frame->height));
    view.mutable_rgb()->set_rows(rows->data(), rows->size());
  }
  for (const auto& [name, values] : given.observation.states) {
    v1::State& state = *act.add_states();
    state.set_name(name);
    state.mutable_values()->Add(values.begin(), values.end());
  }
  if (given.observation.text) act.set_text(*given.observation.text);
  if (given.seed) act.set_seed(*given.seed);
  act.set_embodiment(given.observation.embodiment);
  v1::Response response = response_to(request_id);
  *response.mutable_chunk() = encode_chunk(reply, description);
  return {request.SerializeAsString(), response.SerializeAsString()};
}

std::string refusal(std::uint64_t request_id, const Error& error) {
  v1::Response response = response_to(request_id);
  *response.mutable_error() = encode_error(error);
  return response.SerializeAsString();
}

v1::Response response_to(std::uint64_t request_id) {
  v1::Response response;
  response.set_protocol_version(wire::kMaxVersion);
  response.set_request_id(request_id);
  return response;
}

}  // namespace vla::serve
