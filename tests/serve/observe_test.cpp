// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <arpa/inet.h>
#include <fcntl.h>
#include <pthread.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>

#include "observe/log.h"
#include "observe/metrics.h"
#include "observe/monitor.h"
#include "observe/recordings.h"
#include "observe/replay.h"
#include "observe/trace.h"
#include "serve/native/codec.h"
#include "serve/support.h"
#include "support/connect_http.h"

namespace observe_test {

using namespace vla;
using namespace vla::test;
using namespace vla::observe;
using namespace vla::serve;

namespace {

/// A folder of its own, gone afterwards.
struct Folder {
  std::filesystem::path path;
  Folder() {
    std::string name = (std::filesystem::temp_directory_path() / "vla_observe_XXXXXX").string();
    REQUIRE(mkdtemp(name.data()) != nullptr);
    path = name;
  }
  ~Folder() { std::filesystem::remove_all(path); }
  std::string operator/(const char* name) const { return (path / name).string(); }
};

struct Pipe {
  std::array<int, 2> fd = {-1, -1};
  Pipe() { REQUIRE(::pipe2(fd.data(), O_CLOEXEC) == 0); }
  ~Pipe() {
    ::close(fd[0]);
    if (fd[1] >= 0) ::close(fd[1]);
  }
  std::string read_all() {
    ::close(std::exchange(fd[1], -1));
    std::string text;
    std::array<char, 4096> part;
    for (ssize_t n; (n = ::read(fd[0], part.data(), part.size())) > 0;)
      text.append(part.data(), static_cast<size_t>(n));
    return text;
  }
};

std::string content(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return (std::ostringstream() << file.rdbuf()).str();
}

/// A request that was answered after 10 ms, of which it waited 4 and was computed for 5.
struct Sample {
  Received request{.client = "12",
                   .peer = "10.0.0.7",
                   .name = "arm 1.0",
                   .request_id = 7,
                   .kind = Kind::act,
                   .size = 3,
                   .at = Clock::now(),
                   .is_first = true};
  Error error{Code::bad_observation, "where", "this", "that", "do"};
  std::string in = "abc", out = "defgh";
  Answered answered(bool with_error, std::size_t n_in = 3) {
    using std::chrono::milliseconds;
    in.resize(n_in, 'x');
    const auto at = request.at;
    Timing stages;
    if (!with_error) stages = {{"decode", 1.0}, {"steps", 3.5}};
    return {.request = request,
            .error = with_error ? &error : nullptr,
            .started = at + milliseconds(4),
            .finished = at + milliseconds(9),
            .sent = at + milliseconds(10),
            .stages = stages,
            .n_sent = out.size(),
            .in = std::as_bytes(std::span(in)),
            .out = std::as_bytes(std::span(out))};
  }
};

/// One request to a monitor of this machine; what comes back until the connection is closed.
std::string ask_http(const std::string& address, const std::string& request) {
  const int fd = test::connect_http(address);
  CHECK(::send(fd, request.data(), request.size(), MSG_NOSIGNAL) == static_cast<ssize_t>(request.size()));
  std::string answer;
  std::array<char, 4096> part;
  for (ssize_t n; (n = ::read(fd, part.data(), part.size())) > 0;) answer.append(part.data(), static_cast<size_t>(n));
  ::close(fd);
  return answer;
}

/// The unused part of a thread's stack, which is filled with a pattern in order to see later how much was never used.
class Stack {
 public:
  /// Of the thread that calls this.
  [[gnu::noinline, gnu::no_sanitize_address]] void paint() {
    pthread_attr_t attributes;
    if (pthread_getattr_np(pthread_self(), &attributes) != 0) return;
    void* low = nullptr;
    std::size_t size = 0;
    pthread_attr_getstack(&attributes, &low, &size);
    pthread_attr_destroy(&attributes);
    low_ = static_cast<volatile char*>(low);
    end_ = static_cast<char*>(__builtin_frame_address(0)) - kMargin;
    for (volatile char* at = low_; at < end_; ++at) *at = kPaint;
  }
  /// Bytes from the lowest address on that nobody has written to since.
  [[gnu::noinline, gnu::no_sanitize_address]] std::size_t unused() const {
    volatile char* at = low_;
    while (at < end_ && *at == kPaint) ++at;
    return static_cast<std::size_t>(at - low_);
  }

