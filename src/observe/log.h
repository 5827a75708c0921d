// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json.hpp>
#include <vector>

#include "observe/observer.h"
#include "observe/writer.h"

namespace vla::observe {

enum class Level { debug, info, warn, error };
constexpr const char* kLevelNames[] = {"debug", "info", "warn", "error"};

enum class LogFormat { text, json };

/// Writes events, one per line: JSON objects with `time` (UTC), `level`, `event` and the event's fields, or the same as
/// text. Clients' values are escaped. docs/serving.md lists events and fields.
class Log final : public Observer {
 public:
  /// A field: a name that the server chooses, and its value as ASCII JSON, so that a client's text cannot act on a
  /// terminal. It is stored as text, because the JSON library allocates memory even to destroy its objects.
  struct Field {
    template <class Value>
    Field(const char* its_name, const Value& value)
        : name(its_name), json(nlohmann::json(value).dump(-1, ' ', true, nlohmann::json::error_handler_t::replace)) {}
    std::string name, json;
  };
  using Fields = std::vector<Field>;
  /// Writes events of `min_level` and above to `fd`, which stays open.
  Log(int fd, LogFormat format, Level min_level);
  ~Log() override;

  /// From any thread.
  void event(Level level, const char* name, const Fields& fields) noexcept;
  /// Logs a request: debug if it was answered, info if the queue refused it, warn if the request was wrong, error if
  /// the server failed. Notes of a chunk are warnings, logged once a minute per client and kind. Above debug, clients
  /// and peers cause at most 200 lines at once and 50 a second; a line `log_limited` counts the rest.
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
  std::atomic<std::uint64_t> n_told_ = 0;  // dropped lines that are already reported
  // For the I/O thread: how many lines about clients may be written now, and how many were left out.
  double allowance_;
  std::uint64_t n_left_out_ = 0;
  std::map<std::string, Clock::time_point> noted_;  // when a note was last logged, by client and kind
  Clock::time_point told_at_ = Clock::now();
};

}  // namespace vla::observe
