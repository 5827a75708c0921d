// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "zmtp/session.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <string_view>
#include <utility>

#include "base/out_of_memory.h"

namespace vla::zmtp {
namespace {

constexpr unsigned kMore = 1, kLong = 2, kCommand = 4;   // flags of a frame
constexpr unsigned kMoreInside = 1, kCommandInside = 2;  // flags inside a CURVE box
constexpr int kMaxFrames = 1024;                         // frames of a refused message that are skipped
constexpr std::size_t kMaxEnvelope = 8;                  // frames of an envelope
constexpr std::size_t kMaxAddress = 255;                 // bytes of an envelope's frame, as in ZeroMQ
constexpr std::size_t kGreeting = 64, kMaxCommand = 4096;
constexpr std::size_t kStep = 256 << 10;     // most bytes read at once, so that connections take turns
constexpr std::size_t kPrefix = 64;          // bytes kept of a refused message: enough for its number
constexpr std::uint64_t kMaxSkip = 1 << 30;  // bytes of a refused frame that are skipped
constexpr std::string_view kSignature("\xff\0\0\0\0\0\0\0\0\x7f", 10);

Error ended(const char* why, std::string expected, std::string found) {
  return {Code::bad_request, why, std::move(expected), std::move(found)};
}

Error several_frames() {
  return {Code::bad_request, "request", "one frame, behind an empty one where others come first", "several",
          "see docs/protocol.md"};
}

std::string_view text_of(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

std::string greeting(bool with_keys) {
  std::string text(kSignature);
  text.append("\x03\x01", 2).append(with_keys ? "CURVE" : "NULL").resize(32);
  text += with_keys ? '\1' : '\0';  // as-server
  text.resize(kGreeting);
  return text;
}

/// A property's value in metadata: names have a length of one byte, values one of four.
std::optional<std::string_view> property(std::string_view metadata, std::string_view name) {
  while (!metadata.empty()) {
    const std::size_t n_name = static_cast<unsigned char>(metadata[0]);
    if (metadata.size() < 1 + n_name + 4) return std::nullopt;
    const std::string_view found = metadata.substr(1, n_name);
    metadata.remove_prefix(1 + n_name);
    std::size_t n_value = 0;
    for (std::size_t i = 0; i < 4; ++i) n_value = n_value << 8 | static_cast<unsigned char>(metadata[i]);
    if (metadata.size() - 4 < n_value) return std::nullopt;
    if (found == name) return metadata.substr(4, n_value);
    metadata.remove_prefix(4 + n_value);
  }
  return std::nullopt;
}

Status check_peer(std::string_view metadata) {
  const auto type = property(metadata, "Socket-Type");
  if (type == "DEALER" || type == "REQ" || type == "ROUTER") return {};
  return ended("handshake", "a DEALER or REQ socket", "another one");
}

}  // namespace

Session::Session(std::size_t max_message, const CurveKeys* keys) : max_message_(max_message) {
  if (keys != nullptr) curve_.emplace(*keys);
  output_ = greeting(keys != nullptr);
}

std::size_t Session::n_held() const {
  const std::size_t of_frame = in_frame_ ? std::min<std::size_t>(frame_.size(), got_) : 0;
  return of_frame + (message_ ? message_->bytes.size() : 0);
}

std::span<std::byte> Session::room() {
  filling_frame_ = in_frame_ && begin_ == end_ && frame_.size() == size_;
  if (filling_frame_) return frame_.span().subspan(got_).first(std::min<std::size_t>(size_ - got_, kStep));
  std::copy(staging_.begin() + static_cast<std::ptrdiff_t>(begin_),
            staging_.begin() + static_cast<std::ptrdiff_t>(end_), staging_.begin());
  end_ -= std::exchange(begin_, 0);
  return std::span(staging_).subspan(end_);
}

void Session::filled(std::size_t n) { (filling_frame_ ? got_ : end_) += n; }

Result<std::optional<Message>> Session::next() {
  for (;;) {
    if (state_ == State::greeting) {
      const std::string_view came = text_of(staged());
      const bool is_zmtp = (came.empty() || came[0] == kSignature[0]) &&
                           (came.size() < 10 || came[9] == kSignature[9]) &&
                           (came.size() < 11 || came[10] >= 3);  // the bytes between may have any value
      if (!is_zmtp) return ended("handshake", "a greeting of ZMTP 3", "other bytes");
      if (came.size() < kGreeting) return std::optional<Message>();
      VLA_CHECK(greet());
    }
    if (!in_frame_) {
      VLA_TRY(const bool begun, begin_frame());
      if (!begun) return std::optional<Message>();
    }
    fill_frame();
    if (got_ < size_) return std::optional<Message>();
    in_frame_ = false;
    VLA_TRY(std::optional<Message> message, end_frame());
    if (message) return message;
  }
}

Status Session::greet() {
  const std::string wanted = greeting(curve_.has_value());
  if (text_of(staged()).substr(12, 20) != std::string_view(wanted).substr(12, 20))
    return ended("handshake", curve_ ? "a client with keys" : "a client without keys", "another one");
  begin_ += kGreeting;
  state_ = State::handshake;
  if (!curve_) put(output_, std::string_view("\x05READY\x0bSocket-Type\0\0\0\x06ROUTER", 28), kCommand);
  return {};
}

/// Reads a frame's header: flags, and a size of one or eight bytes. False if it is incomplete.
Result<bool> Session::begin_frame() {
  const std::span<const std::byte> came = staged();
  if (came.empty()) return false;
  flags_ = std::to_integer<unsigned>(came[0]);
  if (flags_ > 7 || (flags_ & (kMore | kCommand)) == (kMore | kCommand))
    return ended("protocol", "flags of a frame", fmt::format("{:#x}", flags_));
  const std::size_t n_header = (flags_ & kLong) != 0 ? 9 : 2;
  if (came.size() < n_header) return false;
  size_ = 0;
  for (std::size_t i = 1; i < n_header; ++i) size_ = size_ << 8 | std::to_integer<std::uint64_t>(came[i]);
  begin_ += n_header;
  VLA_CHECK(choose_memory());
  in_frame_ = true;
  got_ = 0;
  return true;
}

Status Session::choose_memory() {
  const bool is_command = (flags_ & kCommand) != 0, is_plain = is_open() && (curve_ || !is_command);
  if (!is_open() && !is_command) return ended("handshake", "a command", "a message");
  if (size_ > (is_plain ? kMaxSkip : kMaxCommand))
    return ended("size", "a frame that can be", fmt::format("one of {} bytes", size_));
  const std::size_t limit = max_message_ + (curve_ ? CurveSession::kOverhead + 1 : 0);
  std::optional<Error> refused;
  if (is_plain && !curve_ && is_addressed() && size_ > kMaxAddress) refuse_several();
  if (is_plain && n_part_ > 0 && !curve_) {
    refused = several_frames();
  } else if (is_plain && size_ > limit) {
    refused = Error{Code::too_large, "request", fmt::format("at most {} bytes", max_message_), fmt::format("{}", size_),
                    "send smaller or compressed images"};
  }
  const auto keep = [&](std::uint64_t n) {
    std::optional<net::Bytes> bytes = net::Bytes::make(n);
    if (bytes) frame_ = std::move(*bytes);
    return bytes.has_value();
  };
  // A box must be complete before it can be decrypted.
  if (refused && curve_ && size_ > limit) return ended("size", refused->expected, refused->found);
  if (!refused && !keep(size_)) {
    if (curve_) return ended("memory", fmt::format("{} bytes", size_), "no memory");
    refused = out_of_memory("request");
  }
  if (!refused) return {};
  if (!message_) message_.emplace();
  if (!message_->refused) message_->refused = std::move(refused);
  if (!curve_) {
    if (!keep(std::min<std::uint64_t>(size_, n_part_ > 0 ? 0 : kPrefix))) frame_ = {};
  } else if (!keep(size_)) {
    return ended("memory", fmt::format("{} bytes", size_), "no memory");
  }
  return {};
}

void Session::fill_frame() {
  const std::span<std::byte> came = staged();
  const std::size_t n = std::min<std::uint64_t>(came.size(), size_ - got_);
  if (got_ < frame_.size())
    std::copy_n(came.begin(), std::min<std::size_t>(n, frame_.size() - got_),
                frame_.span().begin() + static_cast<std::ptrdiff_t>(got_));
  got_ += n;
  begin_ += n;
}

Result<std::optional<Message>> Session::end_frame() {
  if (state_ == State::handshake) {
    VLA_CHECK(handshake(frame_.span()));
    return std::optional<Message>();
  }
  bool more = (flags_ & kMore) != 0, is_command = (flags_ & kCommand) != 0;
  if (curve_) {
    VLA_CHECK(curve_->open(frame_.span()));
    const auto inside = std::to_integer<unsigned>(frame_.span()[CurveSession::kOverhead]);
    frame_.narrow(CurveSession::kOverhead + 1, frame_.size() - CurveSession::kOverhead - 1);
    more = (inside & kMoreInside) != 0, is_command = (inside & kCommandInside) != 0;
    size_ = frame_.size();
  }
  if (is_command) {
    VLA_CHECK(heartbeat(frame_.span()));
    return std::optional<Message>();
  }
  if (++n_frame_ > kMaxFrames && more)
    return ended("protocol", fmt::format("at most {} frames in a message", kMaxFrames), "more");
  return end_part(more);
}

Status Session::handshake(std::span<const std::byte> command) {
  if (!curve_) {
    constexpr std::string_view kReady("\x05READY", 6);
    if (!text_of(command).starts_with(kReady)) return ended("handshake", "READY", "another command");
    VLA_CHECK(check_peer(text_of(command).substr(kReady.size())));
    state_ = State::open;
    return {};
  }
  VLA_TRY(const CurveSession::Reply reply, curve_->handshake(command));
  put(output_, reply.command, kCommand);
  if (reply.refused) return ended("key", "the key of a client that is listed", curve_->client_key());
  if (!curve_->is_open()) return {};
  VLA_CHECK(check_peer(reply.metadata));
  state_ = State::open;
  return {};
}

/// PING: two bytes of time to live, and a context that PONG returns.
Status Session::heartbeat(std::span<const std::byte> command) {
  constexpr std::string_view kPing("\x04PING", 5), kPong("\x04PONG", 5);
  const std::string_view text = text_of(command);
  if (text.starts_with(kPong)) return {};
  if (!text.starts_with(kPing) || text.size() < 7 || text.size() > 7 + 16)
    return ended("protocol", "PING or PONG", "another command");
  put(output_, std::string(kPong).append(text.substr(7)), kCommand);
  return {};
}

/// Whether frames of an envelope have arrived, but not yet the empty frame that ends it.
bool Session::is_addressed() const {
  return message_ && !message_->envelope.empty() && !message_->envelope.back().empty();
}

/// The frames that looked like an envelope belong to the message. The first one contains the message's number.
void Session::refuse_several() {
  const std::string first = std::exchange(message_->envelope, {}).front();
  if (std::optional<net::Bytes> bytes = net::Bytes::make(first.size())) {
    std::copy_n(std::as_bytes(std::span(first)).begin(), first.size(), bytes->span().begin());
    message_->bytes = std::move(*bytes);
  }
  message_->size = first.size();
  message_->refused = several_frames();
  n_part_ = 1;
}

/// Returns the message once its last frame is complete.
std::optional<Message> Session::end_part(bool more) {
  if (!message_) message_.emplace();
  Envelope& envelope = message_->envelope;
  const bool may_be_address = size_ <= kMaxAddress && envelope.size() < kMaxEnvelope && !message_->refused;
  if (n_part_ == 0 && more && may_be_address && (envelope.empty() || is_addressed())) {
    envelope.emplace_back(text_of(frame_.span()));
    return std::nullopt;
  }
  if (n_part_ == 0 && is_addressed()) refuse_several();
  if (n_part_ == 0) {
    message_->bytes = std::exchange(frame_, {});
    message_->size = size_;
    n_part_ = 1;
  } else if (!message_->refused) {  // the flag of an encrypted frame, readable only now
    message_->refused = several_frames();
  }
  if (more) return std::nullopt;
  n_part_ = n_frame_ = 0;
  return std::exchange(message_, std::nullopt);
}

void Session::put(std::string& out, std::string_view content, unsigned flags) {
  std::string sealed;
  if (curve_ && is_open()) {
    std::string inside(1, static_cast<char>(((flags & kMore) != 0 ? kMoreInside : 0) |
                                            ((flags & kCommand) != 0 ? kCommandInside : 0)));
    sealed = curve_->seal(inside.append(content));
    content = sealed;
    flags = 0;
  }
  if (content.size() <= 255) {
    out += static_cast<char>(flags);
    out += static_cast<char>(content.size());
  } else {
    out += static_cast<char>(flags | kLong);
    for (int shift = 56; shift >= 0; shift -= 8) out += static_cast<char>(content.size() >> shift);
  }
  out += content;
}

std::string Session::pack(std::string_view content, const Envelope& envelope) {
  std::string out;
  out.reserve(content.size() + 64);
  for (const std::string& frame : envelope) put(out, frame, kMore);
  put(out, content, 0);
  return out;
}

std::string Session::ping() {
  std::string out;
  put(out, std::string_view("\x04PING\0\0", 7), kCommand);
  return out;
}

}  // namespace vla::zmtp
