// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/file.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <charconv>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>
#include <string_view>

namespace vla {
namespace {

namespace fs = std::filesystem;

constexpr std::string_view kPart = ".part";

Error cannot_write(const std::string& path, int number) {
  return {Code::io, path, "a file that can be written", std::strerror(number)};
}

/// Opens a file without a name in the folder; it vanishes if the program is killed. Returns -1 where the system has no
/// such files.
int open_unnamed(const std::string& folder, unsigned mode) {
  if (::access("/proc/self/fd", X_OK) != 0) return -1;  // give_name needs it
  return ::open(folder.empty() ? "." : folder.c_str(), O_TMPFILE | O_RDWR | O_CLOEXEC, mode);
}

bool give_name(int fd, const std::string& path) {
  const std::string unnamed = fmt::format("/proc/self/fd/{}", fd);
  return ::linkat(AT_FDCWD, unnamed.c_str(), AT_FDCWD, path.c_str(), AT_SYMLINK_FOLLOW) == 0;
}

/// Creates a file under its name and locks it until it is closed.
int open_named(const std::string& path, unsigned mode) {
  const int fd = ::open(path.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, mode);
  if (fd >= 0) ::flock(fd, LOCK_EX | LOCK_NB);
  return fd;
}

Status write_new(const std::string& path, const WriteTo& write, unsigned mode) {
  const int unnamed = open_unnamed(fs::path(path).parent_path().string(), mode);
  const int fd = unnamed >= 0 ? unnamed : open_named(path, mode);
  if (fd < 0) return cannot_write(path, errno);
  bool written = write(fd) && ::fsync(fd) == 0 && (unnamed < 0 || give_name(fd, path));
  int number = errno;
  if (::close(fd) != 0 && written) written = false, number = errno;
  if (written) return {};
  if (unnamed < 0) ::unlink(path.c_str());
  return cannot_write(path, number);
}

/// Removes parts of this file that killed programs have left: those that no program has locked.
void remove_stale_parts(const fs::path& target) {
  std::error_code ignored;
  const fs::path folder = target.parent_path();
  for (const auto& entry : fs::directory_iterator(folder.empty() ? "." : folder, ignored)) {
    const std::string name = entry.path().filename().string(), stem = target.filename().string() + ".";
    if (!name.starts_with(stem) || !name.ends_with(kPart) || name.size() != stem.size() + 8 + kPart.size()) continue;
    const int fd = ::open(entry.path().c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    if (fd < 0) continue;
    if (::flock(fd, LOCK_EX | LOCK_NB) == 0) ::unlink(entry.path().c_str());
    ::close(fd);
  }
}

/// The name of a part: `path` with a random suffix.
std::string beside(const std::string& path) { return fmt::format("{}.{:08x}{}", path, std::random_device()(), kPart); }

bool copy_all(int from, int to) {
  if (::lseek(from, 0, SEEK_SET) != 0) return false;
  std::vector<std::byte> block(1 << 20);
  for (;;) {
    const ssize_t n = ::read(from, block.data(), block.size());
    if (n == 0) return true;
    if (n < 0 && errno != EINTR) return false;
    if (n > 0 && !write_all(to, {block.data(), static_cast<std::size_t>(n)})) return false;
  }
}

/// Copies the output of `write` to `to` through a file without a name, because a pipe must be written in order.
bool write_through(int to, const WriteTo& write) {
  const int fd = open_temporary();
  if (fd < 0) return false;
  const bool written = write(fd) && copy_all(fd, to);
  const int number = errno;
  ::close(fd);
  errno = number;
  return written;
}

Status write_in_place(const std::string& path, int fd, const WriteTo& write) {
  if (fd < 0) return cannot_write(path, errno);
  const bool written = write_through(fd, write);
  const int number = errno;
  if (::close(fd) != 0 && written) return cannot_write(path, errno);
  return written ? Status() : cannot_write(path, number);
}

/// The file descriptor that a path such as /dev/stdout or /dev/fd/3 names; -1 for other paths.
int descriptor_of(const std::string& path) {
  if (path == "/dev/stdout") return STDOUT_FILENO;
  if (path == "/dev/stderr") return STDERR_FILENO;
  for (const std::string_view folder : {"/dev/fd/", "/proc/self/fd/"}) {
    int fd = 0;
    const char* const end = path.data() + path.size();
    if (path.starts_with(folder) && std::from_chars(path.data() + folder.size(), end, fd).ptr == end) return fd;
  }
  return -1;
}

/// Follows symbolic links to their target, which need not exist. In a cycle of links, the result is a link.
std::string behind_links(const std::string& path) {
  constexpr int kMaxLinks = 40;
  fs::path found = path;
  std::error_code ignored;
  for (int i = 0; i < kMaxLinks && fs::is_symlink(fs::symlink_status(found, ignored)); ++i)
    found = found.parent_path() / fs::read_symlink(found, ignored);
  return found.string();
}

}  // namespace

int open_temporary() {
  std::error_code ignored;
  const fs::path folder = fs::temp_directory_path(ignored);
  const int unnamed = open_unnamed(folder.string(), 0600);
  if (unnamed >= 0) return unnamed;
  const std::string part = beside((folder / "vla").string());
  const int named = open_named(part, 0600);
  if (named >= 0) ::unlink(part.c_str());
  return named;
}

Result<std::vector<std::byte>> read_file(const std::string& path, std::size_t limit) {
  std::error_code error;
  if (!fs::is_regular_file(path, error))
    return Error{Code::io, path, "a file", error ? error.message() : "something that is not a regular file"};
  const std::uintmax_t size = fs::file_size(path, error);
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
  if (const int open = descriptor_of(path); open >= 0)
    return write_in_place(path, ::fcntl(open, F_DUPFD_CLOEXEC, 0), write);
  std::error_code ignored;
  const std::string target = behind_links(path);
  const auto there = fs::symlink_status(target, ignored);
  if (fs::is_symlink(there)) return cannot_write(path, ELOOP);
  if (fs::exists(there) && !fs::is_regular_file(there))
    return write_in_place(path, ::open(target.c_str(), O_WRONLY | O_CLOEXEC), write);
  remove_stale_parts(target);
  const std::string part = beside(target);
  if (const Status written = write_new(part, write, 0666); !written)
    return Error{Code::io, path, written.error().expected, written.error().found};
  if (fs::exists(there)) fs::permissions(part, there.permissions(), ignored);
  if (::rename(part.c_str(), target.c_str()) == 0) return {};
  const int number = errno;
  ::unlink(part.c_str());
  return cannot_write(path, number);
}

}  // namespace vla
