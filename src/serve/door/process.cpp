// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/door/process.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <poll.h>
#include <spawn.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <cstring>
#include <filesystem>
#include <fstream>

namespace vla::serve {
namespace {

namespace fs = std::filesystem;

constexpr int kFirstFree = 16;  // higher than the descriptors that the program inherits

struct Descriptor {
  int fd = -1;
  ~Descriptor() {
    if (fd >= 0) ::close(fd);
  }
};

Result<fs::path> find(const std::string& name, const char* option) {
  std::error_code error;
  const fs::path folder = fs::canonical("/proc/self/exe", error).parent_path();
  const fs::path places[] = {folder / name, folder.parent_path() / "libexec/vla" / name};
  for (const fs::path& place : places)
    if (fs::exists(place, error)) return place;
  return Error{Code::unsupported, option, "the program " + places[0].string() + " or " + places[1].string(), "neither",
               "it is built and installed with vla"};
}

Error not_started(const char* option, int error) {
  return {Code::io, option, "a process of its own", std::strerror(error),
          "allow this user more processes and memory (ulimit -u, ulimit -v)"};
}

}  // namespace

Result<Process> Process::start(const std::string& name, const std::vector<std::string>& arguments, int descriptor,
                               const char* option) {
  VLA_TRY(const fs::path program, find(name, option));
  int pair[2];
  if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, pair) != 0) return not_started(option, errno);
  Process process;
  process.socket_ = pair[0];
  const Descriptor theirs{pair[1]};
  const Descriptor link{::fcntl(pair[1], F_DUPFD_CLOEXEC, kFirstFree)},
      other{::fcntl(descriptor, F_DUPFD_CLOEXEC, kFirstFree)};
  if (link.fd < 0 || other.fd < 0) return not_started(option, errno);

  std::vector<std::string> all = {program.string()};
  all.insert(all.end(), arguments.begin(), arguments.end());
  std::vector<char*> argv;
  for (std::string& argument : all) argv.push_back(argument.data());
  argv.push_back(nullptr);

  posix_spawn_file_actions_t actions;
  posix_spawnattr_t attributes;
  posix_spawn_file_actions_init(&actions);
  posix_spawnattr_init(&attributes);
  posix_spawn_file_actions_addopen(&actions, 0, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_adddup2(&actions, 2, 1);  // stdout belongs to the server
  posix_spawn_file_actions_adddup2(&actions, link.fd, 3);
  posix_spawn_file_actions_adddup2(&actions, other.fd, 4);
  sigset_t none, every;
  sigemptyset(&none);
  sigfillset(&every);
  posix_spawnattr_setsigmask(&attributes, &none);
  posix_spawnattr_setsigdefault(&attributes, &every);
  posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETSIGDEF);
  const int failed = ::posix_spawn(&process.pid_, program.c_str(), &actions, &attributes, argv.data(), environ);
  posix_spawn_file_actions_destroy(&actions);
  posix_spawnattr_destroy(&attributes);
  if (failed == 0) return process;
  process.pid_ = 0;
  return not_started(option, failed);
}

Process& Process::operator=(Process&& other) noexcept {
  kill();
  pid_ = std::exchange(other.pid_, 0);
  socket_ = std::exchange(other.socket_, -1);
  status_ = other.status_;
  return *this;
}

/// In /proc/PID/stat, the state follows the name, which is in parentheses and may contain anything.
bool Process::is_stopped() const {
  std::ifstream file(fmt::format("/proc/{}/stat", pid_));
  std::string line;
  std::getline(file, line);
  const std::size_t end = line.rfind(") ");
  return end != std::string::npos && line.size() > end + 2 && (line[end + 2] == 'T' || line[end + 2] == 't');
}

bool Process::wait_for(int milliseconds) {
  for (; pid_ > 0; --milliseconds) {
    if (::waitpid(pid_, &status_, WNOHANG) != 0) pid_ = 0;
    if (pid_ == 0 || milliseconds <= 0) break;
    ::poll(nullptr, 0, 1);
  }
  return pid_ == 0;
}

std::string Process::kill() {
  if (socket_ >= 0) ::close(std::exchange(socket_, -1));
  if (pid_ == 0) {
    if (WIFSIGNALED(status_)) return fmt::format("it ended by signal {}", WTERMSIG(status_));
    return fmt::format("it ended with status {}", WEXITSTATUS(status_));
  }
  ::kill(pid_, SIGKILL);
  ::waitpid(pid_, &status_, 0);
  pid_ = 0;
  return "it was killed";
}

}  // namespace vla::serve
