// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Where dividing channels helps by itself.
#include "quantize/product_errors.h"

#include <doctest/doctest.h>

#include "base/process.h"
#include "support/editable_bundle.h"
#include "support/stored.h"

namespace product_errors_test {

using namespace vla;
using namespace vla::test;

namespace {

/// The shipped policy has matrices that are large enough for codes.
const std::string kShipped = VLA_SOURCE_DIR "/models/metaworld-tiny.gguf";

Judged observation() {
  std::vector<std::uint8_t> rgb(std::size_t{64} * 64 * 3);
  for (std::size_t i = 0; i < rgb.size(); ++i) rgb[i] = static_cast<std::uint8_t>(i * i / 7);
  return {{.views = {{"corner4", Frame{64, 64, rgb}}},
           .states = {{"observation.state", {0.0f, 0.4f, 0.2f, 1.0f}}},
           .text = "open the faucet"},
          std::uint64_t{7}};
}

/// Every 23rd channel of the norm before a block's MLP, divided by this.
Scaling of_block(const std::string& block, float by) {
  Scaling scaling = {.path = block + ".ffn_norm",
                     .by = std::vector<float>(192, 1),
                     .readers = {block + ".ffn_gate.weight", block + ".ffn_up.weight"},
                     .vectors = {block + ".ffn_norm.weight"}};
  for (std::size_t k = 0; k < scaling.by.size(); k += 23) scaling.by[k] = by;
  return scaling;
}

std::string coded(const std::string& bundle, const char* to) {
  const std::string path = write_file(to, "");
  REQUIRE(quantize(bundle, path, all_as(Rounding::int8), "", [](QuantizeProgress) {}).ok());
  return path;
}

std::vector<std::string> paths(const std::vector<Scaling>& scalings) {
  std::vector<std::string> paths;
  for (const Scaling& scaling : scalings) paths.push_back(scaling.path);
  return paths;
}

}  // namespace

TEST_CASE("dividing channels is kept where they were too large, and left where they were not") {
  const std::string sick = write_file("sick.gguf", ""), all = write_file("all.gguf", "");
  const Scaling plant = of_block("lm.blk.1", 1.0f / 64);
  REQUIRE(write_smoothed(kShipped, sick, std::span(&plant, 1)).ok());
  const std::vector<Scaling> scalings = {of_block("lm.blk.0", 64), of_block("lm.blk.1", 64)};
  REQUIRE(write_smoothed(sick, all, scalings).ok());
  const Judged seen = observation();
  const CodedPair pair = {coded(sick, "plain.gguf"), coded(all, "smoothed.gguf")};
  const std::size_t little = resident_size() + (std::size_t{32} << 20);
  for (const std::size_t memory : {std::size_t{0}, little}) {
    CAPTURE(memory);
    const auto helpful = helpful_scalings(sick, pair, Rounding::int8, scalings, std::span(&seen, 1),
                                          {.n_thread = 1, .all_robots = true, .memory = memory});
    REQUIRE_MESSAGE(helpful.ok(), (helpful ? "" : helpful.error().message()));
    CHECK(paths(*helpful) == std::vector<std::string>{"lm.blk.1.ffn_norm"});
  }
}

}  // namespace product_errors_test
