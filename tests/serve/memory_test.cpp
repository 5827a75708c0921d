// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The server's threads without memory: every allocation on the way of a request fails once.
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <optional>

#include "observe/log.h"
#include "observe/metrics.h"
#include "observe/recording.h"
#include "observe/trace.h"
#include "serve/support.h"

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kCanFail = false;
#else
constexpr bool kCanFail = true;
#endif

namespace {

constexpr long kNever = std::numeric_limits<long>::min() / 2;
std::atomic<long> countdown = kNever;  // allocations of other threads until some fail
long n_failing = 1;                    // so many of them, one after the other
thread_local bool is_test = false;

/// Threads of the clients' libzmq end the process without memory: they are not what is tested.
bool is_of_server() {
  char name[16] = {};
  return !is_test && prctl(PR_GET_NAME, name) == 0 && std::strncmp(name, "ZMQ", 3) != 0;
}

/// Whether this allocation is one of those that fail.
[[maybe_unused]] bool fails() {
  if (countdown.load(std::memory_order_relaxed) <= -n_failing || !is_of_server()) return false;
  const long before = countdown.fetch_sub(1);
  if (before > 0 || before <= -n_failing) return false;
  errno = ENOMEM;
  return true;
}

}  // namespace

// In place of the C library's, so that allocations of libpng, libjpeg and the C++ library fail as ours do.
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
extern "C" {
void* __libc_malloc(std::size_t size);
void* __libc_calloc(std::size_t n, std::size_t size);
void* __libc_realloc(void* memory, std::size_t size);
void* __libc_memalign(std::size_t alignment, std::size_t size);
void* malloc(std::size_t size) { return fails() ? nullptr : __libc_malloc(size); }
void* calloc(std::size_t n, std::size_t size) { return fails() ? nullptr : __libc_calloc(n, size); }
void* realloc(void* memory, std::size_t size) { return fails() ? nullptr : __libc_realloc(memory, size); }
void* aligned_alloc(std::size_t alignment, std::size_t size) {
  return fails() ? nullptr : __libc_memalign(alignment, size);
}
int posix_memalign(void** memory, std::size_t alignment, std::size_t size) {
  if (fails()) return ENOMEM;
  *memory = __libc_memalign(alignment, size);
  return *memory == nullptr ? ENOMEM : 0;
}
void* mmap(void* at, std::size_t size, int protection, int flags, int file, off_t offset) noexcept {
  if (fails()) return MAP_FAILED;
  return reinterpret_cast<void*>(syscall(SYS_mmap, at, size, protection, flags, file, offset));
}
}
#endif

using namespace vla;
using namespace vla::test;

namespace {

std::string read(const std::string& file) {
  std::ifstream in(file, std::ios::binary);
  std::string bytes(std::istreambuf_iterator<char>(in), {});
  REQUIRE_FALSE(bytes.empty());
  return bytes;
}

/// Everything that watches a server, at once.
struct Watched {
  char folder[32] = "/tmp/vla_memory_XXXXXX";
  int nowhere = ::open("/dev/null", O_WRONLY | O_CLOEXEC);
  observe::Metrics metrics;
  std::optional<observe::Log> log;
  std::unique_ptr<observe::Trace> trace;
  std::unique_ptr<observe::Recorder> recorder;

  Watched() {
    REQUIRE(mkdtemp(folder) != nullptr);
    log.emplace(nowhere, observe::LogFormat::json, observe::Level::debug);
    trace = std::move(*observe::Trace::open(folder + std::string("/trace.json")));
    recorder = std::move(*observe::Recorder::open(folder + std::string("/recording"), 1 << 30));
  }
  ~Watched() {
    recorder.reset();
    trace.reset();
    log.reset();
    ::close(nowhere);
    std::filesystem::remove_all(folder);
  }
  std::vector<observe::Observer*> all() { return {&metrics, &*log, trace.get(), recorder.get()}; }
};

struct Server {
  Watched watched;
  Running running{{}, watched.all()};
  /// Of another peer, whose turn comes after that of the client whose request fails.
  Peer other{"tcp://127.0.0.3:0;" + running.address().substr(std::string("tcp://").size())};
};

/// Sends the request again and again, and lets each allocation on its way fail once, with those that follow.
void fail_each_allocation(Server& server, const v1::Request& request, long n_at_once = 1) {
  n_failing = n_at_once;
  const std::string bytes = request.SerializeAsString();
  auto peer = std::make_unique<Peer>(server.running.address());
  check_serves(*peer);
  int n_told = 0, n_lost = 0, n_unreached = 0;
  for (long n = 0; n_unreached < 3; ++n) {
    REQUIRE(n < 5000);
    CAPTURE(n);
    countdown = n;
    peer->send(bytes);
    const auto response = peer->receive(n_at_once == 1 ? 500 : 100);
    n_unreached = countdown.exchange(kNever) > -n_at_once ? n_unreached + 1 : 0;
    check_serves(server.other);
    if (!response) {
      ++n_lost;
      peer = std::make_unique<Peer>(server.running.address());
    } else if (response->has_error()) {
      CHECK(code_of(*response) == "OUT_OF_MEMORY");
      CHECK((response->request_id() == request.request_id() || n_at_once > 1));  // it may not have been read
      ++n_told;
    }
    check_serves(*peer);  // and no second answer has come
  }
  CHECK(n_told > 0);
  CHECK((n_lost <= 20 || n_at_once > 1));  // what the connection itself needs: it ends, and the client sees that
  MESSAGE(n_told, " told, ", n_lost, " lost their connection");
}

bool can_fail() {
  if (!kCanFail) MESSAGE("SKIP: a sanitizer has the allocator");
  return is_test = kCanFail;
}

}  // namespace

