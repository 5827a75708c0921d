// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/log.h"

#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <ctime>
#include <exception>

namespace vla::observe {
namespace {

constexpr std::size_t kMaxLogBacklog = 1 << 20;
constexpr auto kNoteAgain = std::chrono::minutes(1);
constexpr std::size_t kMaxNoted = 1024;
constexpr double kBurst = 200, kPerSecond = 50;  // limit of lines about clients

std::string now() {
  const auto time = std::chrono::system_clock::now();
  const std::time_t seconds = std::chrono::system_clock::to_time_t(time);
  const auto ms = std::chrono::duration_cast<std::chrono::milliseconds>(time.time_since_epoch()).count() % 1000;
  std::tm utc = {};
  gmtime_r(&seconds, &utc);
  return fmt::format("{:04}-{:02}-{:02}T{:02}:{:02}:{:02}.{:03}Z", utc.tm_year + 1900, utc.tm_mon + 1, utc.tm_mday,
                     utc.tm_hour, utc.tm_min, utc.tm_sec, ms);
}

/// Quotes everything except a single word.
std::string plain(const std::string& json) {
  const auto is_plain = [](unsigned char c) {
    return std::isalnum(c) != 0 || c == '.' || c == '_' || c == '-' || c == ':' || c == '/' || c == '[' || c == ']' ||
           c == ',';
  };
  const bool is_word =
      json.size() > 2 && json.front() == '"' && std::all_of(json.begin() + 1, json.end() - 1, is_plain);
  return is_word ? json.substr(1, json.size() - 2) : json;
}

Level level_of(const Error* error) {
  if (error == nullptr) return Level::debug;
  switch (error->code) {
    case Code::busy:
    case Code::superseded:
    case Code::late:
    case Code::shutting_down:
      return Level::info;
    case Code::bad_observation:
    case Code::bad_request:
    case Code::incompatible:
    case Code::too_large:
    case Code::unsupported:
      return Level::warn;
    default:
      return Level::error;
  }
}

double ms(Clock::duration time) { return std::chrono::duration<double, std::milli>(time).count(); }

}  // namespace

Log::Log(int fd, LogFormat format, Level min_level)
    : format_(format), min_level_(min_level), writer_(fd, Writer::Owns::no, kMaxLogBacklog), allowance_(kBurst) {}

/// A refused client can ask again at once, so its lines are limited: they must not fill the disk.
bool Log::may_tell() {
  if (min_level_ == Level::debug) return true;
  const Clock::time_point at = Clock::now();
  allowance_ = std::min(kBurst, allowance_ + std::chrono::duration<double>(at - told_at_).count() * kPerSecond);
  told_at_ = at;
  if (allowance_ < 1) {
    ++n_left_out_;
    return false;
  }
  allowance_ -= 1;
  try {
    if (n_left_out_ > 0) event(Level::warn, "log_limited", {{"lines", n_left_out_}});
    n_left_out_ = 0;
  } catch (const std::exception&) {  // no memory: the next line reports it
  }
  return true;
}

Log::~Log() {
  if (n_left_out_ > 0) event(Level::warn, "log_limited", {{"lines", n_left_out_}});
  if (writer_.n_dropped() > n_told_)
    writer_.set_tail(line(Level::warn, "log_dropped", {{"lines", writer_.n_dropped() - n_told_}}));
}

std::string Log::line(Level level, const char* name, const Fields& fields) const {
  const char* level_name = kLevelNames[static_cast<int>(level)];
  std::string text = format_ == LogFormat::json
                         ? fmt::format(R"({{"time":"{}","level":"{}","event":"{}")", now(), level_name, name)
                         : fmt::format("{} {:5} {}", now(), level_name, name);
  for (const Field& field : fields)
    text += format_ == LogFormat::json ? fmt::format(R"(,"{}":{})", field.name, field.json)
                                       : fmt::format(" {}={}", field.name, plain(field.json));
  return text + (format_ == LogFormat::json ? "}\n" : "\n");
}

void Log::event(Level level, const char* name, const Fields& fields) noexcept {
  if (level < min_level_) return;
  try {
    const std::uint64_t dropped = writer_.n_dropped();
    std::uint64_t told = n_told_;
    if (dropped > told && n_told_.compare_exchange_strong(told, dropped))  // another thread may report it, or more
      writer_.put(line(Level::warn, "log_dropped", {{"lines", dropped - told}}));
    writer_.put(line(level, name, fields));
  } catch (const std::exception&) {  // no memory for a line: it is dropped
  }
}

/// Whether a note is new, or was last logged long ago. Notes are compared up to the first colon or bracket, since
/// changing values follow it.
bool Log::is_news(const std::string& client, const std::string& note) {
  const Clock::time_point at = Clock::now();
  if (noted_.size() >= kMaxNoted) noted_.clear();
  const auto [told, is_new] = noted_.try_emplace(client + '\n' + note.substr(0, note.find_first_of(":[")), at);
  if (!is_new && at - told->second < kNoteAgain) return false;
  told->second = at;
  return true;
}

void Log::tell_notes(const Answered& answered) {
  const Received& request = answered.request;
  try {
    for (const std::string& note : answered.notes) {
      if (!is_news(request.client, note) || !may_tell()) continue;
      event(Level::warn, "note",
            {{"client", request.client},
             {"peer", request.peer},
             {"name", request.name},
             {"request_id", request.request_id},
             {"note", note}});
    }
  } catch (const std::exception&) {  // no memory for a line: it is dropped
  }
}

void Log::answered(const Answered& answered) {
  if (min_level_ <= Level::warn) tell_notes(answered);
  const Level level = level_of(answered.error);
  if (level < min_level_ || !may_tell()) return;
  const Received& request = answered.request;
  try {
    Fields fields = {{"client", request.client},
                     {"peer", request.peer},
                     {"name", request.name},
                     {"request_id", request.request_id},
                     {"kind", kind_name(request.kind)},
                     {"code", answered.code()},
                     {"bytes_in", answered.request.size},
                     {"bytes_out", answered.n_sent},
                     {"queue_ms", ms(answered.started - request.at)},
                     {"engine_ms", ms(answered.finished - answered.started)},
                     {"total_ms", ms(answered.sent - request.at)}};
    if (const Error* error = answered.error) {
      fields.emplace_back("where", error->where);
      fields.emplace_back("expected", error->expected);
      fields.emplace_back("found", error->found);
      fields.emplace_back("hint", error->hint);
    }
    event(level, "request", fields);
  } catch (const std::exception&) {  // no memory for a line: it is dropped
  }
}

/// A peer without a key or without ZMTP is a warning; a peer that went silent is normal.
void Log::dropped(const Dropped& connection) {
  const Level level = connection.why == "silent" ? Level::info : Level::warn;
  if (level < min_level_ || !may_tell()) return;
  try {
    event(level, "dropped",
          {{"client", connection.client},
           {"peer", connection.peer},
           {"name", connection.name},
           {"why", connection.why},
           {"detail", connection.detail}});
  } catch (const std::exception&) {  // no memory for a line: it is dropped
  }
}

}  // namespace vla::observe
