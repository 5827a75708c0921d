// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "engine/engine.h"

namespace vla::test {

/// One case: a bundle, an observation, the solver's noise, and what the reference computes on
/// them.
struct GoldenCase {
  std::string path;
  Observation observation;
  std::vector<float> noise;

  static GoldenCase read(const std::string& path);
  std::string bundle() const { return path + "/bundle.gguf"; }
  std::vector<Tap> expected() const;
};

/// Every case of every architecture, as `<arch>/<name>` folders.
std::vector<std::string> golden_paths();

/// A loaded engine; fails the test where loading fails.
std::unique_ptr<Engine> load_engine(const std::string& bundle, const std::string& taps = "",
                                    const std::string& kernels = "", const std::vector<Tap>& inject = {});
const Tap& find_tap(const std::vector<Tap>& taps, const std::string& path);

}  // namespace vla::test
