// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/replay.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <new>
#include <zmq.hpp>

#include "base/out_of_memory.h"
#include "wire/envelope.h"
#include "wire/interface.h"

namespace vla::observe {
namespace {

const char* name_of(v1::Response::KindCase kind) {
  switch (kind) {
    case v1::Response::kHello:
      return "hello";
    case v1::Response::kDescription:
      return "description";
    case v1::Response::kChunk:
      return "chunk";
    case v1::Response::kHealth:
      return "health";
    case v1::Response::kError:
      return "error";
    default:
      return "nothing";
  }
}

/// Collects the differences between two answers.
struct Comparison {
  std::vector<Difference> differences;

  void field(const char* name, const std::string& recorded, const std::string& replayed) {
    constexpr std::size_t kShown = 500;  // bytes: a server's text may be as long as a message
    if (recorded != replayed)
      differences.push_back({0, 0, name, recorded.substr(0, kShown), replayed.substr(0, kShown)});
  }
  void actions(const v1::ActionChunk& recorded, const v1::ActionChunk& replayed);
  void chunk(const v1::ActionChunk& recorded, const v1::ActionChunk& replayed);
};

void Comparison::actions(const v1::ActionChunk& recorded, const v1::ActionChunk& replayed) {
  const auto &a = recorded.actions(), &b = replayed.actions();
  if (a.size() != b.size()) return field("actions", fmt::format("{} numbers", a.size()), fmt::format("{}", b.size()));
  int n_different = 0, first = 0;
  float largest = 0;
  for (int i = 0; i < a.size(); ++i) {
    if (std::memcmp(&a.Get(i), &b.Get(i), sizeof(float)) == 0) continue;
    if (n_different++ == 0) first = i;
    largest = std::max(largest, std::abs(a.Get(i) - b.Get(i)));
  }
  if (n_different > 0)
    field("actions", fmt::format("[{}] = {:.9g}", first, a.Get(first)),
          fmt::format("{:.9g}; {} of {} differ, by {:.3g} at most", b.Get(first), n_different, a.size(), largest));
}

void Comparison::chunk(const v1::ActionChunk& a, const v1::ActionChunk& b) {
  field("shape", fmt::format("{} x {}", a.horizon(), a.d_action()), fmt::format("{} x {}", b.horizon(), b.d_action()));
  field("names", fmt::format("{}", fmt::join(a.names(), ",")), fmt::format("{}", fmt::join(b.names(), ",")));
  field("rate_hz", fmt::format("{}", a.rate_hz()), fmt::format("{}", b.rate_hz()));
  field("seed", a.has_seed() ? std::to_string(a.seed()) : "none", b.has_seed() ? std::to_string(b.seed()) : "none");
  field("notes", fmt::format("{}", fmt::join(a.notes(), "; ")), fmt::format("{}", fmt::join(b.notes(), "; ")));
  field("capture_time_ns", std::to_string(a.capture_time_ns()), std::to_string(b.capture_time_ns()));
  actions(a, b);
}

/// Whether an answer depends on the load at that moment, so that it cannot be reproduced.
bool is_of_the_moment(const v1::Response& answer) {
  const v1::Error& error = answer.error();
  switch (error.code()) {
    case v1::Error::BUSY:
    case v1::Error::SUPERSEDED:
    case v1::Error::LATE:
    case v1::Error::SHUTTING_DOWN:
      return true;
    case v1::Error::OUT_OF_MEMORY:
      return true;
    case v1::Error::TOO_LARGE:  // these two refusals have an incomplete request in the recording
      return error.where() == "request";
    case v1::Error::BAD_REQUEST:
      return error.found() == "several";
    default:
      return answer.has_health();
  }
}

/// The request as it has to be sent to get the recorded answer again.
std::string request_again(const std::string& request, const v1::Response& recorded) {
  v1::Request again;
  if (!recorded.has_chunk() || !again.ParseFromString(request) || !again.has_act()) return request;
  const bool has_start = again.act().start_case() != v1::Act::START_NOT_SET;
  if (has_start && !again.act().has_deadline_ms()) return request;
  again.mutable_act()->clear_deadline_ms();
  if (!has_start) again.mutable_act()->set_seed(recorded.chunk().seed());
  return again.SerializeAsString();
}

/// One connection to a server, one request at a time. It notices at once that a server is missing or goes away, not
/// only when an answer is overdue.
class Line {
 public:
  Line(const ReplayOptions& options) : options_(options), socket_(context_, zmq::socket_type::dealer) {
    socket_.set(zmq::sockopt::linger, 0);
    socket_.set(zmq::sockopt::immediate, true);  // nothing is sent before there is a connection
    socket_.set(zmq::sockopt::maxmsgsize, kMaxAnswer);
    socket_.set(zmq::sockopt::rcvhwm, 8);
    socket_.set(zmq::sockopt::sndtimeo, kConnectMs);
    if (zmq_socket_monitor(socket_.handle(), kMonitor, ZMQ_EVENT_DISCONNECTED) != 0) throw zmq::error_t();
    monitor_ = zmq::socket_t(context_, zmq::socket_type::pair);
    monitor_.set(zmq::sockopt::linger, 0);
    monitor_.connect(kMonitor);
    socket_.connect(options.address);
  }
  Result<v1::Response> ask(const std::string& request) {
    if (!socket_.send(zmq::buffer(request)))
      return missing(fmt::format("a server within {} s", kConnectMs / 1000), "is a server running there?");
    std::array<zmq_pollitem_t, 2> items = {
        {{socket_.handle(), 0, ZMQ_POLLIN, 0}, {monitor_.handle(), 0, ZMQ_POLLIN, 0}}};
    zmq_poll(items.data(), static_cast<int>(items.size()), options_.timeout_ms);
    zmq::message_t message;
    if (!socket_.recv(message, zmq::recv_flags::dontwait))
      return items[1].revents != 0 ? missing("an answer", "the server ended the connection")
                                   : missing(fmt::format("an answer within {} s", options_.timeout_ms / 1000), "");
    v1::Response response;
    if (message.more() || !response.ParseFromArray(message.data(), static_cast<int>(message.size())))
      return Error{Code::io, options_.address, "a Response", "bytes that are none"};
    return response;
  }

