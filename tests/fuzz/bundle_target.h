// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>
#include <xxhash.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <span>
#include <string>
#include <string_view>

#include "engine/solver.h"
#include "policies/policy.h"
#include "processor/processor.h"

namespace vla::fuzz {

/// How far loading got before the bundle was refused: not at all, to a parsed file, or through every check that
/// Engine::load makes before it takes memory for weights.
enum class Depth { refused, parsed, declared };

/// A fuzzer is told by an abort, and whoever reads its log by the message.
[[noreturn]] inline void unexpected(const Error& error) {
  std::fprintf(stderr, "unexpected: %s: %s\n", code_name(error.code), error.message().c_str());
  std::abort();
}

/// An error must be one that a bundle can cause, and say where and what. Aborts when it is not.
inline void check_error(const Error& error) {
  const bool is_bundles_fault = error.code == Code::bad_bundle || error.code == Code::unsupported;
  if (!is_bundles_fault || error.where.empty() || error.found.empty()) unexpected(error);
}

template <class T>
bool accepted(const Result<T>& result) {
  if (!result) check_error(result.error());
  return result.ok();
}

/// Every tensor lies inside the file and is as long as its shape says. Aborts when one is not.
inline void check_tensors(const Bundle& bundle, std::span<const std::byte> bytes) {
  for (const TensorInfo& tensor : bundle.tensors()) {
    const bool is_inside =
        tensor.data.data() >= bytes.data() && tensor.data.data() + tensor.data.size() <= bytes.data() + bytes.size();
    const std::size_t size = dtype_size(tensor.type, tensor.count());
    if (!is_inside || tensor.data.size() != size) std::abort();
  }
}

/// The checks of Engine::load, in its order but none skipped after a refusal, so that each layer meets every bundle.
inline Depth check_load(const Bundle& bundle) {
  const auto processor = Processor::create(bundle);
  const bool is_processed = accepted(processor);
  const auto arch = bundle.keys().string("vla.arch");
  if (!accepted(arch)) return Depth::parsed;
  const auto entry = find_policy(*arch);
  if (!accepted(entry)) return Depth::parsed;
  ParamList params(bundle.keys(), &bundle);
  const std::unique_ptr<Policy> policy = entry->make(params);
  const auto reads = [&](const std::string& tensor) { return is_processed && processor->reads(tensor); };
  const bool is_declared = accepted(params.report(*arch, reads));
  const bool is_solved = accepted(Solver::read(bundle.keys()));
  if (!is_processed || !is_declared || !is_solved) return Depth::parsed;
  const Recipe& recipe = processor->recipe();
  const InputShape shape = {.width = recipe.width,
                            .height = recipe.height,
                            .n_view = static_cast<int>(processor->views().names().size()),
                            .n_text = recipe.max_tokens,
                            .d_state = 1};
  return accepted(policy->check(shape)) ? Depth::declared : Depth::parsed;
}

/// Of a bundle for several robots how far the first of them that is refused got.
inline Depth check_bytes(std::span<const std::byte> bytes) {
  const auto bundle = Bundle::parse(bytes, "fuzz.gguf");
  if (!accepted(bundle)) return Depth::refused;
  check_tensors(*bundle, bytes);
  if (bundle->embodiments().empty()) return check_load(*bundle);
  Depth depth = Depth::declared;
  for (const std::string& tag : bundle->embodiments()) {
    Bundle robot = *bundle;
    if (const Status chosen = robot.choose(tag); !chosen) unexpected(chosen.error());
    check_tensors(robot, bytes);
    depth = std::min(depth, check_load(robot));
  }
  return depth;
}

/// The bytes with the checksum that fits them, so that what lies behind that check is reached. Without a place for a
/// checksum they stay as they are.
inline std::string sealed(std::string bytes) {
  constexpr std::size_t kDigits = 16;
  const std::size_t key = bytes.find("vla.checksum");
  const std::size_t prefix = key == std::string::npos ? key : bytes.find("xxh3:", key);
  if (prefix == std::string::npos || bytes.size() - prefix < 5 + kDigits) return bytes;
  bytes.replace(prefix + 5, kDigits, kDigits, '0');
  bytes.replace(prefix + 5, kDigits, fmt::format("{:016x}", XXH3_64bits(bytes.data(), bytes.size())));
  return bytes;
}

/// Loads the bytes as they are, and once more with a checksum that fits. Returns how far the better of the two got.
inline Depth check_bundle(std::span<const std::byte> bytes) {
  const Depth as_is = check_bytes(bytes);
  const std::string fitted = sealed({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  return std::max(as_is, check_bytes(std::as_bytes(std::span(fitted))));
}

}  // namespace vla::fuzz
