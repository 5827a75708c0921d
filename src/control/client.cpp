// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A policy at `vla serve` (docs/protocol.md). The client's own thread owns the socket. It shares one slot with the
// robot's thread: first an observation to send, then its answer. `phase` tells which thread may use the slot, so that
// neither waits for the other.
#include <fmt/format.h>
#include <pthread.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <random>
#include <thread>
#include <zmq.hpp>

#include "base/clock.h"
#include "base/printable.h"
#include "base/thread.h"
#include "control/schedule.h"
#include "wire/envelope.h"
#include "wire/interface.h"

namespace vla::control {
namespace {

constexpr std::int64_t kMaxAnswer = 16 << 20;  // bytes
constexpr int kHeartbeatMs = 1000, kReconnectMs = 100, kMaxWaiting = 8;
constexpr float kFarAction = 1e6f, kMaxAction = 4294967296.0f;  // python/vla_cpp/answer.py says why
constexpr std::uint32_t kMaxSize = 1 << 16, kMaxColumns = 1 << 12;

/// idle: no thread uses the slot. filled: the socket's thread reads the observation. sent: it waits for the answer.
/// answered: the robot's thread reads the answer.
enum class Phase : int { idle, filled, sent, answered };

Problem problem_of(std::string_view code, const std::string& where, const std::string& expected,
                   const std::string& found, const std::string& hint = "") {
  Problem problem;
  tell(problem, code, "%s", Error(std::string(code), where, expected, found, hint).what());
  return problem;
}

Problem problem_of(const v1::Error& error) {
  const std::string text[] = {printable(error.where()), printable(error.expected()), printable(error.found()),
                              printable(error.hint())};
  return problem_of(code_name(wire::code_of(error.code())), text[0], text[1], text[2], text[3]);
}

/// A DEALER socket, and a monitor that reports when the server disconnects. It is not used again after a loss: a new
/// one replaces it, so that it cannot deliver an answer to an earlier request.
class Connection {
 public:
  Connection(zmq::context_t& context, const std::string& address, const ClientOptions& options)
      : socket_(context, zmq::socket_type::dealer), monitor_(context, zmq::socket_type::pair) {
    static std::atomic<unsigned> n_made = 0;
    socket_.set(zmq::sockopt::linger, 0);
    socket_.set(zmq::sockopt::heartbeat_ivl, kHeartbeatMs);
    socket_.set(zmq::sockopt::heartbeat_timeout, 3 * kHeartbeatMs);
    socket_.set(zmq::sockopt::reconnect_ivl, kReconnectMs);
    socket_.set(zmq::sockopt::maxmsgsize, kMaxAnswer);
    socket_.set(zmq::sockopt::rcvhwm, kMaxWaiting);
    if (!options.server_key.empty()) {
      std::array<char, 41> own = {};
      if (zmq_curve_public(own.data(), options.secret_key.c_str()) != 0) throw zmq::error_t();
      socket_.set(zmq::sockopt::curve_serverkey, options.server_key);
      socket_.set(zmq::sockopt::curve_publickey, std::string(own.data()));
      socket_.set(zmq::sockopt::curve_secretkey, options.secret_key);
    }
    const std::string events = fmt::format("inproc://vla-control-{}", n_made++);
    constexpr int kEvents = ZMQ_EVENT_DISCONNECTED | ZMQ_EVENT_HANDSHAKE_FAILED_AUTH |
                            ZMQ_EVENT_HANDSHAKE_FAILED_PROTOCOL | ZMQ_EVENT_HANDSHAKE_FAILED_NO_DETAIL;
    if (zmq_socket_monitor(socket_.handle(), events.c_str(), kEvents) != 0) throw zmq::error_t();
    monitor_.set(zmq::sockopt::linger, 0);
    monitor_.connect(events);
    socket_.connect(address);
  }

