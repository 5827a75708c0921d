// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "processor/processor.h"

namespace vla::bench {

/// The sizes of observations. A size that is not given is the largest that the bundle allows.
struct WorkloadSizes {
  std::optional<int> n_view;
  int width = 0, height = 0;  // size of the raw frames; 0: the size after the recipe
  std::optional<int> n_text;  // tokens in the instruction
};

/// One observation that costs as much as a real one of these sizes: frames as PNG files in memory, a state, and an
/// instruction of exactly that many tokens.
class Workload {
 public:
  /// Errors: usage, if the bundle cannot take such an observation.
  static Result<Workload> make(const Processor& processor, const WorkloadSizes& sizes);

  /// Decodes the frames again, like a program that receives image files.
  Status decode();
  const Observation& observation() const { return observation_; }

  int n_view() const { return static_cast<int>(frames_.size()); }
  int n_text() const { return n_text_; }
  int width() const { return width_; }
  int height() const { return height_; }

 private:
  struct File {
    std::string view;
    std::vector<std::byte> png;
  };
  std::vector<File> frames_;
  Observation observation_;
  int n_text_ = 0, width_ = 0, height_ = 0;
};

}  // namespace vla::bench
