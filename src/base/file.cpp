// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/file.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>
#include <string_view>

namespace vla {
namespace {

constexpr std::string_view kPart = ".part";

Error cannot_write(const std::string& path, int number) {
  return {Code::io, path, "a file that can be written", std::strerror(number)};
}

/// A file of this folder without a name, of which nothing is left where the program is killed; -1 where the system has
/// none.
int open_unnamed(const std::string& folder, unsigned mode) {
  if (::access("/proc/self/fd", X_OK) != 0) return -1;  // which names it in the end
  return ::open(folder.empty() ? "." : folder.c_str(), O_TMPFILE | O_RDWR | O_CLOEXEC, mode);
}

bool give_name(int fd, const std::string& path) {
  const std::string unnamed = fmt::format("/proc/self/fd/{}", fd);
  return ::linkat(AT_FDCWD, unnamed.c_str(), AT_FDCWD, path.c_str(), AT_SYMLINK_FOLLOW) == 0;
}

/// A file that has its name from the start, locked for as long as it is written.
int open_named(const std::string& path, unsigned mode) {
  const int fd = ::open(path.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, mode);
  if (fd >= 0) ::flock(fd, LOCK_EX | LOCK_NB);
  return fd;
}

Status write_new(const std::string& path, const WriteTo& write, unsigned mode) {
  const int unnamed = open_unnamed(std::filesystem::path(path).parent_path().string(), mode);
  const int fd = unnamed >= 0 ? unnamed : open_named(path, mode);
  if (fd < 0) return cannot_write(path, errno);
  bool written = write(fd) && ::fsync(fd) == 0 && (unnamed < 0 || give_name(fd, path));
  int number = errno;
  if (::close(fd) != 0 && written) written = false, number = errno;
  if (written) return {};
  if (unnamed < 0) ::unlink(path.c_str());
  return cannot_write(path, number);
}

/// Removes what programs that were killed have left of this file: parts that nobody writes any more.
void remove_stale_parts(const std::filesystem::path& target) {
  std::error_code ignored;
  const std::filesystem::path folder = target.parent_path();
  for (const auto& entry : std::filesystem::directory_iterator(folder.empty() ? "." : folder, ignored)) {
    const std::string name = entry.path().filename().string(), stem = target.filename().string() + ".";
    if (!name.starts_with(stem) || !name.ends_with(kPart) || name.size() != stem.size() + 8 + kPart.size()) continue;
    const int fd = ::open(entry.path().c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    if (fd < 0) continue;
    if (::flock(fd, LOCK_EX | LOCK_NB) == 0) ::unlink(entry.path().c_str());
    ::close(fd);
  }
}

Status write_in_place(const std::string& path, const WriteTo& write) {
  const int fd = ::open(path.c_str(), O_WRONLY | O_CLOEXEC);
  const bool written = fd >= 0 && write(fd);
  const int number = errno;
  if (fd >= 0 && ::close(fd) != 0 && written) return cannot_write(path, errno);
  return written ? Status() : cannot_write(path, number);
}

}  // namespace

Result<std::vector<std::byte>> read_file(const std::string& path, std::size_t limit) {
  std::error_code error;
  if (!std::filesystem::is_regular_file(path, error))
    return Error{Code::io, path, "a file", error ? error.message() : "something that is not a regular file"};
  const std::uintmax_t size = std::filesystem::file_size(path, error);
  if (error) return Error{Code::io, path, "a readable file", error.message()};
  if (size > limit) return Error{Code::io, path, fmt::format("at most {} bytes", limit), fmt::format("{} bytes", size)};
  std::vector<std::byte> bytes(size);
  std::ifstream stream(path, std::ios::binary);
  stream.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(size));
  if (!stream) return Error{Code::io, path, "a readable file", "an error while reading"};
  return bytes;
}

bool write_all(int file, std::span<const std::byte> bytes) {
  while (!bytes.empty()) {
    const ssize_t n = ::write(file, bytes.data(), bytes.size());
    if (n < 0 && errno != EINTR) return false;
    if (n > 0) bytes = bytes.subspan(static_cast<std::size_t>(n));
  }
  return true;
}

Status write_new_file(const std::string& path, std::span<const std::byte> bytes, unsigned mode) {
  return write_new(
      path, [bytes](int file) { return write_all(file, bytes); }, mode);
}

Status write_file(const std::string& path, std::span<const std::byte> bytes) {
  return write_file(path, [bytes](int file) { return write_all(file, bytes); });
}

Status write_file(const std::string& path, const WriteTo& write) {
  std::error_code ignored;
  const auto there = std::filesystem::status(path, ignored);
  if (std::filesystem::exists(there) && !std::filesystem::is_regular_file(there)) return write_in_place(path, write);
  const bool is_link = std::filesystem::is_symlink(std::filesystem::symlink_status(path, ignored));
  const std::string target = is_link ? std::filesystem::weakly_canonical(path, ignored).string() : path;
  remove_stale_parts(target);
  const std::string part = fmt::format("{}.{:08x}{}", target, std::random_device()(), kPart);
  if (const Status written = write_new(part, write, 0666); !written)
    return Error{Code::io, path, written.error().expected, written.error().found};
  if (::rename(part.c_str(), target.c_str()) == 0) return {};
  const int number = errno;
  ::unlink(part.c_str());
  return cannot_write(path, number);
}

}  // namespace vla
