// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/control.h>

#include <array>
#include <vector>

namespace vla::control {

/// Writes a text into a problem, cut to its size.
void tell(Problem& problem, std::string_view code, const char* format, ...) noexcept
    __attribute__((format(printf, 3, 4)));

/// The rules of a control loop, as python/vla_cpp/control/schedule.py explains them: a state machine without clock,
/// thread or socket. It allocates memory once, for all chunks that may overlap.
class Schedule {
 public:
  /// `max_age` is in ticks; -1 admits any age.
  struct Options {
    int horizon = 0, d_action = 0, replan_every = 0;
    Blend blend;
    Late late = Late::unset;
    std::int64_t max_age = -1;
    std::vector<float> max_jump;  // none, or one per column
    Limiter* limiter = nullptr;
  };

  /// Errors: usage.
  explicit Schedule(Options options);

  void reset() noexcept;
  bool wants(std::int64_t tick) noexcept;
  void observe(std::int64_t tick) noexcept;
  void fail() noexcept;
  /// Takes a chunk. Returns false, sets `problem` and uses nothing of the chunk if it has another shape, a number that
  /// is not finite, or too many rows that break a limit. A chunk that arrives too late is dropped and counted.
  bool receive(const Answer& answer, std::int64_t tick, Problem& problem) noexcept;
  /// `human`: a person's command, which replaces the policy's; empty for the policy's.
  Action next(std::int64_t tick, std::span<const float> human) noexcept;
  /// The same as `next` if no chunk has a row.
  Action hold(std::int64_t tick) noexcept;
  /// Discards the chunks and the observation under way. The last command stays.
  void forget_chunks() noexcept { n_source_ = 0, is_flying_ = false; }

  /// Returns the next rows of the newest chunk, at most n_row, as the network's normalized output.
  std::span<const float> leftover(int n_row) const noexcept;
  int delay() const noexcept;

  LoopStats counts;

 private:
  static constexpr int kDelays = 16;  // latest inferences that determine the delay
  /// Rows that may be commanded; row i is meant for step `step + i`. A held command is one row, repeated.
  struct Source {
    std::int64_t step = 0, tick = -1, entered = 0;
    int n_row = 0, fade = 0;
    std::vector<float> rows, normalized;
    bool is_held = false, has_normalized = false;
  };

  void begin(std::int64_t tick) noexcept;
  bool is_admissible(std::int64_t step, std::int64_t observed, int n_row, std::int64_t tick) const noexcept;
  Source& add_source() noexcept;
  int make_fade(std::int64_t tick) noexcept;
  void weigh() noexcept;
  Action held(std::int64_t tick) noexcept;
  bool may_act(std::int64_t tick, Action& action) noexcept;
  void mix(std::span<float> row) const noexcept;
  void limit(Action& action) noexcept;
  const Source& source(std::size_t i) const noexcept { return sources_[order_[i]]; }

  Options options_;
  std::vector<Source> sources_;     // memory; `order_` says which are in use, the oldest first
  std::vector<std::size_t> order_;  // the first n_source_ are in use, the others free
  std::size_t n_source_ = 0;
  std::vector<double> weights_;
  std::vector<float> values_, last_, wanted_;
  std::vector<std::uint8_t> cut_;
  bool has_last_ = false, is_flying_ = false, is_warm_ = false, is_stopped_ = false;
  std::int64_t step_ = 0, flight_step_ = 0, flight_tick_ = 0;
  std::array<int, kDelays> delays_ = {};
  std::int64_t n_delay_ = 0;
  Problem stop_;
};

}  // namespace vla::control