TEST_CASE("whichever allocations of a request fail, its client hears of it once, and the next request is served") {
  if (!can_fail()) return;
  Server server;
  v1::Request request = act_request(golden(), 7);
  SUBCASE("an act of raw frames") { fail_each_allocation(server, request); }
  SUBCASE("an act, and those allocations that are to tell of it") { fail_each_allocation(server, request, 4); }
  SUBCASE("an act of a PNG") {
    request.mutable_act()->mutable_views(0)->set_png(read(kGolden + "/camera1.png"));
    fail_each_allocation(server, request);
  }
  SUBCASE("an act of a PNG that is turned") {
    request.mutable_act()->mutable_views(0)->set_png(read(VLA_SOURCE_DIR "/tests/processor/data/images/xmp.png"));
    fail_each_allocation(server, request);
  }
  SUBCASE("an act of a JPEG") {
    request.mutable_act()->mutable_views(0)->set_jpeg(read(VLA_SOURCE_DIR "/tests/processor/data/images/exif_3.jpg"));
    fail_each_allocation(server, request);
  }
  SUBCASE("a description") {
    request = request_of(7);
    request.mutable_describe();
    fail_each_allocation(server, request);
  }
  is_test = false;
}

TEST_CASE("whichever allocation fails while an act takes the place of one that waits, each of them gets one answer") {
  if (!can_fail()) return;
  n_failing = 1;
  Watched watched;
  Brake brake;
  Running running({}, watched.all(), &brake);
  const auto connect = [&] { return std::make_unique<Peer>(running.address()); };
  auto other = connect(), peer = connect();
  v1::Request health = request_of(9);
  health.mutable_health();
  const auto await_acts = [&](unsigned n) {
    for (unsigned found = n + 1; found != n;) {
      const v1::HealthReply now = other->ask(health).health();
      found = now.queue_depth() + (now.computing() ? 1 : 0);
    }
  };
  int n_lost = 0;
  bool reached = true;
  for (int n = 0; reached; ++n) {
    CAPTURE(n);
    other->send(act_request(golden(), 1));
    brake.await(2 * n + 1);
    peer->send(act_request(golden(), 2));
    await_acts(2);
    countdown = n;
    peer->send(act_request(golden(), 3));
    auto response = peer->receive(500);
    reached = countdown.exchange(kNever) <= -n_failing;
    brake.let_go(2);
    if (!other->receive(500)) other = connect(), ++n_lost;  // it was still busy with the one before
    await_acts(0);
    peer->send(health);
    std::vector<std::uint64_t> answered;
    for (; response && response->request_id() != 9; response = peer->receive(500))
      answered.push_back(response->request_id());
    std::sort(answered.begin(), answered.end());
    if (response) {
      CHECK(answered == std::vector<std::uint64_t>{2, 3});
    } else {
      peer = connect(), ++n_lost;
    }
  }
  CHECK(n_lost <= 10);
  is_test = false;
}

TEST_CASE(
    "whichever allocation fails while a plan of a new shape is built, the act is out of memory and the next one is "
    "right") {
  if (!kCanFail) return;
  Observation observation = golden().observation;
  observation.text = "go";
  const Noise noise = golden().noise;
  n_failing = 1;
  std::vector<float> expected;
  bool reached = true;
  for (long n = 0; reached; n += 1 + n / 8) {
    CAPTURE(n);
    const auto engine = load_engine(kGolden + "/bundle.gguf");
    countdown = n;
    const auto failed = engine->act(observation, noise);
    reached = countdown.exchange(kNever) <= -n_failing;
    if (!failed) CHECK(failed.error().code == Code::out_of_memory);
    const auto chunk = engine->act(observation, noise);
    REQUIRE(chunk.ok());
    if (expected.empty()) expected = chunk->actions;
    CHECK(chunk->actions == expected);
    if (failed) CHECK(failed->actions == expected);
  }
}
