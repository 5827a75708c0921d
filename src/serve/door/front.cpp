// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/door/front.h"

#include <fmt/format.h>
#include <poll.h>

#include <new>

#include "base/out_of_memory.h"
#include "base/printable.h"
#include "serve/io.h"
#include "serve/names.h"
#include "serve/native/call.h"
#include "serve/native/codec.h"

namespace vla::serve {
namespace {

using Say = LinkMessage::Kind;

constexpr int kStartPatience = 10'000, kEndPatience = 1'000;  // ms
constexpr auto kBeat = std::chrono::milliseconds(200);
// maximum unanswered heartbeats: for a stopped process (SIGSTOP), for any process
constexpr int kMaxStopped = 5, kMaxSilent = 50;
constexpr auto kFirstDelay = std::chrono::milliseconds(100), kLongestDelay = std::chrono::milliseconds(5'000);
constexpr auto kStable = std::chrono::seconds(10);
constexpr std::size_t kEnvelope = 1 << 20;  // bytes by which a request may exceed the message that it was made from
constexpr std::size_t kMaxKept = 64 << 10;  // bytes of a kept entry

}  // namespace

class DoorFront::Request final : public NativeCall {
 public:
  Request(DoorFront& front, std::uint64_t connection, net::Bytes bytes, const wire::Envelope& envelope)
      : NativeCall(front.options_, std::move(bytes), envelope),
        front_(front),
        generation_(front.generation_),
        connection_(connection) {}

  void send(const std::string& answer) override { front_.respond(generation_, connection_, answer); }
  void send_out_of_memory() noexcept override {
    free();
    try {
      send(refusal(request_id(), out_of_memory("request")));
    } catch (const std::exception&) {  // no memory even for an error; the client times out
    }
  }