  bool send(const std::string& bytes) {
    return socket_.send(zmq::buffer(bytes), zmq::send_flags::dontwait).has_value();
  }
  bool receive(zmq::message_t& message) { return socket_.recv(message, zmq::recv_flags::dontwait).has_value(); }
  bool is_lost() {
    zmq::message_t event;
    return monitor_.recv(event, zmq::recv_flags::dontwait).has_value();
  }
  /// Waits for an answer, a loss, or a byte at `wake`.
  void wait(int wake, int ms) {
    std::array<zmq_pollitem_t, 3> items = {
        {{nullptr, wake, ZMQ_POLLIN, 0}, {socket_.handle(), 0, ZMQ_POLLIN, 0}, {monitor_.handle(), 0, ZMQ_POLLIN, 0}}};
    zmq_poll(items.data(), static_cast<int>(items.size()), ms);
  }

 private:
  zmq::socket_t socket_, monitor_;
};

/// Reads the spec of a policy from its description. Errors: incompatible, usage.
Spec spec_of(const v1::Description& whole, const std::string& embodiment, const std::string& address) {
  const v1::Description* robot = &whole;
  std::string tags;
  for (const v1::Description& each : whole.embodiments()) {
    tags += (tags.empty() ? "" : ", ") + printable(each.embodiment());
    if (each.embodiment() == embodiment) robot = &each;
  }
  if (!tags.empty() && robot == &whole) throw Error("usage", "embodiment", "one of " + tags, embodiment);
  const auto n_column = static_cast<std::uint32_t>(robot->actions_size());
  const bool is_sound = 1 <= robot->horizon() && robot->horizon() <= kMaxSize && 1 <= n_column &&
                        n_column <= kMaxColumns && robot->n_action_steps() <= kMaxSize && robot->rate_hz() >= 0 &&
                        robot->rate_hz() <= 1e6;
  if (!is_sound)
    throw Error("incompatible", address, "the description of a policy",
                fmt::format("{} rows of {} columns at {:g} Hz", robot->horizon(), n_column, robot->rate_hz()),
                "what listens there?");
  Spec spec = {.bundle = printable(whole.bundle().name()),
               .checksum = whole.bundle().checksum(),
               .embodiment = embodiment,
               .horizon = static_cast<int>(robot->horizon()),
               .d_action = static_cast<int>(n_column),
               .rate_hz = robot->rate_hz(),
               .n_action_steps = static_cast<int>(robot->n_action_steps()),
               .real_time_chunking = printable(robot->real_time_chunking())};
  for (const v1::ViewSpec& view : robot->views()) spec.views.push_back(printable(view.name()));
  for (const v1::StateSpec& state : robot->states())
    spec.states.push_back({printable(state.name()), state.dimensions_size()});
  for (const v1::Dimension& action : robot->actions()) {
    spec.action_names.push_back(printable(action.name()));
    spec.action_units.push_back(printable(action.unit()));
  }
  const auto is_empty = [](const std::string& text) { return text.empty(); };
  if (std::all_of(spec.action_names.begin(), spec.action_names.end(), is_empty)) spec.action_names.clear();
  return spec;
}

v1::LoopState state_of(const LoopStats& stats) {
  v1::LoopState state;
  state.set_driver(stats.is_driven ? v1::LoopState::PERSON : v1::LoopState::POLICY);
  state.set_actions(static_cast<std::uint64_t>(stats.actions));
  state.set_human(static_cast<std::uint64_t>(stats.human));
  state.set_held(static_cast<std::uint64_t>(stats.held));
  state.set_missed(static_cast<std::uint64_t>(stats.missed));
  state.set_limited(static_cast<std::uint64_t>(stats.limited));
  state.set_refused(static_cast<std::uint64_t>(stats.refused));
  return state;
}

void add(v1::Act& act, const Frame& frame) {
  v1::View& view = *act.add_views();
  view.set_name(frame.view);
  if (frame.bytes.empty()) {
    view.mutable_absent();
  } else if (frame.width > 0) {
    view.mutable_rgb()->set_width(static_cast<std::uint32_t>(frame.width));
    view.mutable_rgb()->set_height(static_cast<std::uint32_t>(frame.height));
    view.mutable_rgb()->set_rows(frame.bytes.data(), frame.bytes.size());
  } else if (frame.bytes[0] == std::byte{0x89}) {
    view.set_png(frame.bytes.data(), frame.bytes.size());
  } else {
    view.set_jpeg(frame.bytes.data(), frame.bytes.size());
  }
}

/// Says why a frame is invalid; empty for a valid frame.
std::string wrong(const Frame& frame) {
  const std::int64_t size = std::int64_t{3} * frame.width * frame.height;
  if (frame.width < 0 || frame.height < 0) return fmt::format("{} x {}", frame.width, frame.height);
  if (frame.width > 0 && static_cast<std::int64_t>(frame.bytes.size()) != size && !frame.bytes.empty())
    return fmt::format("{} bytes for {} x {} pixels of three", frame.bytes.size(), frame.width, frame.height);
  return {};
}

}  // namespace

struct Client::Impl {
  const std::string address;
  const ClientOptions options;
  Spec spec;
  std::string interface;
  std::uint64_t max_message = 0;
  zmq::context_t context{1};
  std::optional<Connection> connection;
  std::thread thread;
  int wake = -1;
  std::atomic<bool> is_stopping = false;

