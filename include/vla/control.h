// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Running a policy's chunks on a robot from C++20: a client of `vla serve`, and the loop that decides which row of
// which chunk is commanded in each control period. docs/control.md explains both, and the same classes in Python.
//
// Constructors and set-up functions throw vla::control::Error. The functions of a control period (`ChunkLoop::step`,
// `Limiter::step`, `Interpolator::to` and `at`) are noexcept, take no lock, allocate nothing and never wait, except
// that `step` waits for the chunk with Mode::sync.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace vla::control {

/// Thrown during set-up. `code` is a name of docs/protocol.md, or "timeout" or "disconnected".
struct Error : std::runtime_error {
  Error(std::string code, const std::string& where, const std::string& expected, const std::string& found,
        const std::string& hint = "");
  std::string code;
};

/// A problem while the robot runs. Its text has a fixed size, so that reporting it allocates nothing.
struct Problem {
  char code[24] = "";  // empty: nothing
  char message[400] = "";
  bool is(std::string_view other) const { return other == code; }
};

// --- policies --------------------------------------------------------------------------------------------------------

struct Spec {
  struct State {
    std::string name = {};
    int size = 0;
  };
  std::string bundle = {};    // file name
  std::string checksum = {};  // the bundle file's
  std::string embodiment = {};
  std::vector<std::string> views = {};
  std::vector<State> states = {};
  std::vector<std::string> action_names = {}, action_units = {};  // one for each column; units may be empty
  int horizon = 0, d_action = 0;                                  // shape of a chunk
  double rate_hz = 0;                                             // 0: the bundle does not say
  int n_action_steps = 0;               // rows of a chunk to execute; 0: the bundle does not say
  std::string real_time_chunking = {};  // "guided", "inpainted" or empty
};

/// One camera frame. `bytes` are pixels (red, green, blue; rows from top to bottom) of width x height, or with width 0
/// a JPEG or PNG file; empty: the robot has no such camera. `step` does not copy them: they must stay unchanged until
/// ChunkLoop::is_reading() is false.
struct Frame {
  std::string view = {};
  int width = 0, height = 0;
  std::span<const std::byte> bytes = {};
};

struct StateVector {
  std::string name = {};
  std::vector<float> values = {};  // world units
};

/// Counts of a loop since it began or was reset.
struct LoopStats {
  std::int64_t actions = 0, held = 0, chunks = 0, stale = 0, failed = 0, limited = 0, refused = 0, missed = 0,
               notes = 0;
  std::int64_t human = 0;  // commands of a person
  bool is_driven = false;  // a person drives
  int delay = -1;          // steps of the slowest of the last 16 inferences; -1 before the first
};

/// The inputs of a policy. The loop fills one Observation again and again; vectors that keep their sizes allocate
/// nothing.
struct Observation {
  std::vector<Frame> frames = {};
  std::vector<StateVector> states = {};
  std::optional<std::string> text = {};  // may be empty; none for a policy that reads no instruction
  std::optional<std::uint64_t> seed = {};
  std::optional<LoopStats> loop = {};  // set by ChunkLoop: shown by the page of `vla serve`
};

/// Real-time chunking: rows of the previous chunk that are not executed yet.
struct Leftover {
  std::span<const float> rows = {};  // normalized, n_row x d_action
  int delay = 0;
  std::string_view schedule = {};  // for a guided policy
  double max_guidance = 0;         // for a guided policy
};

/// The answer to an observation: rows, or a problem.
struct Answer {
  Problem problem = {};
  int horizon = 0, d_action = 0;
  std::span<const float> rows = {}, normalized = {};  // normalized is empty if the policy takes no leftover
  int n_note = 0;
  Problem note = {};  // the first of the notes
};

/// Answers one observation at a time.
class Policy {
 public:
  virtual ~Policy() = default;
  virtual const Spec& spec() const = 0;
  /// Sends an observation. Its frames are read until is_reading() is false.
  virtual void submit(const Observation& observation, const Leftover* leftover) noexcept = 0;
  virtual bool is_reading() const noexcept = 0;
  /// Returns the answer; null while it is under way. Valid until the next call of submit or abandon.
  virtual const Answer* poll() noexcept = 0;
  /// Waits until poll has an answer.
  virtual void wait() noexcept = 0;
  /// Discards the answer under way. Waits until is_reading() is false.
  virtual void abandon() noexcept = 0;
};

struct ClientOptions {
  std::string policy = {};      // name of the policy, if the server has several
  std::string embodiment = {};  // tag of the robot, if the policy has several
  double timeout = 10;          // maximum seconds for an answer, including connecting
  std::string server_key = {};  // CURVE: the server's public key; set both keys or neither
  std::string secret_key = {};  // CURVE: this client's secret key; each has 40 characters
  bool real_time = false;       // the socket's thread gets the lowest SCHED_FIFO priority
};

