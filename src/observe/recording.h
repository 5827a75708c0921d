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

namespace vla::serve {

/// Requests and their answers as they went over the wire, in one file of a folder, in the order of the answers.
/// The file: 8 bytes `VLAREC2\n`, then records. A record is a mark of 4 bytes (`VREC`, or `VEND` for the last one),
/// three little-endian u32 (its index from 0, bytes of the request, bytes of the answer), three u64 (a number that
/// tells connections apart; when the request came, in nanoseconds since 1970; XXH3-64, chained over these 32 bytes, the
/// request and the answer), the Request and the Response. Record 0 has the server's Description as its request and no
/// answer. Times are the system's when the file was opened, counted on by a clock that nobody sets.
constexpr const char* kRecordingFile = "requests.vlarec";

/// Records what a server answers, up to a size.
class Recorder final : public Observer {
 public:
  /// Makes the folder where there is none. A folder that has a recording is refused. Errors: io.
  static Result<std::unique_ptr<Recorder>> open(const std::string& folder, std::uint64_t max_bytes);
  ~Recorder() override;

  /// Who answers; before the first request.
  void describe(const v1::Description& description);
  void answered(const Answered& answered) override;
  bool records() const override { return true; }
  std::uint64_t n_recorded() const { return n_record_ == 0 ? 0 : n_record_ - 1; }
  std::uint64_t n_byte() const { return bytes_; }
  const std::string& why_stopped() const { return why_stopped_; }  // empty: it has not

  /// Called once, when it stops before the server does: at the limit, or when the disk fails or is too slow. From then
  /// on nothing is recorded, so that a recording has no holes.
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
  const std::chrono::nanoseconds epoch_;  // of the steady clock, since 1970
  std::uint64_t bytes_ = 0;
  std::uint32_t n_record_ = 0;
  std::string why_stopped_;
  std::function<void(const std::string&, std::uint64_t)> tell_;
  Writer writer_;
};

/// Reads a recording, record by record. Every size is compared with the file before memory is taken.
class Recording {
 public:
  struct Record {
    std::size_t index = 0;  // from 1
    std::string request, response;
    std::uint64_t client = 0;  // tells connections apart
    std::uint64_t at_ns = 0;   // when the request came, since 1970
  };
  /// Errors: io, bad_request (not a recording, damaged, cut off).
  static Result<Recording> open(const std::string& folder);

  const v1::Description& description() const { return description_; }
  /// None at the end. Errors: bad_request, with the record and its place in the file.
  Result<std::optional<Record>> next();
  /// Whether the end that was reached is the one that the server wrote: a server that was killed writes none.
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

}  // namespace vla::serve