  std::atomic<Phase> phase = Phase::idle;
  const Observation* observation = nullptr;  // the robot's thread owns it; read in the phase `filled`
  std::vector<float> leftover;
  Leftover how;
  bool has_leftover = false;
  Answer answer;  // the robot's thread reads it in the phase `answered`
  std::vector<float> rows, normalized;

  // For the socket's thread only.
  v1::Request request;
  std::uint64_t last_id = std::random_device()(), waits_for = 0;  // awaited request; 0: none
  std::optional<std::uint64_t> seed;
  bool takes_loop = false;  // the server knows Act.loop
  Clock::time_point until;

  Impl(std::string at, ClientOptions given) : address(std::move(at)), options(std::move(given)) {
    if (!(options.timeout > 0) || !(options.timeout <= 86400))
      throw Error("usage", "timeout", "seconds above 0, a day at most", fmt::format("{:g}", options.timeout));
    if (options.server_key.empty() != options.secret_key.empty())
      throw Error("usage", "CURVE", "server_key and secret_key", "one of them");
    wake = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    if (wake < 0) throw Error("io", "eventfd", "a descriptor", "none left");
  }
  ~Impl() {
    is_stopping = true;
    ring();
    if (thread.joinable()) thread.join();
    close(wake);
  }

  /// Wakes the socket's thread.
  void ring() const {
    const std::uint64_t one = 1;
    [[maybe_unused]] const auto written = write(wake, &one, sizeof one);
  }

  // --- the socket's thread -------------------------------------------------------------------------------------------

  /// Connects, sends a hello and asks for the description. Errors: usage, for an invalid address.
  void connect() {
    takes_loop = false;
    try {
      connection.emplace(context, address, options);
    } catch (const zmq::error_t& error) {
      throw Error("usage", address, "an address like tcp://127.0.0.1:5555", error.what());
    }
    v1::Request hello = new_request();
    hello.mutable_hello()->set_min_version(wire::kMaxVersion);
    hello.mutable_hello()->set_max_version(wire::kMaxVersion);
    hello.mutable_hello()->set_client_name("vla-control");
    v1::Request describe = new_request();
    describe.mutable_describe()->set_policy(options.policy);
    connection->send(hello.SerializeAsString());
    connection->send(describe.SerializeAsString());
  }

  v1::Request new_request() {
    v1::Request fresh;
    fresh.set_protocol_version(wire::kMaxVersion);
    fresh.set_request_id(++last_id);
    return fresh;
  }