 private:
  DoorFront& front_;
  const std::uint64_t generation_, connection_;
};

Result<std::unique_ptr<Front>> DoorFront::open(net::Loop& loop, const ServerOptions& options, const Door& door) {
  std::unique_ptr<DoorFront> front(new DoorFront(loop, options, door));
  VLA_TRY(front->address_,
          net::bind_tcp(front->listener_, loop.context(), options.*door.address, door.option, options.insecure));
  VLA_CHECK(front->start());
  VLA_CHECK(front->await_ready());
  return std::unique_ptr<Front>(std::move(front));
}

DoorFront::DoorFront(net::Loop& loop, const ServerOptions& options, const Door& door)
    : loop_(loop), options_(options), door_(door), timer_(loop.context()) {}

/// The process ends when its link closes, after it has answered its clients.
DoorFront::~DoorFront() {
  link_.reset();
  if (process_.is_stopped() || !process_.wait_for(kEndPatience)) process_.kill();
}

Status DoorFront::start() {
  const std::vector<std::string> arguments = {std::to_string(options_.max_message),
                                              std::to_string(options_.max_connections), std::to_string(::getpid())};
  VLA_TRY(process_, Process::start(door_.program, arguments, listener_->descriptor(), door_.option));
  link_.emplace(loop_.context(), process_.take_socket(), options_.max_message + kEnvelope);
  started_ = loop_.now();
  n_silent_ = 0;
  ++generation_;
  first_ = last_;
  return {};
}

/// Checks the process before anything is served, so that one that cannot run here is reported at once. Its first
/// message stays in the socket.
Status DoorFront::await_ready() {
  pollfd socket{link_->descriptor(), POLLIN, 0};
  const bool has_come = ::poll(&socket, 1, kStartPatience) == 1;
  if (has_come && !process_.wait_for(socket.revents & POLLHUP ? kEndPatience : 0)) return {};
  return Error{Code::io, door_.option, "its process within 10 s", has_come ? process_.kill() : "none",
               "its own message is above; allow this user more processes and memory (ulimit -u, ulimit -v)"};
}

Status DoorFront::serve(const ServedPolicy& policy) {
  VLA_CHECK(check_one_robot(*policy.engine, door_.option));
  VLA_TRY(const Names names, door_.names_of(options_, policy.description));
  told_ = fmt::format("{}={}", door_.name, names.told());
  description_ = policy.description.SerializeAsString();
  return {};
}

void DoorFront::begin(Io& io) {
  io_ = &io;
  if (std::exchange(is_begun_, true)) return;
  link_->start(*this);
  link_->send(Say::policy, 0, text_of(Given{{}, options_.map, options_.absent}), description_);
  beat();
}

/// Ends a process that is stopped or has not answered for long; another one takes over.
void DoorFront::beat() {
  timer_.expires_after(kBeat);
  timer_.async_wait([this](boost::system::error_code cancelled) {
    if (cancelled || !link_) return;  // a turn that was scheduled before the link closed
    if (++n_silent_ > kMaxSilent || (n_silent_ > kMaxStopped && process_.is_stopped()))
      return fail("it does not answer");
    link_->send(Say::ping);
    beat();
  });
}

void DoorFront::fail(const std::string& why) {
  if (!link_) return;
  link_.reset();
  process_.wait_for(5);  // it may be about to end
  clients_.clear();
  if (loop_.now() - started_ > kStable) n_failure_ = 0;
  retry(fmt::format("{}; {}", why, process_.kill()));
}

/// Restarts the process after a delay that doubles with each failure in a row.
void DoorFront::retry(const std::string& why) {
  const auto delay =
      std::min<std::chrono::milliseconds>(kFirstDelay * (1 << std::min(n_failure_++, 10)), kLongestDelay);
  io_->dropped(
      {door_.name, "", "", "door",
       fmt::format("the process of {}: {}; it starts again in {} ms", door_.option, printable(why), delay.count())});
  timer_.expires_after(delay);
  timer_.async_wait([this](boost::system::error_code cancelled) {
    if (!cancelled) start_again();
  });
}

void DoorFront::start_again() {
  if (const Status started = start(); !started) return retry(started.error().message());
  is_begun_ = false;
  begin(*io_);
  for (const auto& [key, bytes] : kept_) link_->send(Say::keep, 0, key, bytes);
}

void DoorFront::came(LinkMessage message) {
  switch (message.kind) {
    case Say::ready:
    case Say::pong:
      n_silent_ = 0;
      return;
    case Say::opened:
      return opened(message);
    case Say::closed:
      return closed(message);
    case Say::refused:
      return io_->count_error();
    case Say::request:
      return submit(std::move(message));
    case Say::keep:
      return keep(message);
    default:
      return fail("it sent what it should not");
  }
}

std::string DoorFront::name_of(std::uint64_t connection) const {
  return fmt::format("{}-{}", door_.name, first_ + connection);
}

void DoorFront::opened(const LinkMessage& message) {
  if (clients_.size() > 2 * options_.max_connections) return fail("it has too many connections");
  last_ = std::max(last_, first_ + message.connection);
  clients_[message.connection] = {message.text, loop_.now()};
}

void DoorFront::closed(const LinkMessage& message) {
  const auto found = clients_.find(message.connection);
  if (found == clients_.end()) return;
  const std::size_t space = message.text.find(' ');
  if (!message.text.empty())
    io_->dropped({name_of(message.connection), found->second.address, "", message.text.substr(0, space),
                  printable(message.text.substr(space == std::string::npos ? message.text.size() : space + 1))});
  clients_.erase(found);
}

void DoorFront::keep(const LinkMessage& message) {
  const std::span<const std::byte> bytes = message.bytes.span();
  if (bytes.empty()) {
    kept_.erase(message.text);
  } else if (bytes.size() <= kMaxKept && (kept_.contains(message.text) || kept_.size() <= options_.max_connections)) {
    kept_[message.text].assign(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  }
}

void DoorFront::submit(LinkMessage message) {
  const auto found = clients_.find(message.connection);
  if (found == clients_.end()) return;
  Client& client = found->second;
  wire::Envelope envelope;
  const Status valid = wire::read_envelope(message.bytes.span(), envelope);
  const std::uint64_t connection = message.connection, request_id = envelope.request_id;
  try {
    submit(client, std::move(message), envelope, valid);
  } catch (const std::bad_alloc&) {
    respond(generation_, connection, refusal(request_id, out_of_memory("request")));
    io_->count_error();
  }
}

void DoorFront::submit(Client& client, LinkMessage message, const wire::Envelope& envelope, const Status& valid) {
  Job job;
  job.client = name_of(message.connection);
  job.peer = client.address;
  job.share = {net::group_of(client.address), client.since};
  job.is_first = client.n_request++ == 0;
  job.request_id = envelope.request_id;
  job.kind = envelope.kind;
  job.policy_name = envelope.policy;
  job.size = message.bytes.size();
  job.at = loop_.now();
  job.deadline_ms = envelope.deadline_ms;
  job.call = std::make_unique<Request>(*this, message.connection, std::move(message.bytes), envelope);
  io_->received(job);
  if (!valid) return io_->refuse(std::move(job), [&] { return valid.error(); });
  if (job.kind == Kind::act) return io_->submit(std::move(job));
  io_->refuse(std::move(job), [] { return Error{Code::unsupported, "request", "an act", "another kind"}; });
}

/// Drops an act that an earlier process requested.
void DoorFront::respond(std::uint64_t generation, std::uint64_t connection, const std::string& response) {
  if (link_ && generation == generation_) link_->send(Say::response, connection, {}, response);
}

}  // namespace vla::serve
