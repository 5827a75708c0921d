// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "engine/taps.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <string_view>

#include "base/file.h"
#include "bundle/gguf_reader.h"
#include "bundle/gguf_writer.h"

namespace vla {
namespace {

constexpr std::size_t kMaxFile = std::size_t{1} << 36;

bool match_one(std::string_view pattern, std::string_view path) {
  if (pattern.empty()) return path.empty();
  if (pattern.front() == '*')
    return match_one(pattern.substr(1), path) || (!path.empty() && match_one(pattern, path.substr(1)));
  return !path.empty() && pattern.front() == path.front() && match_one(pattern.substr(1), path.substr(1));
}

std::vector<std::int64_t> without_trailing_ones(std::vector<std::int64_t> shape) {
  while (shape.size() > 1 && shape.back() == 1) shape.pop_back();
  return shape;
}

TapDifference difference(const Tap& expected, const Tap& got) {
  TapDifference d;
  d.path = expected.path;
  d.comparable = without_trailing_ones(expected.shape) == without_trailing_ones(got.shape);
  if (!d.comparable) return d;
  double largest = 0, dot = 0, square_expected = 0, square_got = 0;
  for (std::size_t i = 0; i < expected.values.size(); ++i) {
    const double e = expected.values[i], g = got.values[i];
    if (!std::isfinite(e) || !std::isfinite(g)) d.comparable = false;
    d.max_abs = std::max(d.max_abs, std::abs(e - g));
    largest = std::max(largest, std::abs(e));
    dot += e * g, square_expected += e * e, square_got += g * g;
  }
  d.relative = d.max_abs == 0 ? 0 : d.max_abs / largest;
  if (square_expected > 0 && square_got > 0) d.cosine = dot / std::sqrt(square_expected * square_got);
  return d;
}

}  // namespace

bool match_path(const std::string& pattern, const std::string& path) {
  std::string_view rest = pattern;
  while (!rest.empty()) {
    const std::size_t comma = std::min(rest.find(','), rest.size());
    if (comma > 0 && match_one(rest.substr(0, comma), path)) return true;
    rest.remove_prefix(std::min(comma + 1, rest.size()));
  }
  return false;
}

Status write_taps(const std::vector<Tap>& taps, const std::string& file) {
  Keys keys;
  keys.set("general.architecture", Value(std::string("vla-taps")));
  std::vector<TensorInfo> tensors;
  std::map<std::string, int> times;  // a module that runs once per frame size records its path several times
  for (const Tap& tap : taps) {
    const int time = ++times[tap.path];
    tensors.push_back({time > 1 ? fmt::format("{}.{}", tap.path, time) : tap.path, DType::f32, tap.shape,
                       std::as_bytes(std::span(tap.values))});
  }
  return write_file(file, write_gguf(keys, tensors));
}

Result<std::vector<Tap>> read_taps(const std::string& file) {
  VLA_TRY(const std::vector<std::byte> bytes, read_file(file, kMaxFile));
  VLA_TRY(const GgufContent content, read_gguf(bytes, file));
  std::vector<Tap> taps;
  for (const TensorInfo& tensor : content.tensors) {
    if (tensor.type != DType::f32)
      return Error{Code::bad_bundle, file + ": tensor " + tensor.name, "f32", dtype_name(tensor.type)};
    Tap& tap =
        taps.emplace_back(Tap{tensor.name, tensor.shape, std::vector<float>(static_cast<std::size_t>(tensor.count()))});
    std::memcpy(tap.values.data(), tensor.data.data(), tensor.data.size());
  }
  return taps;
}

std::vector<TapDifference> compare_taps(const std::vector<Tap>& expected, const std::vector<Tap>& got) {
  std::vector<TapDifference> differences;
  for (const Tap& tap : expected) {
    const auto found = std::find_if(got.begin(), got.end(), [&](const Tap& other) { return other.path == tap.path; });
    if (found != got.end()) differences.push_back(difference(tap, *found));
  }
  return differences;
}

}  // namespace vla