  /// Waits for the description. Errors: timeout, disconnected, incompatible, and the server's.
  void learn() {
    connect();
    const auto end =
        Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(options.timeout));
    zmq::message_t message;
    while (spec.horizon == 0) {
      const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(end - Clock::now()).count();
      if (left <= 0)
        throw Error("timeout", address, fmt::format("an answer within {:g} s", options.timeout), "none",
                    "is the server up, and its address right?");
      connection->wait(wake, static_cast<int>(std::min<std::int64_t>(left, 1000)));
      v1::Response response;
      while (spec.horizon == 0 && connection->receive(message)) {
        if (message.more() || !response.ParseFromArray(message.data(), static_cast<int>(message.size())))
          throw Error("incompatible", address, "answers of vla serve", "other bytes", "what listens there?");
        if (response.has_error())
          throw Error(problem_of(response.error()).code, address, "", problem_of(response.error()).message);
        if (response.has_hello()) greet(response.hello());
        if (response.has_description()) learn(response.description());
      }
      if (spec.horizon == 0 && connection->is_lost())
        throw Error("disconnected", address, "", "the connection was lost", "is it vla serve, and are its keys these?");
    }
    rows.reserve(static_cast<std::size_t>(spec.horizon) * static_cast<std::size_t>(spec.d_action));
    normalized.reserve(rows.capacity()), leftover.reserve(rows.capacity());
  }

  void greet(const v1::HelloReply& hello) {
    takes_loop = std::count(hello.features().begin(), hello.features().end(), "loop") > 0;
  }

  void learn(const v1::Description& description) {
    spec = spec_of(description, options.embodiment, address);
    interface = wire::interface_of(description);
    max_message = description.limits().max_message_bytes();
  }

  void run() {
    while (!is_stopping) {
      int ms = 1000;
      if (waits_for != 0)
        ms = static_cast<int>(std::clamp<std::int64_t>(
            std::chrono::ceil<std::chrono::milliseconds>(until - Clock::now()).count(), 0, 1000));
      if (connection) {
        connection->wait(wake, ms);
      } else {
        zmq_pollitem_t item = {nullptr, wake, ZMQ_POLLIN, 0};
        zmq_poll(&item, 1, ms);
      }
      std::uint64_t n = 0;
      [[maybe_unused]] const auto drained = read(wake, &n, sizeof n);
      take_answers();
      if (phase.load(std::memory_order_acquire) == Phase::filled) send();
      if (waits_for != 0 && Clock::now() >= until) {
        drop(problem_of("timeout", address, fmt::format("an answer within {:g} s", options.timeout), "none",
                        "is the server up?"));
      }
    }
    connection.reset();
  }