 private:
  static constexpr std::ptrdiff_t kMargin = 4096;  // below the frame of `paint` itself
  static constexpr char kPaint = 0x5a;
  volatile char *low_ = nullptr, *end_ = nullptr;
};

v1::Response chunk_of(std::vector<float> actions) {
  v1::Response response = response_to(3);
  v1::ActionChunk& chunk = *response.mutable_chunk();
  chunk.set_horizon(1);
  chunk.set_d_action(static_cast<std::uint32_t>(actions.size()));
  chunk.mutable_actions()->Add(actions.begin(), actions.end());
  chunk.add_names("x");
  chunk.set_seed(4);
  return response;
}

std::string fields_of(const std::vector<Difference>& differences) {
  std::string fields;
  for (const Difference& difference : differences) fields += difference.field + " ";
  return fields;
}

}  // namespace

TEST_CASE("a writer neither waits for a pipe that nobody reads nor cuts a piece: what does not fit is counted") {
  Pipe pipe;
  const auto start = Clock::now();
  {
    Writer writer(pipe.fd[1], Writer::Owns::no, 1 << 20);
    int n_put = 0;
    for (int i = 0; i < 4000; ++i) n_put += writer.put(std::string(999, 'a') + "\n");
    CHECK(std::chrono::duration<double>(Clock::now() - start).count() < 1.0);
    CHECK(n_put > 1000);
    CHECK(n_put < 1300);
    CHECK(writer.n_dropped() == static_cast<std::uint64_t>(4000 - n_put));
  }
  CHECK(std::chrono::duration<double>(Clock::now() - start).count() < 10.0);  // nor at the end
}

TEST_CASE("a writer whose reader went away goes on without a signal") {
  Pipe pipe;
  ::close(std::exchange(pipe.fd[0], ::open("/dev/null", O_RDONLY | O_CLOEXEC)));
  Writer writer(pipe.fd[1], Writer::Owns::no, 1 << 20);
  CHECK(writer.put("a"));
  while (writer.failure() == 0) std::this_thread::yield();
  CHECK(writer.failure() == EPIPE);
  CHECK_FALSE(writer.put("b"));
}

TEST_CASE("a log line is one JSON object whatever its fields hold") {
  Pipe pipe;
  const std::string hostile = "a\n\x1b[2J\"\xff\xfe\x80{}";
  {
    Log log(pipe.fd[1], LogFormat::json, Level::info);
    log.event(Level::debug, "left_out", {});
    log.event(Level::info, "event", {{"text", hostile}});
    Sample sample;
    sample.error.found = hostile;
    log.answered(sample.answered(true));
    log.answered(sample.answered(false));  // at level debug
  }
  std::istringstream lines(pipe.read_all());
  std::vector<nlohmann::json> events;
  for (std::string line; std::getline(lines, line);) events.push_back(nlohmann::json::parse(line));
  REQUIRE(events.size() == 2);
  CHECK(events[0]["text"].get<std::string>().starts_with("a\n\x1b[2J\""));
  CHECK(events[1]["event"] == "request");
  CHECK(events[1]["code"] == "bad_observation");
  CHECK(events[1]["queue_ms"] == 4.0);
  CHECK(events[1]["total_ms"] == 10.0);
}

TEST_CASE("metrics count a request once, and time only what the engine saw") {
  Metrics metrics;
  Sample sample;
  metrics.received(sample.request);
  sample.request.is_first = false;
  metrics.received(sample.request);
  metrics.answered(sample.answered(false));
  metrics.answered(sample.answered(true));
  const std::string text = metrics.text({true, 2, false, 1.5, 1, 1});
  for (const char* line : {"vla_requests_total{code=\"ok\",kind=\"act\"} 1", "vla_received_bytes_total 6",
                           "vla_requests_total{code=\"bad_observation\",kind=\"act\"} 1", "vla_sent_bytes_total 10",
                           "vla_stage_seconds_count{stage=\"total\"} 1", "vla_clients_total 1", "vla_queue_depth 2",
                           "vla_stage_seconds_bucket{stage=\"total\",le=\"0.01\"} 1",
                           "vla_stage_seconds_bucket{stage=\"steps\",le=\"0.0025\"} 0"})
    CHECK_MESSAGE(text.find(std::string(line) + "\n") != std::string::npos, line);
}

TEST_CASE("http is refused where others reach it, unless that was asked for") {
  const Monitor::Sources sources = {[] { return std::string(); }, [] { return std::string(); }};
  for (const char* address : {"0.0.0.0:0", "*:0", "[::]:0", "192.168.0.1:9090"}) {
    const auto refused = Monitor::open(address, false, sources);
    REQUIRE_FALSE(refused.ok());
    CHECK(refused.error().code == Code::usage);
    CHECK(refused.error().hint.find("--insecure") != std::string::npos);
  }
  const auto everywhere = Monitor::open("0.0.0.0:0", true, sources);
  REQUIRE(everywhere.ok());
  CHECK((*everywhere)->address() != "0.0.0.0:0");
}

TEST_CASE("a scrape leaves at least a megabyte of its thread's stack unused") {
  Metrics metrics;
  Stack stack;
  std::size_t unused = 0;
  const auto monitor = Monitor::open("127.0.0.1:0", false,
                                     {[&] {
                                        unused = stack.unused();
                                        stack.paint();
                                        return metrics.text({});
                                      },
                                      [] { return std::string(); }});
  REQUIRE(monitor.ok());
  for (int i = 0; i < 20; ++i)  // a server of several threads would take turns
    CHECK(ask_http((*monitor)->address(), "GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n").starts_with("HTTP/1.1 200"));
  CHECK(unused >= std::size_t{1} << 20);
}

TEST_CASE("two hundred clients that drip their request keep no probe waiting") {
  const auto monitor =
      Monitor::open("127.0.0.1:0", false, {[] { return std::string(); }, [] { return std::string(); }});
  REQUIRE(monitor.ok());
  std::vector<int> dripping;
  const auto start = Clock::now();
  for (int i = 0; i < 200; ++i) {
    dripping.push_back(test::connect_http((*monitor)->address()));
    for (const int fd : dripping) ::send(fd, "G", 1, MSG_NOSIGNAL);
  }
  CHECK(ask_http((*monitor)->address(), "GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n").starts_with("HTTP/1.1 200"));
  CHECK(std::chrono::duration<double>(Clock::now() - start).count() < 10);  // in turn they would take minutes
  for (const int fd : dripping) ::close(fd);
}

TEST_CASE("peers that are refused again and again cause a few hundred lines of the log, and a count of the others") {
  Folder folder;
  const auto fd = open_to_write(folder / "log", false);
  REQUIRE(fd);
  {
    Log log(*fd, LogFormat::json, Level::info);
    for (int i = 0; i < 2000; ++i) log.dropped({"1", "10.0.0.7", "", "handshake", "other bytes"});
  }
  ::close(*fd);
  const std::string lines = content(folder / "log");
  const auto n = std::count(lines.begin(), lines.end(), '\n');
  CHECK(n >= 200);
  CHECK(n < 600);
  CHECK(lines.find("log_limited") != std::string::npos);
}

TEST_CASE("notes of chunks are warnings at the default level, once a minute for a client and what they are about") {
  Folder folder;
  const auto fd = open_to_write(folder / "log", false);
  REQUIRE(fd);
  {
    Log log(*fd, LogFormat::json, Level::warn);
    for (int i = 0; i < 100; ++i) {
      const std::vector<std::string> notes = {"DEGRADED: gripper passes unnormalized",
                                              "state[0] (\"x\"): " + std::to_string(1000 + i) + ", which is far"};
      for (const char* client : {"1", "2"}) {
        Received request;
        request.client = client;
        log.answered(Answered{.request = request, .out_of_range = true, .notes = notes});
      }
    }
  }
  ::close(*fd);
  const std::string lines = content(folder / "log");
  CHECK(std::count(lines.begin(), lines.end(), '\n') == 4);
  CHECK(lines.find(R"("event":"note")") != std::string::npos);
  CHECK(lines.find("DEGRADED") != std::string::npos);
}

TEST_CASE("a trace ends at its limit, is valid JSON then too, and is not written through a symbolic link") {
  Folder folder;
  {
    auto trace = Trace::open(folder / "out.json", 2000);
    REQUIRE(trace);
    Received request;
    for (int i = 0; i < 100; ++i) (*trace)->answered(Answered{.request = request});
    CHECK((*trace)->n_dropped() > 80);
  }
  CHECK(nlohmann::json::accept(content(folder / "out.json")));
  CHECK(std::filesystem::file_size(folder / "out.json") < 3000);
  std::filesystem::create_symlink("out.json", folder.path / "link.json");
  const auto linked = Trace::open(folder / "link.json");
  REQUIRE_FALSE(linked);
  CHECK(linked.error().found == "a symbolic link");
}

TEST_CASE("a trace of a disk that is full is valid JSON wherever it ended, and one that cannot begin is refused") {
  Folder folder;
  struct rlimit before = {};
  REQUIRE(::getrlimit(RLIMIT_FSIZE, &before) == 0);
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  const auto limit_files = [&](rlim_t size) {
    const struct rlimit limit = {size, before.rlim_max};
    REQUIRE(::setrlimit(RLIMIT_FSIZE, &limit) == 0);
  };
  Sample sample;
  for (rlim_t size = 500; size < 3000; size += 37) {
    CAPTURE(size);
    limit_files(size);
    {
      auto trace = Trace::open(folder / "out.json");
      REQUIRE(trace.ok());
      for (int i = 0; i < 10; ++i) (*trace)->answered(sample.answered(false));
    }
    CHECK(std::filesystem::file_size(folder / "out.json") <= size);
    CHECK(nlohmann::json::accept(content(folder / "out.json")));
  }
  limit_files(100);
  CHECK(Trace::open(folder / "out.json").error().code == Code::io);
  limit_files(before.rlim_cur);
  std::signal(SIGXFSZ, handler);
}

TEST_CASE("a trace is valid JSON, and its stages end before their act does") {
  Folder folder;
  Sample sample;
  {
    auto trace = Trace::open(folder / "out.json");
    REQUIRE(trace.ok());
    sample.request.at = Clock::now();
    Answered answered = sample.answered(false);
    answered.stages = {{"decode", 2.0}, {"steps", 400.0}};  // more than there was time for
    (*trace)->answered(answered);
  }
  const auto events = nlohmann::json::parse(content(folder / "out.json"));
  double end_of_act = 0;
  for (const auto& event : events) {
    if (event["ph"] != "X") continue;
    const double end = event["ts"].get<double>() + event["dur"].get<double>();
    if (event["name"] == "act") end_of_act = end;
    CHECK(end <= end_of_act + 1e-6);
  }
  CHECK(end_of_act > 0);
}

TEST_CASE("a recording gives back the bytes that went in, and says whether it is whole") {
  Folder folder;
  v1::Description description;
  description.set_horizon(42);
  Sample sample;
  {
    auto recorder = Recorder::open(folder / "r", 1 << 20);
    REQUIRE(recorder.ok());
    (*recorder)->describe(description);
    (*recorder)->answered(sample.answered(false));
    (*recorder)->answered(sample.answered(true, 0));
    CHECK(Recorder::open(folder / "r", 1 << 20).error().code == Code::io);
  }
  auto recording = Recording::open(folder / "r");
  REQUIRE(recording.ok());
  CHECK(recording->description().horizon() == 42);
  auto record = recording->next();
  REQUIRE((record.ok() && record->has_value()));
  CHECK((*record)->request == "abc");
  CHECK((*record)->response == "defgh");
  record = recording->next();
  REQUIRE((record.ok() && record->has_value()));
  CHECK((*record)->request.empty());
  CHECK_FALSE(recording->is_whole());
  record = recording->next();
  REQUIRE(record.ok());
  CHECK_FALSE(record->has_value());
  CHECK(recording->is_whole());
}

TEST_CASE(
    "whichever bit of a recording is flipped, or wherever it is cut, reading it ends in an error or is not whole") {
  Folder folder;
  Sample sample;
  {
    auto recorder = Recorder::open(folder / "r", 1 << 20);
    REQUIRE(recorder.ok());
    (*recorder)->describe({});
    (*recorder)->answered(sample.answered(false));
  }
  const std::string path = folder / "r" + "/" + kRecordingFile, sound = content(path);
  const auto is_refused = [&](const std::string& bytes) {
    std::ofstream(path, std::ios::binary) << bytes;
    auto recording = Recording::open(folder / "r");
    if (!recording) return true;
    for (;;) {
      const auto record = recording->next();
      if (!record) return true;
      if (!*record) return !recording->is_whole();
    }
  };
  CHECK_FALSE(is_refused(sound));
  for (std::size_t i = 0; i < sound.size(); ++i) {
    std::string bad = sound;
    bad[i] = static_cast<char>(bad[i] ^ (1 << (i % 8)));
    CHECK_MESSAGE(is_refused(bad), i);
    CHECK_MESSAGE(is_refused(sound.substr(0, i)), i);
  }
  CHECK(is_refused(sound + "x"));
}

TEST_CASE("a recorder stops at its limit, tells once, and what it has stays whole") {
  Folder folder;
  Sample sample;
  int n_told = 0;
  {
    auto recorder = Recorder::open(folder / "r", 4000);
    REQUIRE(recorder.ok());
    (*recorder)->on_stop([&](const std::string&, std::uint64_t n) {
      ++n_told;
      CHECK(n == 3);
    });
    (*recorder)->describe({});
    for (int i = 0; i < 9; ++i) (*recorder)->answered(sample.answered(false, i == 5 ? 1 : 1000));
  }
  CHECK(n_told == 1);
  CHECK(std::filesystem::file_size(folder / "r" + "/" + kRecordingFile) <= 4000);
  auto recording = Recording::open(folder / "r");
  REQUIRE(recording.ok());
  int n = 0;
  for (auto record = recording->next(); record.ok() && *record; record = recording->next()) ++n;
  CHECK(n == 3);
  CHECK(recording->is_whole());
}

TEST_CASE("recordings of one server follow each other, are whole each, and share a limit") {
  Folder folder;
  Sample sample;
  std::vector<Recordings::Standing> told;
  Recordings recordings(folder / "r", 4000);
  recordings.on_change([&](const Recordings::Standing& now) { told.push_back(now); });
  CHECK(recordings.begin().error().code == Code::usage);  // no policy yet
  CHECK(recordings.end().error().code == Code::usage);
  REQUIRE(recordings.open().ok());
  recordings.describe({});
  CHECK(recordings.begin().error().code == Code::usage);  // one runs
  recordings.answered(sample.answered(false, 1000));
  REQUIRE(recordings.end().ok());
  recordings.answered(sample.answered(false));
  const Recordings::Standing first = recordings.standing();
  CHECK((!first.on && first.n_request == 1 && first.bytes > 1000 && first.bytes < 1200 && first.why.empty()));

  REQUIRE(recordings.begin().ok());
  CHECK((recordings.standing().on && recordings.standing().n_request == 0));
  for (int i = 0; i < 9; ++i) recordings.answered(sample.answered(false, 1000));
  const Recordings::Standing full = recordings.standing();
  CHECK((!full.on && full.n_request == 2 && full.bytes <= 4000 && full.why == "it reached its limit"));
  REQUIRE(told.size() == 3);
  CHECK((!told[0].on && told[1].on && !told[2].on && told[2].why == full.why));

  CHECK(recordings.end().error().code == Code::usage);  // it ended by itself
  REQUIRE(recordings.begin().ok());                     // of which no room is left for an act
  recordings.answered(sample.answered(false, 1000));
  CHECK((!recordings.standing().on && recordings.standing().n_request == 0));
  int n = 0;
  for (const std::string& path : {first.folder, full.folder}) {
    auto recording = Recording::open(path);
    REQUIRE(recording.ok());
    for (auto record = recording->next(); record.ok() && *record; record = recording->next()) ++n;
    CHECK(recording->is_whole());
  }
  CHECK(n == 3);
}

TEST_CASE("answers are compared by content: times, bundle and runtime may differ, one bit of an action may not") {
  const v1::Response a = chunk_of({1, 2, 0.0f});
  v1::Response b = a;
  b.mutable_chunk()->set_queue_ms(9);
  b.mutable_chunk()->set_engine_ms(9);
  b.mutable_chunk()->add_stages();
  b.mutable_chunk()->mutable_runtime()->set_kernels("others");
  CHECK(compare_answers(a, b).empty());
  b.mutable_chunk()->set_actions(2, -0.0f);  // equal, and another bit
  CHECK(fields_of(compare_answers(a, b)) == "actions ");
  b.mutable_chunk()->set_names(0, "y");
  b.mutable_chunk()->clear_seed();
  CHECK(fields_of(compare_answers(a, b)) == "names seed actions ");
  v1::Response error = response_to(3);
  error.mutable_error()->set_code(v1::Error::DEVICE);
  CHECK(fields_of(compare_answers(a, error)) == "answer code ");
  v1::Response other = error;
  other.mutable_error()->set_code(v1::Error::BAD_ACTION);
  CHECK(fields_of(compare_answers(error, other)) == "code ");
}

}  // namespace observe_test
