// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json.hpp>
#include <vector>

#include "observe/observer.h"
#include "observe/writer.h"

namespace vla::serve {

enum class Level { debug, info, warn, error };
constexpr const char* kLevelNames[] = {"debug", "info", "warn", "error"};

enum class LogFormat { text, json };

/// Events, one in a line: JSON objects with `time` (UTC), `level`, `event` and the fields of the event, or the same
/// as text for people. What a client sends is escaped inside its field. docs/serving.md lists events and fields.
class Log final : public Observer {
 public:
  /// A name of our own, and a value as JSON of ASCII characters: a terminal must not obey what a client sends. Kept as
  /// text, because the library's objects take memory even to be destroyed, and end the process where there is none.
  struct Field {
    template <class Value>
    Field(const char* its_name, const Value& value)
        : name(its_name), json(nlohmann::json(value).dump(-1, ' ', true, nlohmann::json::error_handler_t::replace)) {}
    std::string name, json;
  };
  using Fields = std::vector<Field>;
  /// Writes events of at least `min_level` to `fd`, which stays open.
  Log(int fd, LogFormat format, Level min_level);
  ~Log() override;

  /// From any thread.
  void event(Level level, const char* name, const Fields& fields) noexcept;
  /// A request: at level debug where it was answered as requested, info where the queue refused it, warn
  /// where the request was wrong, error where the server failed. A chunk's notes are warnings, each told once a minute
  /// for a client and what it is about. At levels above debug, clients and peers cause at
  /// most 200 lines at once and 50 a second; a line `log_limited` counts the others.
  void answered(const Answered& answered) override;
  void dropped(const Dropped& connection) override;

 private:
  bool may_tell();
  void tell_notes(const Answered& answered);
  bool is_news(const std::string& client, const std::string& note);
  std::string line(Level level, const char* name, const Fields& fields) const;

  LogFormat format_;
  Level min_level_;
  Writer writer_;
  std::atomic<std::uint64_t> n_told_ = 0;  // of the lines that were dropped
  // Of the I/O thread: lines about clients that may be written now, and those that were left out.
  double allowance_;
  std::uint64_t n_left_out_ = 0;
  std::map<std::string, Clock::time_point> noted_;  // by client and the beginning of the note, when it was told
  Clock::time_point told_at_ = Clock::now();
};

}  // namespace vla::serve
