// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/file.h"

#include <doctest/doctest.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <cstdlib>
#include <filesystem>

namespace file_test {

using namespace vla;
namespace fs = std::filesystem;

namespace {

/// A folder of its own, removed at the end.
struct Folder {
  fs::path path = fs::temp_directory_path() / fmt::format("vla-file-test-{}", ::getpid());
  Folder() { fs::create_directory(path); }
  ~Folder() { fs::remove_all(path); }
  std::string operator/(const char* name) const { return (path / name).string(); }
  std::ptrdiff_t n_entry() const { return std::distance(fs::directory_iterator(path), fs::directory_iterator()); }
};

std::string text_of(const std::string& file) {
  const auto bytes = read_file(file, 100);
  REQUIRE(bytes.ok());
  return {reinterpret_cast<const char*>(bytes->data()), bytes->size()};
}

}  // namespace

TEST_CASE("what is written is read back, and replaces a file as a whole") {
  const Folder folder;
  const std::string file = folder / "a";
  REQUIRE(write_file(file, "a longer text").ok());
  REQUIRE(write_file(file, "short").ok());
  CHECK(text_of(file) == "short");
  CHECK(folder.n_entry() == 1);  // the file beside it is gone
}

TEST_CASE("a program that is killed while it writes leaves the old file, and after the next one nothing else") {
  const Folder folder;
  const std::string file = folder / "a";
  REQUIRE(write_file(file, "old").ok());
  const pid_t child = ::fork();
  if (child == 0) {
    const std::string half = "half";
    [[maybe_unused]] const Status never = write_file(file, [&](int to) {
      write_all(to, std::as_bytes(std::span(half)));
      return std::raise(SIGKILL) == 0;
    });
    std::_Exit(0);
  }
  int status = 0;
  REQUIRE(::waitpid(child, &status, 0) == child);
  CHECK(WIFSIGNALED(status));
  CHECK(text_of(file) == "old");
  REQUIRE(write_file(file, "new").ok());
  CHECK(text_of(file) == "new");
  CHECK(folder.n_entry() == 1);
}

TEST_CASE("parts that nobody writes any more go, and those of a running program and other files stay") {
  const Folder folder;
  for (const char* name : {"a.0123abcd.part", "a.89abcdef.part", "a.part", "b.0123abcd.part", "a.0123abcd.part.old"})
    REQUIRE(write_file(folder / name, "half").ok());
  const int running = ::open((folder / "a.89abcdef.part").c_str(), O_RDONLY | O_CLOEXEC);
  REQUIRE(::flock(running, LOCK_EX | LOCK_NB) == 0);
  REQUIRE(write_file(folder / "a", "whole").ok());
  CHECK_FALSE(fs::exists(folder / "a.0123abcd.part"));
  CHECK(folder.n_entry() == 5);
  ::close(running);
}

TEST_CASE("a link stays a link, and the file behind it is replaced") {
  const Folder folder;
  REQUIRE(write_file(folder / "target", "old").ok());
  fs::create_symlink("target", folder / "link");
  REQUIRE(write_file(folder / "link", "new").ok());
  CHECK(fs::is_symlink(folder / "link"));
  CHECK(text_of(folder / "target") == "new");
}

TEST_CASE("a link to a file that is not there yet stays a link, and one to itself is an error") {
  const Folder folder;
  fs::create_directory(folder / "versions");
  fs::create_symlink("versions/v3", folder / "link");
  fs::create_symlink("link", folder / "second");
  REQUIRE(write_file(folder / "second", "new").ok());
  CHECK(fs::is_symlink(folder / "second"));
  CHECK(fs::is_symlink(folder / "link"));
  CHECK(text_of(folder / "versions/v3") == "new");
  fs::create_symlink("loop", folder / "loop");
  const Status looped = write_file(folder / "loop", "x");
  REQUIRE_FALSE(looped.ok());
  CHECK(looped.error().where == folder / "loop");
  CHECK(fs::is_symlink(folder / "loop"));
}

TEST_CASE("a file that is replaced keeps its mode") {
  const Folder folder;
  REQUIRE(write_file(folder / "a", "old").ok());
  fs::permissions(folder / "a", fs::perms::owner_read | fs::perms::owner_write);
  REQUIRE(write_file(folder / "a", "new").ok());
  CHECK((fs::status(folder / "a").permissions() & fs::perms::mask) == (fs::perms::owner_read | fs::perms::owner_write));
}

TEST_CASE("a pipe, a device and an open file get bytes that are written out of order, and stay what they are") {
  const Folder folder;
  const WriteTo backwards = [](int file) {
    return ::ftruncate(file, 3) == 0 && ::pwrite(file, "bc", 2, 1) == 2 && ::pwrite(file, "a", 1, 0) == 1;
  };
  const std::string pipe = folder / "pipe";
  REQUIRE(::mkfifo(pipe.c_str(), 0600) == 0);
  const int reader = ::open(pipe.c_str(), O_RDONLY | O_NONBLOCK);
  REQUIRE(write_file(pipe, backwards).ok());
  char found[4] = {};
  CHECK(::read(reader, found, 4) == 3);
  CHECK(std::string(found) == "abc");
  ::close(reader);
  CHECK(fs::is_fifo(pipe));
  fs::create_symlink("/dev/null", folder / "link");
  CHECK(write_file(folder / "link", backwards).ok());
  CHECK(fs::is_character_file(fs::status("/dev/null")));
  const int log = ::open((folder / "log").c_str(), O_WRONLY | O_CREAT | O_APPEND, 0600);
  REQUIRE(::write(log, "so far ", 7) == 7);
  REQUIRE(write_file(fmt::format("/dev/fd/{}", log), backwards).ok());
  ::close(log);
  CHECK(text_of(folder / "log") == "so far abc");
  const Status folders = write_file(folder.path.string(), "x");
  REQUIRE_FALSE(folders.ok());
  CHECK(folders.error().code == Code::io);
}

TEST_CASE("a temporary file has no name, and its bytes are read where they were written") {
  const int fd = open_temporary();
  REQUIRE(fd >= 0);
  const std::string text = "weights";
  char read[8] = {};
  struct stat info = {};
  CHECK(write_all(fd, std::as_bytes(std::span(text))));
  CHECK(::pread(fd, read, sizeof(read), 0) == 7);
  CHECK(read == text);
  CHECK((::fstat(fd, &info) == 0 && info.st_nlink == 0));
  ::close(fd);
}

TEST_CASE("a new file never replaces one, and has the mode that was asked for") {
  const Folder folder;
  const std::string file = folder / "secret", text = "key";
  const auto bytes = std::as_bytes(std::span(text));
  REQUIRE(write_new_file(file, bytes, 0600).ok());
  CHECK((fs::status(file).permissions() & fs::perms::mask) == (fs::perms::owner_read | fs::perms::owner_write));
  const Status again = write_new_file(file, bytes, 0600);
  REQUIRE_FALSE(again.ok());
  CHECK(again.error().code == Code::io);
  CHECK(again.error().where == file);
}

TEST_CASE("what cannot be read or written is an io error that names the path, and leaves no file") {
  const Folder folder;
  const std::string pipe = folder / "pipe";
  REQUIRE(::mkfifo(pipe.c_str(), 0600) == 0);
  REQUIRE(write_file(folder / "large", "0123456789").ok());
  for (const auto& [path, limit] : {std::pair(folder / "absent", 100), std::pair(pipe, 100),
                                    std::pair(folder / ".", 100), std::pair(folder / "large", 9)}) {
    CAPTURE(path);
    const auto bytes = read_file(path, static_cast<std::size_t>(limit));
    REQUIRE_FALSE(bytes.ok());
    CHECK(bytes.error().code == Code::io);
    CHECK(bytes.error().where == path);
  }
  const Status written = write_file(folder / "no/such/folder", "x");
  REQUIRE_FALSE(written.ok());
  CHECK(written.error().code == Code::io);
  CHECK(folder.n_entry() == 2);
}

}  // namespace file_test