  void send() {
    waits_for = 0;  // forgets a request that was abandoned
    Problem problem;
    if (!connection) {
      try {
        connect();
      } catch (const Error& error) {
        tell(problem, error.code, "%s", error.what());
      }
    }
    if (problem.code[0] == '\0') problem = write_request();
    if (problem.code[0] == '\0') {
      const std::string bytes = request.SerializeAsString();
      if (max_message > 0 && bytes.size() > max_message)
        problem = problem_of("too_large", "observation", fmt::format("at most {} bytes", max_message),
                             fmt::format("{}", bytes.size()), "send smaller frames, or JPEG");
      else if (!connection->send(bytes))
        problem = problem_of("disconnected", address, "a server that reads", "a full queue", "ask less often");
    }
    Phase filled = Phase::filled;
    phase.compare_exchange_strong(filled, Phase::sent, std::memory_order_acq_rel);
    phase.notify_all();
    waits_for = request.request_id();
    until = Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(options.timeout));
    if (problem.code[0] != '\0') finish(problem);
  }

  Problem write_request() {
    request = new_request();
    v1::Act& act = *request.mutable_act();
    for (const Frame& frame : observation->frames) {
      if (const std::string found = wrong(frame); !found.empty())
        return problem_of("bad_observation", frame.view, "a frame of three bytes a pixel, or a file", found);
      add(act, frame);
    }
    for (const StateVector& state : observation->states) {
      v1::State& sent = *act.add_states();
      sent.set_name(state.name);
      sent.mutable_values()->Add(state.values.begin(), state.values.end());
    }
    if (observation->text) act.set_text(*observation->text);
    if (takes_loop && observation->loop) *act.mutable_loop() = state_of(*observation->loop);
    act.set_policy(options.policy);
    act.set_embodiment(spec.embodiment);
    act.set_deadline_ms(static_cast<std::uint64_t>(std::ceil(1000 * options.timeout)));
    seed = observation->seed;
    if (seed) act.set_seed(*seed);
    if (has_leftover) {
      v1::Leftover& sent = *act.mutable_leftover();
      sent.set_n_row(static_cast<std::uint32_t>(leftover.size()) / static_cast<std::uint32_t>(spec.d_action));
      sent.set_d_action(static_cast<std::uint32_t>(spec.d_action));
      sent.mutable_values()->Add(leftover.begin(), leftover.end());
      sent.set_delay(static_cast<std::uint32_t>(how.delay));
      if (!how.schedule.empty()) sent.set_schedule(std::string(how.schedule)), sent.set_max_guidance(how.max_guidance);
    }
    return {};
  }

  void take_answers() {
    zmq::message_t message;
    for (int i = 0; connection && i < kMaxWaiting && connection->receive(message); ++i) {
      v1::Response response;
      if (message.more() || !response.ParseFromArray(message.data(), static_cast<int>(message.size())))
        drop(problem_of("incompatible", address, "answers of vla serve", "other bytes", "what listens there?"));
      else
        take(response);
    }
    if (connection && connection->is_lost())
      drop(problem_of("disconnected", address, "", "the connection was lost", "the next observation connects anew"));
  }

  void take(const v1::Response& response) {
    const v1::Bundle* bundle = response.has_chunk()         ? &response.chunk().bundle()
                               : response.has_description() ? &response.description().bundle()
                                                            : nullptr;
    if (response.has_error() && (response.error().code() == v1::Error::INCOMPATIBLE || response.request_id() == 0))
      return drop(problem_of(response.error()));
    if (response.protocol_version() != wire::kMaxVersion)
      return drop(problem_of("incompatible", address, "answers of protocol version 1",
                             fmt::format("version {}", response.protocol_version())));
    const bool is_other = bundle != nullptr && bundle->checksum() != spec.checksum && options.policy.empty();
    if (is_other || (response.has_description() && wire::interface_of(response.description()) != interface))
      return drop(problem_of("incompatible", address, "the policy that was there before: " + spec.bundle,
                             printable(bundle->name()), "make a new Client, and read its spec"));
    if (response.has_hello()) return greet(response.hello());
    if (waits_for == 0 || response.request_id() != waits_for) return;  // for a greeting, or for an abandoned request
    if (response.has_error()) return finish(problem_of(response.error()));
    if (!response.has_chunk())
      return finish(problem_of("incompatible", address, "an action chunk", "an answer of another kind"));
    finish(read_chunk(response.chunk()));
  }

  /// Takes rows and notes of a chunk. Returns a problem if the chunk does not fit the request.
  Problem read_chunk(const v1::ActionChunk& chunk) {
    const auto n = static_cast<std::size_t>(spec.horizon) * static_cast<std::size_t>(spec.d_action);
    const auto wrong = [&](const std::string& what, const std::string& expected, const std::string& found) {
      return problem_of("incompatible", fmt::format("{}: {} of the answer", address, what), expected, found,
                        "what listens there?");
    };
    const auto size = [](std::uint64_t row, std::uint64_t column) { return fmt::format("({}, {})", row, column); };
    if (static_cast<int>(chunk.horizon()) != spec.horizon || static_cast<int>(chunk.d_action()) != spec.d_action ||
        static_cast<std::size_t>(chunk.actions_size()) != n)
      return wrong("shape", size(static_cast<std::uint64_t>(spec.horizon), static_cast<std::uint64_t>(spec.d_action)),
                   size(chunk.horizon(), chunk.d_action()));
    bool is_named = spec.action_names.empty() || chunk.names_size() == spec.d_action;
    for (int i = 0; is_named && i < static_cast<int>(spec.action_names.size()); ++i)
      is_named = printable(chunk.names(i)) == spec.action_names[static_cast<std::size_t>(i)];
    if (!is_named) return wrong("column names", fmt::format("{}", fmt::join(spec.action_names, ", ")), "others");
    if (seed && (!chunk.has_seed() || chunk.seed() != *seed))
      return wrong("seed", fmt::format("{}", *seed), "another one");
    const std::size_t n_normalized = spec.real_time_chunking.empty() ? 0 : n;
    if (static_cast<std::size_t>(chunk.normalized_size()) != n_normalized)
      return wrong("normalized rows", fmt::format("{} numbers", n_normalized),
                   fmt::format("{}", chunk.normalized_size()));
    rows.assign(chunk.actions().begin(), chunk.actions().end());
    normalized.assign(chunk.normalized().begin(), chunk.normalized().end());
    for (const std::vector<float>* part : {&rows, &normalized})
      for (const float value : *part)
        if (!(std::abs(value) <= kMaxAction))
          return problem_of("bad_action", "answer", fmt::format("finite actions within {:g}", kMaxAction),
                            fmt::format("{:g}", value));
    answer.n_note = chunk.notes_size();
    answer.note = {};
    if (chunk.notes_size() > 0) tell(answer.note, "noted", "%s", printable(chunk.notes(0)).c_str());
    const auto far = std::find_if(rows.begin(), rows.end(), [](float value) { return std::abs(value) > kFarAction; });
    if (far != rows.end() && answer.n_note++ == 0)
      tell(answer.note, "noted", "an action of %g, which no unit of a robot explains", static_cast<double>(*far));
    return {};
  }

  /// Ends the connection, and the request under way with it.
  void drop(const Problem& problem) {
    connection.reset();
    if (waits_for != 0) finish(problem);
  }

  void finish(const Problem& problem) {
    waits_for = 0;
    answer.problem = problem;
    answer.horizon = spec.horizon, answer.d_action = spec.d_action;
    answer.rows = rows, answer.normalized = normalized;
    Phase sent = Phase::sent;  // another phase if the robot's thread has abandoned it
    phase.compare_exchange_strong(sent, Phase::answered, std::memory_order_acq_rel);
    phase.notify_all();
  }
};