/// A policy served by `vla serve`. The client's own thread owns the socket. After the server is lost, the next
/// observation connects again.
class Client : public Policy {
 public:
  /// Waits for the description of the policy. Errors: usage, timeout, disconnected, incompatible, and the server's.
  explicit Client(const std::string& address, const ClientOptions& options = {});
  ~Client() override;

  const Spec& spec() const override;
  void submit(const Observation& observation, const Leftover* leftover) noexcept override;
  bool is_reading() const noexcept override;
  const Answer* poll() noexcept override;
  void wait() noexcept override;
  void abandon() noexcept override;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

// --- limits ----------------------------------------------------------------------------------------------------------

/// position: a place. velocity: units per second. difference: units per control period. gripper: an opening, or a
/// decision to open or close. It may jump, is never blended, and has a range as its only limit.
enum class Kind { position, velocity, difference, gripper };

/// Limits of an action column, in its unit and seconds; a field without a value sets no limit.
struct Column {
  std::string name = {};
  Kind kind = Kind::position;
  std::string unit = {};
  std::optional<double> low = {}, high = {}, velocity = {}, acceleration = {}, jerk = {};
};

/// Limits of all columns, and the share of a chunk's rows that may break them before the chunk is refused.
struct Limits {
  std::vector<Column> columns = {};
  double refuse_above = 0;

  /// Reads a file in the format of docs/control.md. Errors: usage.
  static Limits read(const std::string& path);
  static Limits parse(std::string_view json);
  /// Returns the limits in the order of the policy's columns. Errors: usage if names or units differ from the bundle's.
  Limits of(const Spec& spec) const;
};

/// Keeps the commands of one robot within limits, one `step` for each control period. It changes a command that breaks
/// a limit as little as possible, and leaves any other command unchanged. After every command the robot can still stop
/// within all limits; python/vla_cpp/control/limits.py explains why.
class Limiter {
 public:
  /// `limits` in the order of the columns; `rate_hz`: commands per second. Errors: usage.
  Limiter(const Limits& limits, double rate_hz);

  /// Sets the values at which the robot rests; velocities and differences start at zero. Errors: usage, for a position
  /// outside of its limits; bad_action, unless there is one finite number for each column.
  void rest_at(std::span<const double> values);
  void reset() noexcept;
  bool is_ready() const noexcept;  // every position and gripper is known
  /// Writes the command for `wanted`, whose values must be finite, to `out`, and sets `cut` to 1 for columns that
  /// differ. Returns how many differ. Until rest_at has set all positions and grippers, it commands nothing and returns
  /// -1.
  int step(std::span<const float> wanted, std::span<float> out, std::span<std::uint8_t> cut) noexcept;
  /// Returns how many rows of a chunk break a limit, by themselves or together with the rows before; `first` becomes
  /// the index of the first one.
  int breaks(std::span<const float> rows, int& first) noexcept;
  double refuse_above() const noexcept { return refuse_above_; }
  bool is_gripper(std::size_t column) const noexcept { return motions_[column].is_gripper; }
  /// Writes the command to stand still if no column is a position: zeros, and for a gripper its last command.
  void still(std::span<float> out) const noexcept;

 private:
  /// A stop: n + 1 accelerations. Each lies at the fraction `share` between the bounds that the limits give it.
  struct Stop {
    double change = 0, share = 0;  // `change`: the acceleration before the stop
    int n = -1;
  };
  /// A row of a chunk: its value, and the velocity and acceleration to it, per step.
  struct Seen {
    double place, velocity, change;
  };
  struct Motion {
    Column column;
    bool is_place = false, is_gripper = false;
    double low = 0, high = 0, slowest = 0, fastest = 0, acceleration = 0, jerk = 0;  // per step
    double place = 0, velocity = 0, change = 0;
    Seen seen = {};
    double rounding = 0;         // error of a chunk's float32 values and their differences
    Stop stop;                   // from the last command
    int n_stop = 0, n_gone = 0;  // steps of the stop found last; how many steps of `stop` were commanded
  };
  static double step_column(Motion& motion, double wanted) noexcept;
  static bool find_stop(Motion& motion, double change, Stop& stop) noexcept;
  static bool find_steps(Motion& motion, double velocity, Stop& stop) noexcept;
  std::vector<Motion> motions_;
  double refuse_above_;
};

// --- a controller at a higher rate -----------------------------------------------------------------------------------

enum class Method { unset, linear, cubic, minimum_jerk };

/// Computes commands within control periods, one period later than without it: positions follow a polynomial to the
/// command, velocities and grippers are held, differences are spread. Formulas: python/vla_cpp/control/interpolate.py.
class Interpolator {
 public:
  /// Errors: usage.
  Interpolator(std::vector<Kind> kinds, Method method, double rate_hz);

