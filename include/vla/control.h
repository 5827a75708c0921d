// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Running a policy's chunks on a robot from C++20: a client of `vla serve`, and the loop that decides which row of
// which chunk is commanded in each control period. docs/control.md explains both, and the same classes of Python.
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

/// A problem while the robot runs. Its text has a fixed size, so that telling it allocates nothing.
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
  std::string checksum = {};  // of the file
  std::string embodiment = {};
  std::vector<std::string> views = {};
  std::vector<State> states = {};
  std::vector<std::string> action_names = {}, action_units = {};  // of the columns; units may be empty
  int horizon = 0, d_action = 0;                                  // shape of a chunk
  double rate_hz = 0;                                             // 0: the bundle does not say
  int n_action_steps = 0;                                         // the same
  std::string real_time_chunking = {};                            // "guided", "inpainted" or empty
};

/// One camera frame. `bytes` are pixels (red, green, blue; rows from top to bottom) of width x height, or with width 0
/// a JPEG or PNG file; empty: the robot has no such camera. They are not copied by `step`: they have to stay as they
/// are until ChunkLoop::is_reading() is false.
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
  std::int64_t human = 0;  // commanded by a person
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

/// Real-time chunking: rows of the chunk before that are not executed yet.
struct Leftover {
  std::span<const float> rows = {};  // normalized, n_row x d_action
  int delay = 0;
  std::string_view schedule = {};  // of a guided policy
  double max_guidance = 0;         // of a guided policy
};

/// The answer to an observation: rows, or a problem.
struct Answer {
  Problem problem = {};
  int horizon = 0, d_action = 0;
  std::span<const float> rows = {}, normalized = {};  // normalized is empty where the policy does not go on from rows
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
  /// The answer; null while it is under way. Valid until the next call of submit or abandon.
  virtual const Answer* poll() noexcept = 0;
  /// Waits until poll has an answer.
  virtual void wait() noexcept = 0;
  /// The answer under way is not wanted any more. Waits for what is_reading tells.
  virtual void abandon() noexcept = 0;
};

struct ClientOptions {
  std::string policy = {};      // its name, where the server has several
  std::string embodiment = {};  // tag of the robot, where the policy has several
  double timeout = 10;          // seconds that an answer may take, connecting included
  std::string server_key = {};  // CURVE: the server's public key, and with it
  std::string secret_key = {};  // this client's secret key; 40 characters each
  bool real_time = false;       // the thread of the socket gets the lowest priority of SCHED_FIFO
};

/// A policy at `vla serve`. A thread of its own has the socket; a lost server is connected to again by the next
/// observation.
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

/// position: a place. velocity: units per second. difference: units per control period. gripper: an opening or a
/// decision, which may jump and is never mixed with another; of its limits it has a range alone.
enum class Kind { position, velocity, difference, gripper };

/// Limits of an action column, in its unit and seconds; what has no value is not limited.
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

  /// A file in the format of docs/control.md. Errors: usage.
  static Limits read(const std::string& path);
  static Limits parse(std::string_view json);
  /// The same in the order of the policy's columns. Errors: usage, where names or units differ from the bundle's.
  Limits of(const Spec& spec) const;
};

/// Keeps the commands of one robot within limits, one `step` for each control period. Changes as little as it can of a
/// command that breaks a limit, and nothing of one that keeps all of them. From every command there is a stop within
/// all limits: python/vla_cpp/control/limits.py says why.
class Limiter {
 public:
  /// `limits` in the order of the columns; `rate_hz`: commands per second. Errors: usage.
  Limiter(const Limits& limits, double rate_hz);

  /// The robot rests at these values; of velocities and differences zero is meant. Errors: usage, for a position
  /// outside of its limits.
  void rest_at(std::span<const double> values);
  void reset() noexcept;
  bool is_ready() const noexcept;  // every position is known
  /// The command for `wanted`, which is finite, into `out`; `cut` becomes 1 for columns that differ. Returns how many
  /// do. Before rest_at of positions it commands nothing and returns -1.
  int step(std::span<const float> wanted, std::span<float> out, std::span<std::uint8_t> cut) noexcept;
  /// How many of the rows of a chunk break a limit by themselves or together with the rows before; `first`: the first
  /// of them.
  int breaks(std::span<const float> rows, int& first) noexcept;
  double refuse_above() const noexcept { return refuse_above_; }
  bool is_gripper(std::size_t column) const noexcept { return motions_[column].is_gripper; }
  /// What stands still where no column is a position: zeros, and of a gripper its last command.
  void still(std::span<float> out) const noexcept;

