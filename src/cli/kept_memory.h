// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "observe/observer.h"

namespace vla::cli {

/// Decides how much freed memory malloc keeps. By itself it keeps up to 64 MB for each thread that took some, for ever.
/// Here large blocks go back to the system as soon as they are freed, except for what the answered acts of the last
/// half minute took: their pages would be made anew for each of them.
class KeptMemory final : public observe::Observer {
 public:
  KeptMemory() { keep(0); }
  void answered(const observe::Answered& answered) override;

 private:
  void keep(std::size_t size);

  std::size_t kept_ = 0;  // size of the largest act that needs no new pages
  Clock::time_point last_ = {};
};

}  // namespace vla::cli
