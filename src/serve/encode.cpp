// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Answers, from what the engine gives to their messages.
#include "processor/unicode.h"
#include "serve/codec.h"
#include "serve/envelope.h"

namespace vla::serve {
namespace {

/// A key that every bundle which the engine opened has: Processor::create and Engine::load have checked it.
std::string text(const Engine& engine, const char* key) {
  const auto value = engine.bundle().keys().string(key);
  return value ? *value : std::string();
}

std::vector<std::string> texts(const Engine& engine, const char* key) {
  const auto value = engine.bundle().keys().strings(key);
  return value ? *value : std::vector<std::string>();
}

/// Protobuf's text is UTF-8, which a file name need not be.
std::string utf8(std::string bytes) {
  for (std::size_t bad = 0; (bad += unicode::valid_prefix(std::string_view(bytes).substr(bad))) < bytes.size();)
    bytes[bad] = '?';
  return bytes;
}

void describe_views(const Engine& engine, v1::Description& out) {
  const auto aliases = texts(engine, "observation.view_aliases");
  const auto optional = engine.bundle().keys().integers("observation.view_optional", kFlag);
  const Processor& processor = engine.processor();
  for (std::size_t i = 0; i < processor.views().names().size(); ++i) {
    v1::ViewSpec& view = *out.add_views();
    view.set_name(processor.views().names()[i]);
    if (!aliases[i].empty()) view.add_aliases(aliases[i]);
    view.set_optional((*optional)[i] != 0);
    view.set_width(static_cast<std::uint32_t>(processor.recipe().width));
    view.set_height(static_cast<std::uint32_t>(processor.recipe().height));
  }
  out.set_min_views(static_cast<std::uint32_t>(processor.min_views()));
}

void describe_states(const Engine& engine, v1::Description& out) {
  const auto names = texts(engine, "observation.state_names"), units = texts(engine, "observation.state_units");
  const Processor& processor = engine.processor();
  std::size_t at = 0;
  for (std::size_t i = 0; i < processor.states().names().size(); ++i) {
    v1::StateSpec& state = *out.add_states();
    state.set_name(processor.states().names()[i]);
    for (int k = 0; k < processor.state_dims()[i]; ++k, ++at) {
      v1::Dimension& dimension = *state.add_dimensions();
      dimension.set_name(names[at]);
      dimension.set_unit(units[at]);
    }
  }
}

void describe_actions(const Engine& engine, v1::Description& out) {
  const auto units = texts(engine, "action.units");
  for (std::size_t i = 0; i < engine.processor().action_names().size(); ++i) {
    v1::Dimension& dimension = *out.add_actions();
    dimension.set_name(engine.processor().action_names()[i]);
    dimension.set_unit(units[i]);
  }
  out.set_horizon(static_cast<std::uint32_t>(engine.n_row()));
  out.set_rate_hz(*engine.bundle().keys().number("action.rate_hz", kRateHz));
}

void describe_bundle(const Engine& engine, v1::Bundle& out) {
  const std::string& path = engine.bundle().path();
  out.set_name(utf8(path.substr(path.rfind('/') + 1)));
  out.set_arch(text(engine, "vla.arch"));
  out.set_checksum(text(engine, "vla.checksum"));
  out.set_dtype(text(engine, "vla.dtype"));
  out.set_source_name(text(engine, "vla.source.name"));
  out.set_source_revision(text(engine, "vla.source.revision"));
  out.set_converter(text(engine, "vla.source.converter"));
}

}  // namespace

v1::Description describe(const Engine& engine, const v1::Limits& limits) {
  v1::Description out;
  describe_views(engine, out);
  describe_states(engine, out);
  describe_actions(engine, out);
  out.set_d_noise(static_cast<std::uint32_t>(engine.d_action()));
  out.set_noise_rows(static_cast<std::uint32_t>(engine.horizon()));
  out.set_noise_kind(engine.solver().noise);
  out.set_max_text_tokens(static_cast<std::uint32_t>(engine.processor().recipe().max_tokens));
  *out.mutable_limits() = limits;
  describe_bundle(engine, *out.mutable_bundle());
  v1::Runtime& runtime = *out.mutable_runtime();
  runtime.set_server_version(VLA_VERSION);
  runtime.set_device(engine.device().name());
  runtime.set_precision(engine.precision());
  runtime.set_kernels(engine.kernels());
  return out;
}

v1::ActionChunk encode_chunk(const ActRequest& request, ActionChunk chunk, const v1::Description& description) {
  v1::ActionChunk out;
  out.set_horizon(static_cast<std::uint32_t>(chunk.horizon));
  out.set_d_action(static_cast<std::uint32_t>(chunk.d_action));
  out.mutable_actions()->Add(chunk.actions.begin(), chunk.actions.end());
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

v1::Response response_to(std::uint64_t request_id) {
  v1::Response response;
  response.set_protocol_version(kMaxVersion);
  response.set_request_id(request_id);
  return response;
}

}  // namespace vla::serve
