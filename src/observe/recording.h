// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <fstream>
#include <functional>
#include <memory>
#include <optional>

#include "observe/observer.h"
#include "observe/writer.h"
#include "wire/vla.pb.h"

namespace vla::observe {

/// Requests and their answers as they went over the wire, in one file of a folder, in the order of the answers.
/// The file: 8 bytes `VLAREC2\n`, then records. A record is a mark of 4 bytes (`VREC`, or `VEND` for the last one),
/// three little-endian u32 (its index from 0, bytes of the request, bytes of the answer), three u64 (a number that
/// tells connections apart; when the request came, in nanoseconds since 1970; XXH3-64, chained over these 32 bytes, the
/// request and the answer), the Request and the Response. Record 0 has the server's Description as its request and no
/// answer. Times are the system time when the file was opened plus the time since then by the steady clock, which
/// nobody sets.
constexpr const char* kRecordingFile = "requests.vlarec";

/// Records requests and answers, up to a size.
class Recorder final : public Observer {
 public:
  /// Creates the folder if it is missing. A folder with a recording is refused. Errors: io.
  static Result<std::unique_ptr<Recorder>> open(const std::string& folder, std::uint64_t max_bytes);
  ~Recorder() override { close(); }

  /// Writes the waiting records and ends the file. If the disk failed in the meantime, only why_stopped() reports it,
  /// not `on_stop`.
  void close();

  /// Describes the server. Call it before the first request.
  void describe(const v1::Description& description);
  void answered(const Answered& answered) override;
  bool records() const override { return true; }
  std::uint64_t n_recorded() const { return n_record_ == 0 ? 0 : n_record_ - 1; }
  std::uint64_t n_byte() const { return bytes_; }
  const std::string& why_stopped() const { return why_stopped_; }  // why it stopped; empty if it did not

  /// Called once if recording stops before the server does: at the limit, or if the disk fails or is too slow. Nothing
  /// is recorded afterwards, so a recording has no holes.
  void on_stop(std::function<void(const std::string& why, std::uint64_t n_recorded)> tell) { tell_ = std::move(tell); }

 private:
  Recorder(std::string path, int fd, std::uint64_t max_bytes);
  struct Came {
    std::uint64_t client = 0, at_ns = 0;
  };
  void add(const Came& came, std::span<const std::byte> in, std::span<const std::byte> out);
  void stop(const char* why);

  const std::string path_;
  const std::uint64_t max_bytes_;
  const std::chrono::nanoseconds epoch_;  // difference of the system clock (since 1970) and the steady clock
  std::uint64_t bytes_ = 0;
  std::uint32_t n_record_ = 0;
  std::string why_stopped_;
  std::function<void(const std::string&, std::uint64_t)> tell_;
  Writer writer_;
};

/// Reads a recording, record by record. Every size is compared with the file before memory is allocated.
class Recording {
 public:
  struct Record {
    std::size_t index = 0;  // from 1
    std::string request, response;
    std::uint64_t client = 0;  // identifies the connection
    std::uint64_t at_ns = 0;   // arrival of the request, since 1970
  };
  /// Errors: io, bad_request (not a recording, damaged, truncated).
  static Result<Recording> open(const std::string& folder);

  const v1::Description& description() const { return description_; }
  /// The next record; none at the end. Errors: bad_request, with the record and its place in the file.
  Result<std::optional<Record>> next();
  /// Whether the server wrote an end record. A killed server writes none.
  bool is_whole() const { return is_whole_; }

 private:
  explicit Recording(std::string path) : path_(std::move(path)) {}
  Error damaged(const std::string& expected, const std::string& found) const;

  std::string path_;
  std::ifstream file_;
  std::uint64_t size_ = 0, at_ = 0;
  std::uint32_t n_record_ = 0;
  bool is_whole_ = false;
  v1::Description description_;
};

}  // namespace vla::observe
