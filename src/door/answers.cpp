// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Answers to calls: one gRPC message, or a status with its text.
// Source: gRPC, doc/PROTOCOL-HTTP2.md.
#include <fmt/format.h>

#include <cstring>

#include "base/printable.h"
#include "door/connection.h"

namespace vla::door {
namespace {

constexpr std::size_t kMaxWords = 2000;  // characters of an error's text
constexpr auto kReceiptPatience = std::chrono::seconds(60);

/// gRPC status codes.
int status_of(Code code) {
  switch (code) {
    case Code::bad_request:
    case Code::bad_observation:
    case Code::too_large:
      return 3;  // INVALID_ARGUMENT
    case Code::incompatible:
      return 9;  // FAILED_PRECONDITION
    case Code::unsupported:
      return 12;  // UNIMPLEMENTED
    case Code::busy:
    case Code::out_of_memory:
      return 8;  // RESOURCE_EXHAUSTED
    case Code::late:
    case Code::superseded:
      return 10;  // ABORTED
    case Code::shutting_down:
      return 14;  // UNAVAILABLE
    default:
      return 13;  // INTERNAL
  }
}

std::string percent_encoded(std::string_view text) {
  std::string out;
  for (const char c : text.substr(0, kMaxWords)) {
    if (c >= ' ' && c <= '~' && c != '%') {
      out += c;
    } else {
      out += fmt::format("%{:02X}", static_cast<unsigned char>(c));
    }
  }
  return out;
}

/// nghttp2 copies both.
nghttp2_nv header(std::string_view name, std::string_view value) {
  const auto bytes = [](std::string_view text) {
    return reinterpret_cast<std::uint8_t*>(const_cast<char*>(text.data()));
  };
  return {bytes(name), bytes(value), name.size(), value.size(), NGHTTP2_NV_FLAG_NONE};
}

}  // namespace

void Connection::answer(Call& call, const std::string& message) {
  guard([&] {
    if (!take(call)) return;
    const auto size = static_cast<std::uint32_t>(message.size());
    call.answer = {'\0', static_cast<char>(size >> 24), static_cast<char>(size >> 16), static_cast<char>(size >> 8),
                   static_cast<char>(size)};
    call.answer += message;
    const nghttp2_nv headers[] = {header(":status", "200"), header("content-type", "application/grpc")};
    nghttp2_data_provider body = {};
    body.source.ptr = &call;
    body.read_callback = read_answer;
    nghttp2_submit_response(session_, call.stream, headers, std::size(headers), &body);
    flush();
  });
}

void Connection::refuse(Call& call, const Error& error) {
  guard([&] {
    if (!take(call)) return;
    const std::string status = std::to_string(status_of(error.code));
    const std::string words = percent_encoded(fmt::format("{}: {}", code_name(error.code), printable(error.message())));
    const nghttp2_nv headers[] = {header(":status", "200"), header("content-type", "application/grpc"),
                                  header("grpc-status", status), header("grpc-message", words)};
    nghttp2_submit_response(session_, call.stream, headers, std::size(headers), nullptr);
    flush();
  });
}

ssize_t Connection::read_answer(nghttp2_session* session, std::int32_t stream, std::uint8_t* to, std::size_t size,
                                std::uint32_t* flags, nghttp2_data_source* source, void*) {
  Call& call = *static_cast<Call*>(source->ptr);
  const std::size_t n = std::min(size, call.answer.size() - call.n_sent);
  std::memcpy(to, call.answer.data() + call.n_sent, n);
  call.n_sent += n;
  if (call.n_sent < call.answer.size()) return static_cast<ssize_t>(n);
  *flags |= NGHTTP2_DATA_FLAG_EOF | NGHTTP2_DATA_FLAG_NO_END_STREAM;
  const nghttp2_nv trailer = header("grpc-status", "0");
  if (nghttp2_submit_trailer(session, stream, &trailer, 1) != 0) return NGHTTP2_ERR_TEMPORAL_CALLBACK_FAILURE;
  return static_cast<ssize_t>(n);
}

void Connection::sent_last(std::int32_t stream) {
  if (Call* const call = find(stream); call != nullptr && !call->has_ended)
    nghttp2_submit_rst_stream(session_, NGHTTP2_FLAG_NONE, stream, NGHTTP2_NO_ERROR);
}

void Connection::closed(std::int32_t stream) {
  if (Call* const call = find(stream)) end(*call);
}

void Connection::received(Call& call) {
  hold(call, -static_cast<std::ptrdiff_t>(call.n_held));
  served_ = shared_.loop.now();
}

bool Connection::take(Call& call) {
  if (std::exchange(call.is_answered, true)) return false;
  shared_.calls.erase(call.id);
  hold(call, -static_cast<std::ptrdiff_t>(call.n_held));
  call.message = {}, call.framed = {};
  return true;
}

void Connection::end(Call& call) {
  const bool was_waiting = take(call) && call.is_handed_over;
  const std::uint64_t id = call.id;
  --shared_.n_call;
  calls_.erase(call.stream);
  if (was_waiting) shared_.handler->cancelled(id);
}

void Connection::refuse_late() {
  std::vector<std::int32_t> late;
  for (const auto& [stream, call] : calls_)
    if (!call->is_whole && !call->is_answered && shared_.loop.now() - call->began > kReceiptPatience)
      late.push_back(stream);
  for (const std::int32_t stream : late)  // sending a refusal may end other calls
    if (Call* const call = find(stream)) refuse(*call, {Code::late, "call", "a whole message within 60 s", "a part"});
}

}  // namespace vla::door
