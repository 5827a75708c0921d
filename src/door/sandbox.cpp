// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "door/sandbox.h"

#include <dirent.h>
#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <vector>

namespace vla::door {
namespace {

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kIsWatched = true;  // a sanitizer reserves terabytes of addresses and makes system calls of its own
#elif defined(__has_feature)
constexpr bool kIsWatched = __has_feature(address_sanitizer) || __has_feature(thread_sanitizer);
#else
constexpr bool kIsWatched = false;
#endif

void limit(int resource, std::size_t most) {
  rlimit now = {};
  ::getrlimit(static_cast<__rlimit_resource>(resource), &now);
  now.rlim_max = std::min<rlim_t>(now.rlim_max, most);
  now.rlim_cur = now.rlim_max;
  ::setrlimit(static_cast<__rlimit_resource>(resource), &now);
}

void close_others(int n_kept) {
  std::vector<int> others;
  if (DIR* const folder = ::opendir("/proc/self/fd")) {
    while (const dirent* entry = ::readdir(folder))
      if (const int fd = std::atoi(entry->d_name); fd >= n_kept && fd != ::dirfd(folder)) others.push_back(fd);
    ::closedir(folder);
  }
  for (const int fd : others) ::close(fd);
}

#if defined(__x86_64__)
constexpr std::uint32_t kArchitecture = AUDIT_ARCH_X86_64;
#elif defined(__aarch64__)
constexpr std::uint32_t kArchitecture = AUDIT_ARCH_AARCH64;
#else
constexpr std::uint32_t kArchitecture = 0;
#endif

/// System calls for sockets, timers, memory and the end of the process.
constexpr long kAllowed[] = {
    SYS_read,
    SYS_write,
    SYS_readv,
    SYS_writev,
    SYS_recvfrom,
    SYS_recvmsg,
    SYS_sendto,
    SYS_sendmsg,
    SYS_accept,
    SYS_accept4,
    SYS_shutdown,
    SYS_close,
    SYS_getsockopt,
    SYS_setsockopt,
    SYS_getsockname,
    SYS_getpeername,
    SYS_fcntl,
    SYS_ioctl,
    SYS_epoll_ctl,
    SYS_epoll_pwait,
    SYS_ppoll,
    SYS_timerfd_settime,
    SYS_timerfd_gettime,
    SYS_clock_gettime,
    SYS_clock_nanosleep,
    SYS_nanosleep,
    SYS_gettimeofday,
    SYS_brk,
    SYS_munmap,
    SYS_mremap,
    SYS_madvise,
    SYS_futex,
    SYS_getrandom,
    SYS_getpid,
    SYS_gettid,
    SYS_tgkill,
    SYS_rt_sigaction,
    SYS_rt_sigprocmask,
    SYS_rt_sigreturn,
    SYS_restart_syscall,
    SYS_sched_yield,
    SYS_exit,
    SYS_exit_group,
#if defined(__x86_64__)
    SYS_poll,
    SYS_epoll_wait,
    SYS_time,
#endif
};
/// Allowed unless argument 2 asks for executable memory.
constexpr long kMapping[] = {SYS_mmap, SYS_mprotect};

sock_filter statement(unsigned code, std::size_t k) {
  return {static_cast<std::uint16_t>(code), 0, 0, static_cast<std::uint32_t>(k)};
}
sock_filter jump(unsigned code, std::size_t k, std::uint8_t yes, std::uint8_t no) {
  return {static_cast<std::uint16_t>(code), yes, no, static_cast<std::uint32_t>(k)};
}

/// A forbidden call fails with EPERM; a call of another architecture kills the process.
std::vector<sock_filter> make_filter() {
  std::vector<sock_filter> filter = {
      statement(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, arch)),
      jump(BPF_JMP | BPF_JEQ | BPF_K, kArchitecture, 1, 0),
      statement(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
      statement(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, nr)),
  };
  for (const long call : kAllowed) {
    filter.push_back(jump(BPF_JMP | BPF_JEQ | BPF_K, static_cast<std::size_t>(call), 0, 1));
    filter.push_back(statement(BPF_RET | BPF_K, SECCOMP_RET_ALLOW));
  }
  for (const long call : kMapping) {
    filter.push_back(jump(BPF_JMP | BPF_JEQ | BPF_K, static_cast<std::size_t>(call), 0, 4));
    filter.push_back(statement(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, args[2])));
    filter.push_back(jump(BPF_JMP | BPF_JSET | BPF_K, PROT_EXEC, 0, 1));
    filter.push_back(statement(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM));
    filter.push_back(statement(BPF_RET | BPF_K, SECCOMP_RET_ALLOW));
  }
  filter.push_back(statement(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM));
  return filter;
}

}  // namespace

void confine(const Limits& limits, int parent, int n_kept) {
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (::getppid() != parent) std::_Exit(0);  // the parent had ended before
  // Ignores signals that the terminal sends to both: the server ends this process by closing its socket, so that it can
  // still tell its clients.
  for (const int signal : {SIGINT, SIGTERM, SIGHUP, SIGPIPE}) ::signal(signal, SIG_IGN);
  close_others(n_kept);
  ::prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
  limit(RLIMIT_NOFILE, limits.descriptors);
  limit(RLIMIT_CORE, 0);
  if (kIsWatched) return;
  limit(RLIMIT_DATA, limits.memory);
  limit(RLIMIT_AS, limits.memory + (512u << 20));  // including its libraries
}

std::string confine_calls() {
  if (kIsWatched) return "a sanitizer's build has no limits of memory and system calls";
  if (kArchitecture == 0) return "no filter of system calls for this architecture";
  std::vector<sock_filter> filter = make_filter();
  const sock_fprog program{static_cast<unsigned short>(filter.size()), filter.data()};
  if (::prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program) == 0) return {};
  return std::string("no filter of system calls: ") + std::strerror(errno);
}

}  // namespace vla::door
