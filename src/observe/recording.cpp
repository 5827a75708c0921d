// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/recording.h"

#include <fmt/format.h>
#include <xxhash.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <exception>
#include <filesystem>
#include <limits>

namespace vla::observe {
namespace {

constexpr std::string_view kMagic = "VLAREC2\n";
constexpr std::size_t kHead = 40, kSealed = 32;  // bytes of a record's head; how many of them the checksum covers
constexpr std::size_t kMaxRecordBacklog = 128 << 20;
constexpr std::uint64_t kLatestNs = 4'102'444'800 * 1'000'000'000ULL;  // the year 2100: keeps replay times in range

using Head = std::array<char, kHead>;

template <class T>
void put(Head& head, std::size_t at, T value) {
  for (std::size_t i = 0; i < sizeof(T); ++i) head[at + i] = static_cast<char>(value >> (8 * i));
}

template <class T>
T get(const Head& head, std::size_t at) {
  T value = 0;
  for (std::size_t i = 0; i < sizeof(T); ++i)
    value |= static_cast<T>(static_cast<unsigned char>(head[at + i])) << (8 * i);
  return value;
}

std::uint64_t seal(const Head& head, std::string_view in, std::string_view out) {
  const std::uint64_t of_head = XXH3_64bits(head.data(), kSealed);
  return XXH3_64bits_withSeed(out.data(), out.size(), XXH3_64bits_withSeed(in.data(), in.size(), of_head));
}

std::string record_of(const char* mark, std::uint32_t index, std::uint64_t client, std::uint64_t at_ns,
                      std::string_view in, std::string_view out) {
  Head head;
  std::memcpy(head.data(), mark, 4);
  put(head, 4, index);
  put(head, 8, static_cast<std::uint32_t>(in.size()));
  put(head, 12, static_cast<std::uint32_t>(out.size()));
  put(head, 16, client);
  put(head, 24, at_ns);
  put(head, kSealed, seal(head, in, out));
  std::string record;
  record.reserve(kHead + in.size() + out.size());
  return record.append(head.data(), kHead).append(in).append(out);
}

std::string_view text(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

}  // namespace

Result<std::unique_ptr<Recorder>> Recorder::open(const std::string& folder, std::uint64_t max_bytes) {
  std::error_code failed;
  if (std::filesystem::create_directories(folder, failed))
    std::filesystem::permissions(folder, std::filesystem::perms::owner_all, failed);
  if (failed) return Error{Code::io, folder, "a folder that can be made", failed.message()};
  const std::string path = folder + "/" + kRecordingFile;
  VLA_TRY(const int fd, open_to_write(path, true));
  std::unique_ptr<Recorder> recorder(new Recorder(path, fd, max_bytes));
  if (const int failure = recorder->writer_.failure(); failure != 0)
    return Error{Code::io, path, "a thread to write it", std::strerror(failure)};
  return recorder;
}

Recorder::Recorder(std::string path, int fd, std::uint64_t max_bytes)
    : path_(std::move(path)),
      max_bytes_(max_bytes),
      epoch_(std::chrono::system_clock::now().time_since_epoch() - Clock::now().time_since_epoch()),
      bytes_(kMagic.size() + kHead),
      writer_(fd, Writer::Owns::yes, kMaxRecordBacklog) {
  writer_.put(std::string(kMagic));
}

/// Without a single record, removes the file, so that it does not block the next server.
void Recorder::close() {
  if (n_record_ > 0) {
    writer_.set_tail(record_of("VEND", n_record_, 0, 0, "", ""));
  } else {
    std::error_code ignored;
    std::filesystem::remove(path_, ignored);
  }
  writer_.close();
  if (writer_.failure() == 0 || !why_stopped_.empty()) return;
  why_stopped_ = std::strerror(writer_.failure());
  if (n_record_ > 0) n_record_ -= std::min(static_cast<std::uint32_t>(writer_.n_dropped()), n_record_ - 1);
}

void Recorder::describe(const v1::Description& description) {
  const std::string bytes = description.SerializeAsString();
  add({}, std::as_bytes(std::span(bytes)), {});
}

void Recorder::answered(const Answered& answered) {
  if (!why_stopped_.empty() || answered.out.empty()) return;
  const std::string& client = answered.request.client;
  const auto at = epoch_ + answered.request.at.time_since_epoch();
  add({XXH3_64bits(client.data(), client.size()), static_cast<std::uint64_t>(at.count())}, answered.in, answered.out);
}

void Recorder::add(const Came& came, std::span<const std::byte> in, std::span<const std::byte> out) {
  const std::uint64_t size = kHead + in.size() + out.size();
  if (bytes_ + size > max_bytes_) return stop("it reached its limit");
  try {
    if (!writer_.put(record_of("VREC", n_record_, came.client, came.at_ns, text(in), text(out))))
      return stop(writer_.failure() != 0 ? std::strerror(writer_.failure()) : "the disk is too slow");
  } catch (const std::exception&) {
    return stop("no memory");
  }
  bytes_ += size;
  ++n_record_;
}

void Recorder::stop(const char* why) {
  why_stopped_ = "no memory";  // short enough to need no allocation
  try {
    why_stopped_ = why;
    if (tell_) tell_(why_stopped_, n_recorded());
  } catch (const std::exception&) {  // no memory to report it
  }
}

Error Recording::damaged(const std::string& expected, const std::string& found) const {
  return {Code::bad_request, fmt::format("{}: record {} at byte {}", path_, n_record_, at_), expected, found,
          n_record_ > 1 ? fmt::format("--first {} replays what comes before it", n_record_ - 1) : std::string()};
}

Result<Recording> Recording::open(const std::string& folder) {
  Recording recording(folder + "/" + kRecordingFile);
  std::error_code failed;
  const bool is_file =
      std::filesystem::is_regular_file(recording.path_, failed);  // opening a pipe would wait for its writer
  if (is_file) {
    recording.size_ = std::filesystem::file_size(recording.path_, failed);
    recording.file_.open(recording.path_, std::ios::binary);
  }
  if (!is_file || failed || !recording.file_)
    return Error{Code::io, recording.path_, "a recording of vla serve --record", "no file that can be read"};
  std::array<char, kMagic.size()> magic = {};
  recording.file_.read(magic.data(), magic.size());
  if (std::string_view(magic.data(), magic.size()) != kMagic)
    return recording.damaged("VLAREC2, the mark of a recording", "other bytes");
  recording.at_ = kMagic.size();
  VLA_TRY(const auto first, recording.next());
  if (!first || !recording.description_.ParseFromString(first->request))
    return recording.damaged("the server's description", first ? "other bytes" : "the end of the file");
  return recording;
}

Result<std::optional<Recording::Record>> Recording::next() {
  if (is_whole_) {
    if (at_ != size_) return damaged("the end of the file", fmt::format("{} bytes more", size_ - at_));
    return std::optional<Record>();
  }
  if (at_ == size_) return std::optional<Record>();
  Head head;
  const std::uint64_t left = size_ - at_;
  if (left < kHead || !file_.read(head.data(), kHead))
    return damaged(fmt::format("{} bytes", kHead), fmt::format("{} and the end of the file", left));
  const std::string mark(head.data(), 4);
  if (mark != "VREC" && mark != "VEND") return damaged("the mark of a record", "other bytes");
  if (get<std::uint32_t>(head, 4) != n_record_)
    return damaged(fmt::format("record {}", n_record_), fmt::format("record {}", get<std::uint32_t>(head, 4)));
  const std::uint64_t n_in = get<std::uint32_t>(head, 8), n_out = get<std::uint32_t>(head, 12);
  if (n_in + n_out > left - kHead)
    return damaged(fmt::format("{} bytes", kHead + n_in + n_out), fmt::format("{} and the end of the file", left));
  Record record{n_record_, std::string(n_in, '\0'), std::string(n_out, '\0'), get<std::uint64_t>(head, 16),
                get<std::uint64_t>(head, 24)};
  file_.read(record.request.data(), static_cast<std::streamsize>(n_in));
  file_.read(record.response.data(), static_cast<std::streamsize>(n_out));
  if (!file_ || seal(head, record.request, record.response) != get<std::uint64_t>(head, kSealed))
    return damaged("bytes of the checksum that was recorded", "bytes of another");
  if (record.at_ns >= kLatestNs)
    return damaged("a time before the year 2100", fmt::format("{} ns since 1970", record.at_ns));
  at_ += kHead + n_in + n_out;
  if (mark == "VEND") {
    is_whole_ = true;
    return next();
  }
  ++n_record_;
  return std::optional<Record>(std::move(record));
}

}  // namespace vla::observe
