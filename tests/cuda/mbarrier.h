// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace vla::test::cuda {

/// What a thread has learned from phases of mbarriers that it waited for, which is all that whoever arrived knew.
class Knowledge {
 public:
  /// How far a warp was when one of its threads arrived last.
  struct Arrival {
    std::uint64_t time = 0, warp_time = 0;
    int thread = -1;
  };
  /// Of a warp of the cluster, numbered through all blocks.
  Arrival arrival(std::size_t warp) const { return warp < arrivals_.size() ? arrivals_[warp] : Arrival(); }
  /// How many phases of an mbarrier of the cluster have ended.
  std::uint64_t n_phase(std::size_t mbarrier) const { return mbarrier < phases_.size() ? phases_[mbarrier] : 0; }

  void learn(std::size_t warp, const Arrival& arrival);
  void learn_phases(std::size_t mbarrier, std::uint64_t n);
  void learn(const Knowledge& other);

 private:
  std::vector<Arrival> arrivals_;
  std::vector<std::uint64_t> phases_;
};

/// An object in shared memory that counts arrivals of threads, and bytes of copies, in phases. A phase ends when all
/// arrivals and bytes that it expects have come. Source: PTX ISA 9.0, "mbarrier".
class Mbarrier {
 public:
  Mbarrier(std::size_t number, int n_arrival) : number_(number), n_arrival_(n_arrival), n_left_(n_arrival) {}
  /// Its number in the cluster.
  std::size_t number() const { return number_; }
  std::uint64_t n_phase() const { return n_phase_; }
  /// A thread that knows this arrives, and expects bytes besides.
  void arrive(const Knowledge& knows, std::int64_t n_byte);
  void bring(std::int64_t n_byte);
  /// Whether the phase of this parity has ended; then the thread learns what came with it.
  bool try_wait(unsigned parity, Knowledge& knows);
  /// Phases that somebody has waited for.
  std::uint64_t n_waited() const { return n_waited_; }

 private:
  void end_phase();

  std::size_t number_;
  int n_arrival_, n_left_;
  std::int64_t n_byte_ = 0;  // expected and not there; negative where they are there and not expected yet
  std::uint64_t n_phase_ = 0, n_waited_ = 0;
  Knowledge arrived_, ended_;  // of this phase, and of those that ended
};

}  // namespace vla::test::cuda