 private:
  /// A way to rest: n + 1 accelerations, each a share of the way between bounds that the limits give them.
  struct Stop {
    double change = 0, share = 0;  // the acceleration before them
    int n = -1;
  };
  /// A row of a chunk: its value, and what it changes.
  struct Seen {
    double place, velocity, change;
  };
  struct Motion {
    Column column;
    bool is_place = false, is_gripper = false;
    double low = 0, high = 0, slowest = 0, fastest = 0, acceleration = 0, jerk = 0;  // per step
    double place = 0, velocity = 0, change = 0;
    Seen seen = {};
    double rounding = 0;         // of a chunk's values and their differences, which are float32
    Stop stop;                   // from the last command
    int n_stop = 0, n_gone = 0;  // steps of a stop that was found last; of `stop`, those that were commanded
  };
  static double step_column(Motion& motion, double wanted) noexcept;
  static bool find_stop(Motion& motion, double change, Stop& stop) noexcept;
  static bool find_steps(Motion& motion, double velocity, Stop& stop) noexcept;
  std::vector<Motion> motions_;
  double refuse_above_;
};

// --- a controller at a higher rate -----------------------------------------------------------------------------------

enum class Method { unset, linear, cubic, minimum_jerk };

/// Commands within control periods, one period later than without it: positions follow a polynomial to the command,
/// velocities and grippers are held, differences are spread. Formulas: python/vla_cpp/control/interpolate.py.
class Interpolator {
 public:
  /// Errors: usage.
  Interpolator(std::vector<Kind> kinds, Method method, double rate_hz);

  double delay_s() const noexcept { return delay_s_; }
  /// The robot rests at these values. Errors: usage.
  void start_at(std::span<const double> values);
  /// A control period begins, in which this command is to be reached. False, and nothing, for a value that is not
  /// finite or before start_at.
  bool to(std::span<const float> values) noexcept;
  /// The command when the share s of the period is over: above the one before, 1 at most; else false. Of a difference
  /// it is the part since the one before.
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

/// As the arguments of Python's ChunkLoop. `unset` and an empty Blend are refused: they change how the robot moves.
struct LoopOptions {
  double rate_hz = 0;    // 0: what the bundle says
  int replan_every = 0;  // 0: the checkpoint's n_action_steps
  Mode mode = Mode::unset;
  Blend blend = {};
  Late late = Late::unset;
  OnNote on_note = OnNote::unset;
  RealTimeChunking rtc = {};
  std::optional<double> max_age = {};  // seconds; none: the duration of a chunk, with Mode::sync any
  std::vector<float> max_jump = {};    // one number, or one per column; empty: any
  std::optional<Limits> limits = {};   // in any order
  bool allow_other_rate = false;
  std::function<double()> clock = {};      // seconds; empty: steady_clock
  std::function<void(double)> sleep = {};  // of pace(); empty: sleep_for
};

/// command: a row of a chunk. held: what `late` says. none: nothing to command. stopped: Late::stop, until reset.
/// failed: a problem that another observation would have again.
enum class ActionState { command, held, none, stopped, failed };

struct Action {
  ActionState state = ActionState::none;
  std::span<const float> values = {};          // world units; empty: command nothing. Valid until the next step
  std::int64_t tick = 0;                       // control period
  std::int64_t age = -1;                       // periods since the oldest observation that contributes; -1 where held
  bool limited = false;                        // max_jump or a limit cut it
  std::span<const std::uint8_t> clamped = {};  // 1 for each column that a limit cut; empty where none
  bool human = false;                          // a person commanded it
  std::span<const float> policy = {};          // then: what the policy wanted, before any limit; empty without a row
  const Problem* problem = nullptr;            // of `stopped` and `failed`
};

/// Turns observations into one action per control period. One thread may use it.
class ChunkLoop {
 public:
  /// The policy outlives the loop. Errors: usage, unsupported.
  ChunkLoop(Policy& policy, LoopOptions options);
  ~ChunkLoop();

  using Observe = std::function<void(Observation&)>;
  /// Where the robot rests, one number for each action, for `limits`; again after reset. Errors: usage.
  void start_at(std::span<const double> values);
  /// Waits for a first chunk. Errors: all that the policy answers.
  void begin(const Observe& observe);
  /// One control period. `observe` is called only when an observation is wanted, and must not throw. `human`: of the
  /// person who drives, one number for each action, within the limits; without it, while a person drives, the command
  /// is what `late` says.
  Action step(const Observe& observe, std::span<const float> human = {}) noexcept;
  /// A person drives from now on. The policy is still asked, and Action::policy is what it wanted. Errors: usage, where
  /// another person drives.
  void take_over(const std::string& who);
  /// The policy drives again, from what it sees then: chunks of the time before are not used, and commands go on from
  /// the person's last one. Errors: usage, for somebody who does not drive.
  void give_back(const std::string& who);
  /// Sleeps until the next control period.
  void pace() noexcept;
  /// Whether frames of the last observation are still being read.
  bool is_reading() const noexcept;
  LoopStats stats() const noexcept;
  /// The problem of the newest inference; its code is empty where there was none.
  const Problem& last_problem() const noexcept;
  double rate_hz() const noexcept;
  /// A new episode. What is still under way is not used.
  void reset() noexcept;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vla::control