Client::Client(const std::string& address, const ClientOptions& options)
    : impl_(std::make_unique<Impl>(address, options)) {
  Impl& client = *impl_;
  client.learn();
  Result<std::thread> thread = start_thread("client", [&client] { client.run(); });
  if (!thread)
    throw Error(code_name(thread.error().code), thread.error().where, thread.error().expected, thread.error().found);
  client.thread = std::move(*thread);
  const sched_param lowest = {.sched_priority = 1};
  if (options.real_time && pthread_setschedparam(client.thread.native_handle(), SCHED_FIFO, &lowest) != 0)
    throw Error("usage", "real_time", "the right to SCHED_FIFO", "none", "RLIMIT_RTPRIO, or CAP_SYS_NICE");
}

Client::~Client() = default;

const Spec& Client::spec() const { return impl_->spec; }

void Client::submit(const Observation& observation, const Leftover* leftover) noexcept {
  Impl& client = *impl_;
  abandon();
  client.observation = &observation;
  client.has_leftover = leftover != nullptr;
  if (leftover != nullptr) {
    client.leftover.assign(leftover->rows.begin(), leftover->rows.end());
    client.how = *leftover;
  }
  client.phase.store(Phase::filled, std::memory_order_release);
  client.ring();
}

bool Client::is_reading() const noexcept { return impl_->phase.load(std::memory_order_acquire) == Phase::filled; }

const Answer* Client::poll() noexcept {
  return impl_->phase.load(std::memory_order_acquire) == Phase::answered ? &impl_->answer : nullptr;
}

void Client::wait() noexcept {
  for (Phase now = impl_->phase.load(); now == Phase::filled || now == Phase::sent; now = impl_->phase.load())
    impl_->phase.wait(now);
}

void Client::abandon() noexcept {
  std::atomic<Phase>& phase = impl_->phase;
  for (Phase now = phase.load(); now == Phase::filled; now = phase.load()) phase.wait(now);  // frames are still read
  phase.store(Phase::idle);
}

}  // namespace vla::control
