// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Decodes requests into the engine's inputs.
#include <fmt/format.h>

#include <array>
#include <string_view>

#include "processor/image_codecs.h"
#include "processor/picture.h"
#include "processor/unicode.h"
#include "serve/array.h"
#include "serve/native/codec.h"
#include "serve/native/seen.h"
#include "wire/fields.h"

namespace vla::serve {
namespace {

using wire::Fields;
using wire::not_a_request;

constexpr std::size_t kMaxName = 256;  // bytes; errors quote the name

Error bad_observation(std::string where, std::string expected, std::string found) {
  return {Code::bad_observation, std::move(where), std::move(expected), std::move(found)};
}

Error too_large(std::string where, std::string expected, std::string found) {
  return {Code::too_large, std::move(where), std::move(expected), std::move(found),
          "Description.limits has all limits"};
}

std::span<const std::byte> bytes_of(const std::string& text) { return std::as_bytes(std::span(text)); }

std::string_view text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

struct Row {
  std::string_view types;
  const char* names = "";  // the field that errors about names refer to
};

/// The fields of a message in the order of their numbers, from 1: v is a varint, u a varint of 32 bits, b bytes, t
/// text, n a name, f floats (packed or not), d a double, c a count, and a digit a message, by the index of its own row.
constexpr std::array<Row, 10> kFields = {{
    {"15t3vvv7nn9", "embodiment"},  // 0 Act: views, states, text, noise, seed, capture_time_ns, deadline_ms, leftover,
                                    // embodiment, policy, loop
    {"n2bb4", "views"},             // 1 View: name, rgb, jpeg, png, absent
    {"uub"},                        // 2 RawRgb: width, height, rows
    {"uuf"},                        // 3 Noise: horizon, d_action, values
    {""},                           // 4 Absent
    {"nf", "states"},               // 5 State: name, values
    {"uutt"},                       // 6 Hello: min_version, max_version, client_name, client_version
    {"uufund", "leftover.schedule"},  // 7 Leftover: n_row, d_action, values, delay, schedule, max_guidance
    {"n", "policy"},                  // 8 Describe: policy
    {"ucccccc"},                      // 9 LoopState: driver, actions, human, held, missed, limited, refused
}};

/// Whether a field that was read is encoded as its type says.
bool fits(const Fields& field, char type) {
  if (type == 'v') return field.type == 'v';
  if (type == 'u') return field.type == 'v' && field.varint <= ~std::uint32_t{0};       // Protobuf would cut it off
  if (type == 'c') return field.type == 'v' && field.varint <= std::uint64_t{1} << 53;  // exact in JSON
  if (type == 'd') return field.type == 'd';
  return field.type == 'b' || (type == 'f' && field.type == 'f');
}

/// Checks the size of a text before anything reads it.
Status check_size(const Fields& text, bool is_name, const char* names, std::size_t max_text) {
  const std::size_t most = is_name ? kMaxName : max_text, size = text.value.size();
  if (size <= most) return {};
  return too_large(is_name ? names : "instruction", fmt::format("{}at most {} bytes", is_name ? "names of " : "", most),
                   fmt::format("{} bytes", size));
}

/// Checks that a message has only known fields, each in its own encoding. Protobuf would skip any other field, although
/// the field might change the answer: a seed in a wrong encoding would become a fresh one.
Status check_fields(std::span<const std::byte> bytes, std::size_t row, const char* where, std::size_t max_text) {
  const auto& [types, names] = kFields[row];
  for (Fields field(bytes, where);;) {
    VLA_TRY(const bool more, field.next());
    if (!more) return {};
    const auto index = static_cast<std::size_t>(field.number) - 1;
    if (index >= types.size() || !fits(field, types[index])) return field.unknown();
    const char type = types[index];
    if (type == 't' || type == 'n') {
      VLA_CHECK(check_size(field, type == 'n', names, max_text));
      if (unicode::valid_prefix(text_of(field.value)) < field.value.size())
        return not_a_request(where, "text in UTF-8", fmt::format("field {} with other bytes", field.number));
    }
    if (type >= '0' && type <= '9')
      VLA_CHECK(check_fields(field.value, static_cast<std::size_t>(type - '0'), where, max_text));
  }
}

template <class Message>
Result<Message> parse(std::span<const std::byte> bytes, std::size_t row, const char* where, std::size_t max_text = 0) {
  VLA_CHECK(check_fields(bytes, row, where, max_text));
  Message message;
  if (!message.ParseFromArray(bytes.data(), static_cast<int>(bytes.size())))
    return not_a_request(where, "a serialized message", "bytes that do not parse as one");
  return message;
}

ImageLimits image_limits(const ActLimits& limits) { return {limits.max_pixels, Code::too_large}; }

Result<Frame> decode_raw(const v1::RawRgb& raw, const std::string& where, const ActLimits& limits) {
  const std::int64_t width = raw.width(), height = raw.height();
  VLA_CHECK(codecs::check_size(width, height, where, image_limits(limits)));
  VLA_TRY(const ElementType bytes, ElementType::read("|u1", where));
  VLA_TRY(const Array array, Array::make(bytes, {height, width, 3}, raw.rows(), where));
  const std::string_view rows = array.data();
  return Frame{static_cast<int>(width), static_cast<int>(height), std::vector<std::uint8_t>(rows.begin(), rows.end())};
}

Result<Frame> decode_file(const std::string& file, bool is_format, const char* format, const std::string& where,
                          const ActLimits& limits) {
  if (!is_format) return bad_observation(where, format, "bytes that do not begin as one");
  return decode_image(bytes_of(file), where, image_limits(limits));
}

Result<std::optional<Frame>> decode_view(const v1::View& view, const std::string& where, const ActLimits& limits) {
  std::optional<Frame> frame;
  switch (view.image_case()) {
    case v1::View::kRgb: {
      VLA_TRY(frame, decode_raw(view.rgb(), where, limits));
      break;
    }
    case v1::View::kJpeg: {
      VLA_TRY(frame, decode_file(view.jpeg(), codecs::is_jpeg(bytes_of(view.jpeg())), "a JPEG file", where, limits));
      break;
    }
    case v1::View::kPng: {
      VLA_TRY(frame, decode_file(view.png(), codecs::is_png(bytes_of(view.png())), "a PNG file", where, limits));
      break;
    }
    case v1::View::kAbsent:
      break;
    case v1::View::IMAGE_NOT_SET:
      return bad_observation(where, "one of rgb, jpeg, png, absent", "none of them");
  }
  return frame;
}

Result<codecs::ImageHeader> read_header(const v1::View& view, const std::string& where, const ActLimits& limits) {
  if (view.has_jpeg() || view.has_png())
    return codecs::read_header(bytes_of(view.has_jpeg() ? view.jpeg() : view.png()), where, image_limits(limits));
  const std::int64_t width = view.rgb().width(), height = view.rgb().height();
  VLA_CHECK(codecs::check_size(width, height, where, image_limits(limits)));
  return codecs::ImageHeader{static_cast<int>(width), static_cast<int>(height), width * height};
}

/// Subtracts an image's cost from `left`, the budget that an act's images share.
Status check_cost(const v1::View& view, const std::string& where, ActLimits& left) {
  if (view.has_absent() || view.image_case() == v1::View::IMAGE_NOT_SET) return {};
  VLA_TRY(const codecs::ImageHeader header, read_header(view, where, left));
  return spend(left, header.width, header.height, header.work, where);
}

Status decode_views(const v1::Act& act, const ActLimits& limits, const FeatureNames& features,
                    Observation& observation) {
  if (static_cast<std::size_t>(act.views_size()) > limits.max_views)
    return too_large("views", fmt::format("at most {} views", limits.max_views), std::to_string(act.views_size()));
  ActLimits left = limits;
  for (const v1::View& view : act.views()) {  // checks all views before it decodes an image
    VLA_CHECK(check_cost(view, features.place(view.name()), left));
  }
  for (const v1::View& view : act.views()) {
    const std::string where = features.place(view.name());
    if (observation.views.contains(view.name())) return bad_observation(where, "each view once", "a second one");
    VLA_TRY(std::optional<Frame> frame, decode_view(view, where, limits));
    observation.views.emplace(view.name(), std::move(frame));
  }
  return {};
}

Status decode_states(const v1::Act& act, const FeatureNames& features, Observation& observation) {
  for (const v1::State& state : act.states()) {
    std::vector<float> values(state.values().begin(), state.values().end());
    if (!observation.states.emplace(state.name(), std::move(values)).second)
      return bad_observation(features.place(state.name()), "each state once", "a second one");
  }
  return {};
}

Status decode_start(const v1::Act& act, const ActLimits& limits, ActRequest& request) {
  if (!act.has_noise()) {
    request.seed = act.has_seed() ? act.seed() : fresh_seed();
    request.noise = *request.seed;
    return {};
  }
  const v1::Noise& noise = act.noise();
  const auto n_row = static_cast<std::uint32_t>(limits.noise_rows),
             d_noise = static_cast<std::uint32_t>(limits.d_noise);
  if (noise.horizon() != n_row || noise.d_action() != d_noise)
    return bad_observation("noise", fmt::format("{} rows of {}", n_row, d_noise),
                           fmt::format("{} rows of {}", noise.horizon(), noise.d_action()));
  request.noise = std::vector<float>(noise.values().begin(), noise.values().end());  // the engine checks the values
  return {};
}

/// Checks the shape of the leftover. The engine checks its values, but cannot see whether rows and columns are swapped.
Status decode_leftover(const v1::Act& act, const ActLimits& limits, ActRequest& request) {
  if (!act.has_leftover()) return {};
  const v1::Leftover& given = act.leftover();
  const auto d_action = static_cast<std::uint32_t>(limits.d_action),
             horizon = static_cast<std::uint32_t>(limits.horizon);
  if (given.d_action() != d_action || given.n_row() > horizon || given.delay() > horizon ||
      static_cast<std::uint64_t>(given.values_size()) != std::uint64_t{given.n_row()} * d_action)
    return bad_observation("leftover", fmt::format("at most {} rows of {}", horizon, d_action),
                           fmt::format("{} rows of {}, {} numbers, a delay of {}", given.n_row(), given.d_action(),
                                       given.values_size(), given.delay()));
  request.leftover = {
      {given.values().begin(), given.values().end()}, static_cast<int>(given.delay()), given.schedule(), {}};
  if (given.has_max_guidance()) request.leftover->max_guidance = given.max_guidance();
  return {};
}

}  // namespace

Result<ActRequest> decode_act(std::span<const std::byte> bytes, const ActLimits& limits, const FeatureNames& views,
                              const FeatureNames& states) {
  VLA_TRY(v1::Act act, parse<v1::Act>(bytes, 0, "act", limits.max_text));
  ActRequest request;
  if (act.has_text()) request.observation.text = std::move(*act.mutable_text());
  request.observation.embodiment = std::move(*act.mutable_embodiment());
  request.capture_time_ns = act.capture_time_ns();
  VLA_CHECK(decode_views(act, limits, views, request.observation));
  VLA_CHECK(decode_states(act, states, request.observation));
  VLA_CHECK(decode_start(act, limits, request));
  VLA_CHECK(decode_leftover(act, limits, request));
  if (const int driver = act.loop().driver();
      act.has_loop() && driver != v1::LoopState::POLICY && driver != v1::LoopState::PERSON)
    return bad_observation("loop.driver", "POLICY or PERSON", std::to_string(driver));
  return request;
}

Result<Frame> seen(const v1::Act& act, int view, const Engine& engine, std::int64_t max_pixels) {
  VLA_TRY(const Robot* robot, engine.robot(act.embodiment()));
  const Processor& processor = robot->processor();
  const v1::View& given = act.views(view);
  VLA_TRY(const int place, processor.views().find(given.name()));
  const std::string& name = processor.views().names()[static_cast<std::size_t>(place)];
  const ActLimits limits = {.max_pixels = max_pixels, .fit = processor.recipe().fit.get()};
  ActLimits left = limits;
  VLA_CHECK(check_cost(given, name, left));
  VLA_TRY(const std::optional<Frame> frame, decode_view(given, name, limits));
  if (!frame) return bad_observation(name, "an image", "none");
  return picture_of(processor, *frame, place);
}

Result<std::string> read_describe(std::span<const std::byte> describe) {
  VLA_TRY(v1::Describe parsed, parse<v1::Describe>(describe, 8, "describe"));
  return std::move(*parsed.mutable_policy());
}

Result<std::string> named_embodiment(std::span<const std::byte> act) {
  std::string tag;
  for (Fields field(act, "act");;) {
    VLA_TRY(const bool more, field.next());
    if (!more) return tag;
    if (field.number != v1::Act::kEmbodimentFieldNumber || field.type != 'b') continue;
    VLA_CHECK(check_size(field, true, "embodiment", 0));
    tag = text_of(field.value);
  }
}

Result<v1::HelloReply> answer_hello(std::span<const std::byte> bytes, std::string* client) {
  constexpr std::size_t kMaxHello = 4096, kMaxName = 64;
  if (bytes.size() > kMaxHello)
    return too_large("hello", fmt::format("at most {} bytes", kMaxHello), fmt::format("{} bytes", bytes.size()));
  VLA_TRY(const v1::Hello hello, parse<v1::Hello>(bytes, 6, "hello", kMaxHello));
  if (hello.min_version() < 1 || hello.max_version() < hello.min_version())
    return Error{Code::bad_request, "hello", "versions with 1 <= min_version <= max_version",
                 fmt::format("{} to {}", hello.min_version(), hello.max_version())};
  if (hello.max_version() < wire::kMinVersion || hello.min_version() > wire::kMaxVersion)
    return wire::incompatible(hello.min_version(), hello.max_version());
  if (client != nullptr)
    *client = (hello.client_name() + (hello.client_version().empty() ? "" : " ") + hello.client_version())
                  .substr(0, kMaxName);
  v1::HelloReply reply;
  reply.set_min_version(wire::kMinVersion);
  reply.set_max_version(wire::kMaxVersion);
  reply.set_server_name("vla");
  reply.set_server_version(VLA_VERSION);
  for (const char* feature : {"leftover", "embodiment", "policy", "loop"}) reply.add_features(feature);
  return reply;
}

Status check_empty(std::span<const std::byte> body) {
  if (body.empty()) return {};
  return Error{Code::bad_request, "request", "an empty Describe or Health", fmt::format("{} bytes", body.size())};
}

}  // namespace vla::serve
