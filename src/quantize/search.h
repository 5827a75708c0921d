// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "engine/engine.h"
#include "quantize/quantize.h"

namespace vla {

/// How far quantization moves the chunks of some observations from those in float32, before unnormalization.
struct Moved {
  double rms = 0;      // root mean square of the differences, of that of the chunks
  double largest = 0;  // largest difference, of the largest magnitude
};

/// An observation that a policy is judged by, and its noise.
struct Judged {
  Observation observation;
  Noise noise;
};

/// Chunks of observations, before unnormalization.
using Chunks = std::vector<std::vector<float>>;
/// Those of a bundle. Errors: those of Engine.
Result<Chunks> chunks_of(const std::string& bundle, const EngineOptions& options, std::span<const Judged> judged);
/// `lm.blk.0.attn_norm` of the tap `step.3.lm.blk.0.attn_norm`.
std::string without_step(const std::string& path);
Moved moved(const Chunks& expected, const Chunks& got);

/// One of the two.
struct Bound {
  std::optional<double> error;        // Moved::rms at most
  std::optional<std::int64_t> bytes;  // of the file at most
};

/// The matrices of one block of layers, or of a module that has none, which get the same codes.
struct Block {
  std::string path;
  std::int64_t stored = 0, int8 = 0, int4 = 0;  // bytes
  double moved_by_int4 = 0;                     // Moved::rms beyond that of int8, where only this block is int4
  double moved_by_int8 = 0;                     // less of it where only this block stays as it is; 0 where not asked
  Rounding codes = Rounding::int8;
};

struct Found {
  std::vector<Block> blocks;
  Moved all_int8, all_int4, moved;  // `moved`: with the codes of the blocks
  int n_trial = 0;                  // bundles that were loaded
};

/// Chooses int4, int8 or the stored floats for every block, so that the bound holds with the fewest bytes, or within
/// these bytes with the least error. Each block alone is int4 once, to see how far the actions move; errors of blocks
/// are taken to add in squares, and the choice is then computed as it is, until it holds. `trial`: a file that is
/// written over and over, and removed. `options`: of the engines; `int4`: as `quantize` takes them. Errors: those of
/// `quantize` and of Engine; unsupported where the bound cannot hold, with what can.
Result<Found> search(const std::string& from, const std::string& trial, std::span<const Judged> judged,
                     const Bound& bound, const EngineOptions& options, const Int4Codes& int4,
                     const std::function<void(int trial, const Moved&)>& report);

/// The choice of a search, by tensor.
Choice choice_of(const std::vector<Block>& blocks);

}  // namespace vla