  double delay_s() const noexcept { return delay_s_; }
  /// The robot rests at these values. Errors: usage.
  void start_at(std::span<const double> values);
  /// Begins a control period that ends at this command. Returns false, without effect, for a value that is not finite
  /// or before start_at.
  bool to(std::span<const float> values) noexcept;
  /// Writes the command at the share `s` of the period. Returns false unless `s` is larger than in the previous call
  /// and at most 1. For a difference, it writes the part since the previous call.
  bool at(double s, std::span<float> out) noexcept;

 private:
  struct Motion {
    Kind kind;
    double command, coefficients[6];
  };
  static void motion(const Motion& column, double s, double (&out)[3]) noexcept;
  std::vector<Motion> columns_;
  Method method_;
  double delay_s_, s_ = 1;
  bool has_start_ = false;
};

// --- the loop --------------------------------------------------------------------------------------------------------

enum class Mode { unset, sync, async, rtc };
enum class Late { unset, hold, zero, stop };
enum class OnNote { unset, ignore, raise };

/// How overlapping chunks share a command.
class Blend {
 public:
  Blend() = default;
  static Blend replace() { return linear(0); }
  static Blend linear(int fade_steps);
  static Blend ensemble(double decay);

 private:
  friend class Schedule;
  bool is_set_ = false, is_ensemble_ = false;
  int fade_steps_ = 0;
  double decay_ = 0;
};

struct RealTimeChunking {
  int overlap = 0;
  std::string schedule = {};
  double max_guidance = 0;
};

/// The arguments of Python's ChunkLoop. `unset` and an empty Blend are refused: they change how the robot moves.
struct LoopOptions {
  double rate_hz = 0;    // 0: the bundle's rate
  int replan_every = 0;  // 0: the checkpoint's n_action_steps
  Mode mode = Mode::unset;
  Blend blend = {};
  Late late = Late::unset;
  OnNote on_note = OnNote::unset;
  RealTimeChunking rtc = {};
  std::optional<double> max_age = {};  // seconds; none: the duration of a chunk, with Mode::sync no limit
  std::vector<float> max_jump = {};    // one number, or one per column; empty: no limit
  std::optional<Limits> limits = {};   // columns in any order
  bool allow_other_rate = false;
  std::function<double()> clock = {};      // seconds; empty: steady_clock
  std::function<void(double)> sleep = {};  // used by pace(); empty: sleep_for
};

/// command: a row of a chunk. held: the command that `late` selects. none: nothing to command. stopped: Late::stop,
/// until reset. failed: a problem that would recur with another observation.
enum class ActionState { command, held, none, stopped, failed };

struct Action {
  ActionState state = ActionState::none;
  std::span<const float> values = {};          // world units; empty: command nothing. Valid until the next step
  std::int64_t tick = 0;                       // control period
  std::int64_t age = -1;                       // periods since the oldest observation that contributes; -1 if held
  bool limited = false;                        // max_jump or a limit cut it
  std::span<const std::uint8_t> clamped = {};  // 1 for each column that a limit cut; empty if none is cut
  bool human = false;                          // a person commanded it
  std::span<const float> policy = {};          // with `human`: the policy's command before limits; empty without a row
  const Problem* problem = nullptr;            // set for `stopped` and `failed`
};

/// Turns observations into one action per control period. One thread may use it.
class ChunkLoop {
 public:
  /// The policy must outlive the loop. Errors: usage, unsupported.
  ChunkLoop(Policy& policy, LoopOptions options);
  ~ChunkLoop();

  using Observe = std::function<void(Observation&)>;
  /// Sets where the robot rests, one number for each action, for `limits`; call it again after reset. Errors: usage.
  void start_at(std::span<const double> values);
  /// Waits for a first chunk. Errors: those of the policy's answer.
  void begin(const Observe& observe);
  /// One control period. `observe` is called only when an observation is wanted, and must not throw. `human`: the
  /// command of the person who drives, one number for each action, which is cut to `limits`. While a person drives
  /// without giving one, `late` selects the command.
  Action step(const Observe& observe, std::span<const float> human = {}) noexcept;
  /// A person drives from now on. The policy still computes, and Action::policy is its command. Errors: usage if
  /// another person drives.
  void take_over(const std::string& who);
  /// The policy drives again, from a new observation: earlier chunks are discarded, and commands continue from the
  /// person's last one. Errors: usage, for somebody who does not drive.
  void give_back(const std::string& who);
  /// Sleeps until the next control period.
  void pace() noexcept;
  /// Whether frames of the last observation are still being read.
  bool is_reading() const noexcept;
  LoopStats stats() const noexcept;
  /// The problem of the newest inference; its code is empty if there was none.
  const Problem& last_problem() const noexcept;
  double rate_hz() const noexcept;
  /// Starts a new episode. An answer under way is discarded.
  void reset() noexcept;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vla::control
