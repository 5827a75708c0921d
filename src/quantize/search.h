// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "engine/engine.h"
#include "quantize/quantize.h"

namespace vla {

/// How far quantization moves the chunks of some observations from float32, before unnormalization.
struct Moved {
  double rms = 0;      // root mean square of the differences, over that of the chunks
  double largest = 0;  // largest difference, over the largest magnitude
  double median = 0;   // root mean square of the median observation's differences, over that of all chunks
};

/// An observation to judge a policy by, and its noise.
struct Judged {
  Observation observation;
  Noise noise;
};

/// Chunks of observations, before unnormalization.
using Chunks = std::vector<std::vector<float>>;
/// Computes the chunks of a bundle. Errors: those of Engine.
Result<Chunks> chunks_of(const std::string& bundle, const EngineOptions& options, std::span<const Judged> judged);
/// The path without its step: `lm.blk.0.attn_norm` for the tap `step.3.lm.blk.0.attn_norm`.
std::string without_step(const std::string& path);
Moved moved(const Chunks& expected, const Chunks& got);

/// The bound of a search: one of the two is set.
struct Bound {
  std::optional<double> error;        // largest allowed Moved::rms
  std::optional<std::int64_t> bytes;  // largest allowed size of the file
};

/// The matrices of one block, or of a module without blocks. They get the same codes.
struct Block {
  std::string path;
  std::int64_t stored = 0, int8 = 0, int4 = 0;  // bytes
  double moved_by_int4 = 0;                     // Moved::rms above that of int8 if only this block is int4
  double moved_by_int8 = 0;  // reduction of Moved::rms if only this block stays unquantized; 0 if not measured
  Rounding codes = Rounding::int8;
};

struct Found {
  std::vector<Block> blocks;
  Moved all_int8, all_int4, moved;  // `moved`: with the chosen codes
  int n_trial = 0;                  // bundles loaded during the search
};

/// Chooses int4, int8 or the stored floats for every block: the fewest bytes within the error bound, or the least error
/// within the bytes. It measures each block as int4 alone, assumes that the errors of blocks add in squares, then
/// measures the whole choice and adjusts it until the bound holds. `trial`: a temporary file, which is removed.
/// `options` configure the engines; `source` is as in `quantize`. Errors: those of `quantize` and of Engine;
/// unsupported if the bound cannot hold, with the closest bound that holds.
Result<Found> search(const std::string& from, const std::string& trial, std::span<const Judged> judged,
                     const Bound& bound, const EngineOptions& options, const CodeSource& source,
                     const std::function<void(int trial, const Moved&)>& report);

/// The choice that a search found, by tensor.
Choice choice_of(const std::vector<Block>& blocks);

}  // namespace vla
