// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/trace.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <exception>

#include "base/file.h"

namespace vla::observe {
namespace {

constexpr std::size_t kMaxTraceBacklog = 16 << 20;
constexpr std::size_t kMaxTail = 128;           // bytes
constexpr int kIo = 1, kEngine = 2, kHost = 3;  // tracks

/// Formats a time in microseconds, the unit of trace events. Three decimals keep nanoseconds, so that nested slices
/// stay nested.
std::string us(std::int64_t ns) { return fmt::format("{}.{:03}", ns / 1000, ns % 1000); }

std::string name_of_thread(int tid, const char* name) {
  return fmt::format(R"({{"ph":"M","pid":1,"tid":{},"name":"thread_name","args":{{"name":"{}"}}}})", tid, name);
}

/// The names of the tracks.
std::string head_of_file() {
  return "[\n" + name_of_thread(kIo, "requests") + ",\n" + name_of_thread(kEngine, "engine") + ",\n" +
         name_of_thread(kHost, "host, beside a device") + ",\n";
}

/// Begin and end of a slice on a request's own track.
std::string on_request(std::uint64_t id, const char* name, std::int64_t from, std::int64_t to,
                       const std::string& args) {
  constexpr const char* kEvent =
      R"({{"ph":"{}","pid":1,"tid":{},"cat":"request","id":{},"name":"{}","ts":{},"args":{{{}}}}},)"
      "\n";
  return fmt::format(kEvent, "b", kIo, id, name, us(from), args) + fmt::format(kEvent, "e", kIo, id, name, us(to), "");
}

/// A slice on a track of its own.
std::string on_track(int track, const std::string& name, std::int64_t from, std::int64_t to,
                     const std::string& args = "") {
  return fmt::format(R"({{"ph":"X","pid":1,"tid":{},"cat":"engine","name":"{}","ts":{},"dur":{},"args":{{{}}}}},)"
                     "\n",
                     track, name, us(from), us(to - from), args);
}

/// The slices of an act: the whole of it and its stages. An act that waited for the device was prepared on another
/// thread while the one before was computed.
std::string slices_of_act(const Answered& answered, std::int64_t from, std::int64_t end, const std::string& args) {
  const auto is_wait = [](const auto& stage) { return stage.first == "wait"; };
  const bool overlaps = std::any_of(answered.stages.begin(), answered.stages.end(), is_wait);
  std::string act, stages;
  int track = overlaps ? kHost : kEngine;
  std::int64_t begin = from;
  for (const auto& [stage, ms] : answered.stages) {
    const std::int64_t to = std::min<std::int64_t>(end, from + std::llround(ms * 1e6));
    if (stage == "wait") {
      act = on_track(kHost, "prepare", begin, from, args);
      track = kEngine, begin = to;
    } else {
      stages += on_track(track, stage, from, to);
    }
    from = to;
  }
  return act + on_track(track, kind_name(answered.request.kind), begin, end, args) + stages;
}

}  // namespace

Result<std::unique_ptr<Trace>> Trace::open(const std::string& path, std::size_t max_bytes) {
  VLA_TRY(const int fd, open_to_write(path, false));
  // Reserves space for the tail with blanks, which the first events overwrite.
  const std::string head = head_of_file(), begun = head + std::string(kMaxTail, ' ');
  if (!write_all(fd, std::as_bytes(std::span(begun))) || ::lseek(fd, static_cast<off_t>(head.size()), SEEK_SET) < 0) {
    const int number = errno;
    ::close(fd);
    return Error{Code::io, path, "a file that can be written", std::strerror(number)};
  }
  std::unique_ptr<Trace> trace(new Trace(fd, max_bytes));
  if (const int failure = trace->writer_.failure(); failure != 0)
    return Error{Code::io, path, "a thread to write it", std::strerror(failure)};
  return trace;
}

Trace::Trace(int fd, std::size_t max_bytes) : max_bytes_(max_bytes), writer_(fd, Writer::Owns::yes, kMaxTraceBacklog) {}

/// Closes the array: after the last comma it needs an element. On a full disk this element replaces the last event,
/// since every event is longer.
Trace::~Trace() {
  writer_.set_tail(
      fmt::format(R"({{"ph":"M","pid":1,"name":"process_name","args":{{"name":"vla serve","dropped":{}}}}})"
                  "\n]\n",
                  n_dropped()),
      true);
}

std::int64_t Trace::ns(Clock::time_point time) const {
  return std::max<std::int64_t>(0, std::chrono::nanoseconds(time - start_).count());
}

/// Writes only names that the server chooses. A client appears as the name of its connection.
void Trace::answered(const Answered& answered) {
  const Received& request = answered.request;
  const std::uint64_t id = ++n_request_;
  const std::int64_t sent = ns(answered.sent);
  try {
    std::string events =
        on_request(id, kind_name(request.kind), ns(request.at), sent,
                   fmt::format(R"("client":"{}","request_id":"{}","code":"{}","bytes_in":{},"bytes_out":{})",
                               request.client, request.request_id, answered.code(), request.size, answered.n_sent));
    if (!answered.stages.empty()) {
      const std::int64_t started = ns(answered.started), finished = ns(answered.finished);
      events += on_request(id, "queue", ns(request.at), started, "");
      events += on_request(id, "compute", started, finished, "");
      events += on_request(id, "send", finished, sent, "");
      events += slices_of_act(answered, started, finished, fmt::format(R"("request":{})", id));
    }
    n_byte_ += events.size();
    if (n_byte_ <= max_bytes_) {
      writer_.put(std::move(events));
    } else {
      ++n_beyond_;
    }
  } catch (const std::exception&) {  // no memory for an event: the server goes on without it
  }
}

}  // namespace vla::observe
