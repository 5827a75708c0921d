// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/mbarrier.h"

#include <algorithm>

#include "cuda/fault.h"

namespace vla::test::cuda {

void Knowledge::learn(std::size_t warp, const Arrival& arrival) {
  if (arrivals_.size() <= warp) arrivals_.resize(warp + 1);
  if (arrivals_[warp].time < arrival.time) arrivals_[warp] = arrival;
}

void Knowledge::learn_phases(std::size_t mbarrier, std::uint64_t n) {
  if (phases_.size() <= mbarrier) phases_.resize(mbarrier + 1);
  phases_[mbarrier] = std::max(phases_[mbarrier], n);
}

void Knowledge::learn(const Knowledge& other) {
  for (std::size_t i = 0; i < other.arrivals_.size(); ++i)
    if (other.arrivals_[i].time != 0) learn(i, other.arrivals_[i]);
  for (std::size_t i = 0; i < other.phases_.size(); ++i)
    if (other.phases_[i] != 0) learn_phases(i, other.phases_[i]);
}

void Mbarrier::arrive(const Knowledge& knows, std::int64_t n_byte) {
  if (n_left_ == 0) throw Fault("arrives at an mbarrier more often than it counts in a phase");
  arrived_.learn(knows);
  n_byte_ += n_byte, --n_left_;
  end_phase();
}

void Mbarrier::bring(std::int64_t n_byte) {
  n_byte_ -= n_byte;
  end_phase();
}

void Mbarrier::end_phase() {
  constexpr std::int64_t kMostBytes = 1 << 20;
  if (n_byte_ >= kMostBytes || n_byte_ <= -kMostBytes) throw Fault("more bytes than an mbarrier counts");
  if (n_left_ != 0 || n_byte_ != 0) return;
  ++n_phase_, n_left_ = n_arrival_;
  ended_.learn(arrived_);
  arrived_ = {};
}

bool Mbarrier::try_wait(unsigned parity, Knowledge& knows) {
  if (n_phase_ % 2 == parity) return false;
  knows.learn(ended_);
  knows.learn_phases(number_, n_phase_);
  n_waited_ = std::max(n_waited_, n_phase_);
  return true;
}

}  // namespace vla::test::cuda