 private:
  static constexpr int kConnectMs = 5000;
  static constexpr std::int64_t kMaxAnswer = 16 << 20;  // bytes; a server that sends more loses the connection
  static constexpr const char* kMonitor = "inproc://monitor";
  Error missing(std::string expected, std::string hint) const {
    return {Code::io, options_.address, std::move(expected), "none", std::move(hint)};
  }

  const ReplayOptions& options_;
  zmq::context_t context_;
  zmq::socket_t socket_, monitor_;
};

Result<v1::Description> describe(Line& line) {
  v1::Request request;
  request.set_protocol_version(wire::kMaxVersion);
  request.mutable_describe();
  VLA_TRY(const v1::Response response, line.ask(request.SerializeAsString()));
  if (!response.has_description())
    return Error{Code::io, "the server", "a description of its policy", name_of(response.kind_case())};
  return response.description();
}

Status compare(Line& line, const Recording::Record& record, ReplayReport& report) {
  v1::Response recorded;
  if (!recorded.ParseFromString(record.response))
    return Error{Code::bad_request, fmt::format("record {}", record.index), "a Response", "bytes that are none"};
  if (is_of_the_moment(recorded)) {
    ++report.n_skipped;
    return {};
  }
  VLA_TRY(const v1::Response replayed, line.ask(request_again(record.request, recorded)));
  std::vector<Difference> differences = compare_answers(recorded, replayed);
  ++(differences.empty() ? report.n_same : report.n_different);
  for (Difference& difference : differences) {
    difference.index = record.index;
    difference.request_id = recorded.request_id();
    report.differences.push_back(std::move(difference));
  }
  return {};
}

}  // namespace

std::vector<Difference> compare_answers(const v1::Response& recorded, const v1::Response& replayed) {
  Comparison comparison;
  comparison.field("request_id", std::to_string(recorded.request_id()), std::to_string(replayed.request_id()));
  comparison.field("answer", name_of(recorded.kind_case()), name_of(replayed.kind_case()));
  if (recorded.kind_case() != replayed.kind_case()) {
    if (replayed.has_error())
      comparison.field("code", "ok", v1::Error::Code_Name(replayed.error().code()) + ": " + replayed.error().where());
  } else if (recorded.has_chunk()) {
    comparison.chunk(recorded.chunk(), replayed.chunk());
  } else if (recorded.has_error()) {
    comparison.field("code", v1::Error::Code_Name(recorded.error().code()),
                     v1::Error::Code_Name(replayed.error().code()));
    comparison.field("where", recorded.error().where(), replayed.error().where());
  } else if (recorded.has_description() &&
             wire::interface_of(recorded.description()) != wire::interface_of(replayed.description())) {
    comparison.field("description", "views, states and actions", "others");
  }
  return std::move(comparison.differences);
}

Result<ReplayReport> replay(Recording& recording, const ReplayOptions& options) {
  try {
    Line line(options);
    ReplayReport report;
    VLA_TRY(report.replayed_by, describe(line));
    for (std::size_t n = 0; options.first == 0 || n < options.first; ++n) {
      VLA_TRY(const std::optional<Recording::Record> record, recording.next());
      if (!record) break;
      VLA_CHECK(compare(line, *record, report));
    }
    return report;
  } catch (const zmq::error_t& error) {
    return Error{Code::io, options.address, "an address to connect to", error.what(), "tcp://127.0.0.1:5555 is one"};
  } catch (const std::bad_alloc&) {
    return out_of_memory("replay");
  }
}

}  // namespace vla::observe
