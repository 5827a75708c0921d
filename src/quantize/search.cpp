// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/search.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

namespace vla {
namespace {

/// The block of a tensor: `vision.blk.3` for `vision.blk.3.attn_q.weight`; the first level of a path without a number.
std::string block_of(const std::string& tensor) {
  for (std::size_t end = tensor.find('.'); end != std::string::npos; end = tensor.find('.', end + 1)) {
    const std::size_t digits = tensor.find_first_not_of("0123456789", end + 1);
    if (digits > end + 1 && digits != std::string::npos && tensor[digits] == '.') return tensor.substr(0, digits);
  }
  return tensor.substr(0, tensor.find('.'));
}

std::vector<Block> blocks_of(const std::vector<Quantizable>& matrices) {
  std::vector<Block> blocks;
  for (const Quantizable& matrix : matrices) {
    const std::string path = block_of(matrix.tensor);
    auto block = std::ranges::find(blocks, path, &Block::path);
    if (block == blocks.end()) block = blocks.insert(block, Block{.path = path});
    block->stored += matrix.stored, block->int8 += matrix.int8, block->int4 += matrix.int4;
  }
  return blocks;
}

std::int64_t bytes_of(const Block& block) {
  return block.codes == Rounding::int4 ? block.int4 : block.codes == Rounding::int8 ? block.int8 : block.stored;
}

/// Subtracts two errors as squares, because the errors of blocks add in squares.
double beyond(double larger, double smaller) { return std::sqrt(std::max(0.0, larger * larger - smaller * smaller)); }

class Search {
 public:
  using Report = std::function<void(int, const Moved&)>;
  Search(std::string from, std::string trial, std::span<const Judged> judged, const EngineOptions& options,
         const CodeSource& source, const Report& report)
      : from_(std::move(from)),
        trial_(std::move(trial)),
        judged_(judged),
        options_(options),
        source_(source),
        report_(report) {}

  Status open() {
    VLA_TRY(const std::vector<Quantizable> matrices, quantizable(from_));
    std::error_code error;
    n_byte_ = static_cast<std::int64_t>(std::filesystem::file_size(from_, error));
    found_.blocks = blocks_of(matrices);
    return {};
  }

  Status to_error(double most) {
    VLA_CHECK(measure_int4());
    if (found_.all_int8.rms > most) VLA_CHECK(measure_int8());
    set_all(Rounding::int4);
    found_.moved = found_.all_int4;
    while (found_.moved.rms > most) {
      // If a choice misses the bound by more than expected, the next one must aim lower.
      VLA_TRY(const bool given, give_back_until(most * std::min(1.0, expected() / found_.moved.rms)));
      if (!given)
        return Error{Code::unsupported, "--error", fmt::format("{:.3g} or more", found_.moved.rms),
                     fmt::format("{:.3g}", most), "that is with every matrix as it is stored"};
      VLA_TRY(found_.moved, compute(found_.blocks));
    }
    return {};
  }

  Status to_size(std::int64_t most) {
    set_all(Rounding::int8);
    const bool may_keep = size() < most;
    set_all(Rounding::int4);
    if (size() > most)
      return Error{Code::unsupported, "--size", fmt::format("{} bytes or more", size()), std::to_string(most),
                   "that is with all large matrices in int4"};
    VLA_CHECK(measure_int4());
    if (may_keep) VLA_CHECK(measure_int8());
    for (;;) {
      VLA_TRY(Block* const block, next([&](const Block& b) { return size() + added(b) <= most; }));
      if (block == nullptr) break;
      give_back(*block);
    }
    VLA_TRY(found_.moved, compute(found_.blocks));
    return {};
  }

  Found take() { return std::move(found_); }

 private:
  void set_all(Rounding codes) { found_.blocks = all(codes); }
  std::vector<Block> all(Rounding codes) const {
    std::vector<Block> blocks = found_.blocks;
    for (Block& block : blocks) block.codes = codes;
    return blocks;
  }
  /// Computes the error with all blocks in int8 but one.
  Result<Moved> with_one(std::size_t one, Rounding codes) {
    std::vector<Block> blocks = all(Rounding::int8);
    blocks[one].codes = codes;
    return compute(blocks);
  }
  Result<Moved> compute(const std::vector<Block>& blocks) {
    const bool is_stored = std::ranges::all_of(blocks, [](const Block& b) { return b.codes == Rounding::none; });
    if (!is_stored)
      if (const auto made = quantize(
              from_, trial_, choice_of(blocks), {}, [](QuantizeProgress) {}, source_);
          !made)
        return made.error();
    VLA_TRY(const auto got, chunks_of(is_stored ? from_ : trial_, options_, judged_));
    const Moved result = moved(expected_, got);
    report_(++found_.n_trial, result);
    return result;
  }

  /// Bytes of the file with these codes per block.
  std::int64_t size() const {
    std::int64_t size = n_byte_;
    for (const Block& block : found_.blocks) size += bytes_of(block) - block.stored;
    return size;
  }
  double expected() const {
    double square = found_.all_int8.rms * found_.all_int8.rms;
    for (const Block& block : found_.blocks)
      square += block.codes == Rounding::int4   ? block.moved_by_int4 * block.moved_by_int4
                : block.codes == Rounding::none ? -block.moved_by_int8 * block.moved_by_int8
                                                : 0;
    return std::sqrt(std::max(0.0, square));
  }

