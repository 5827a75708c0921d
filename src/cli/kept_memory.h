// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "observe/observer.h"

namespace vla::cli {

/// Decides how much freed memory malloc keeps. By default malloc keeps up to 64 MB forever for each thread that
/// allocated some. With this observer, large blocks return to the system as soon as they are freed, except for the size
/// that the acts of the last half minute took: without that, every act would need new pages.
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