  static std::int64_t added(const Block& block) {
    return block.codes == Rounding::int4 ? block.int8 - block.int4 : block.stored - block.int8;
  }
  static void give_back(Block& block) { block.codes = block.codes == Rounding::int4 ? Rounding::int8 : Rounding::none; }

  /// The block for which the next larger codes reduce the error most per byte, among those that fit; null if none is
  /// left.
  Result<Block*> next(const std::function<bool(const Block&)>& fits) {
    std::vector<Block*> candidates;
    for (Block& block : found_.blocks)
      if ((block.codes == Rounding::int4 || (knows_int8_ && block.codes == Rounding::int8)) && fits(block))
        candidates.push_back(&block);
    if (!candidates.empty())
      return *std::ranges::max_element(candidates, {}, [](auto* block) { return worth(*block); });
    if (knows_int8_ || std::ranges::none_of(found_.blocks, fits)) return static_cast<Block*>(nullptr);
    VLA_CHECK(measure_int8());
    return next(fits);
  }
  /// Enlarges the codes of the best blocks until the expected error is at most `most`. Returns whether any changed.
  Result<bool> give_back_until(double most) {
    for (bool given = false;; given = true) {
      VLA_TRY(Block* const block, next([](const Block&) { return true; }));
      if (block == nullptr) return given;
      give_back(*block);
      if (expected() <= most) return true;
    }
  }
  static double worth(const Block& block) {
    const double moved = block.codes == Rounding::int4 ? block.moved_by_int4 : block.moved_by_int8;
    return moved * moved / static_cast<double>(std::max<std::int64_t>(added(block), 1));
  }

  Status measure_int4() {
    EngineOptions float32 = options_;
    float32.kernels = "float32";
    VLA_TRY(expected_, chunks_of(from_, float32, judged_));
    VLA_TRY(found_.all_int8, compute(all(Rounding::int8)));
    VLA_TRY(found_.all_int4, compute(all(Rounding::int4)));
    for (std::size_t i = 0; i < found_.blocks.size(); ++i) {
      VLA_TRY(const Moved moved, with_one(i, Rounding::int4));
      found_.blocks[i].moved_by_int4 = beyond(moved.rms, found_.all_int8.rms);
    }
    return {};
  }

  Status measure_int8() {
    knows_int8_ = true;
    for (std::size_t i = 0; i < found_.blocks.size(); ++i) {
      VLA_TRY(const Moved moved, with_one(i, Rounding::none));
      found_.blocks[i].moved_by_int8 = beyond(found_.all_int8.rms, moved.rms);
    }
    return {};
  }

  const std::string from_, trial_;
  const std::span<const Judged> judged_;
  const EngineOptions& options_;
  const CodeSource& source_;
  const Report& report_;
  std::int64_t n_byte_ = 0;  // bytes of the unquantized file
  bool knows_int8_ = false;
  Chunks expected_;
  Found found_;
};

}  // namespace

Result<Chunks> chunks_of(const std::string& bundle, const EngineOptions& options, std::span<const Judged> judged) {
  VLA_TRY(const std::unique_ptr<Engine> engine, Engine::load(bundle, options));
  Chunks chunks;
  for (const Judged& one : judged) {
    VLA_TRY(ActionChunk chunk, engine->act(one.observation, one.noise));
    chunks.push_back(std::move(chunk.normalized));
  }
  return chunks;
}

std::string without_step(const std::string& path) {
  return path.starts_with("step.") ? path.substr(path.find('.', path.find('.') + 1) + 1) : path;
}

Moved moved(const Chunks& expected, const Chunks& got) {
  double value = 0, missed = 0, largest_value = 0, largest = 0;
  std::vector<double> of_each;
  for (std::size_t k = 0; k < expected.size(); ++k) {
    double of_one = 0;
    for (std::size_t i = 0; i < expected[k].size(); ++i) {
      const double x = expected[k][i], d = got[k][i] - x;
      value += x * x, of_one += d * d;
      largest_value = std::max(largest_value, std::abs(x)), largest = std::max(largest, std::abs(d));
    }
    missed += of_one;
    of_each.push_back(of_one * static_cast<double>(expected.size()));
  }
  if (value == 0) return {};
  const auto middle = of_each.begin() + static_cast<std::ptrdiff_t>(of_each.size() / 2);
  std::ranges::nth_element(of_each, middle);
  return {std::sqrt(missed / value), largest / largest_value, std::sqrt(*middle / value)};
}

Choice choice_of(const std::vector<Block>& blocks) {
  std::map<std::string, Rounding> codes;
  for (const Block& block : blocks) codes.emplace(block.path, block.codes);
  return [codes = std::move(codes)](const std::string& tensor) {
    const auto found = codes.find(block_of(tensor));
    return found == codes.end() ? Rounding::none : found->second;
  };
}

Result<Found> search(const std::string& from, const std::string& trial, std::span<const Judged> judged,
                     const Bound& bound, const EngineOptions& options, const CodeSource& source,
                     const std::function<void(int, const Moved&)>& report) {
  Search search(from, trial, judged, options, source, report);
  VLA_CHECK(search.open());
  const Status done = bound.error ? search.to_error(*bound.error) : search.to_size(*bound.bytes);
  std::error_code ignored;
  std::filesystem::remove(trial, ignored);
  VLA_CHECK(done);
  return search.take();
}

}  // namespace vla
