// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/fast_tokens.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <numbers>

#include "processor/bpe.h"
#include "processor/recipe.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr std::uint32_t kReplacement = 0xFFFD;

/// The number of bytes of damaged UTF-8 that one replacement character replaces: the longest valid beginning of a
/// character.
std::size_t damaged_size(std::string_view text) {
  const auto is_in = [text](std::size_t i, unsigned low, unsigned high) {
    const unsigned byte = i < text.size() ? static_cast<unsigned char>(text[i]) : 0;
    return byte >= low && byte <= high;
  };
  const auto lead = static_cast<unsigned char>(text[0]);
  if (lead < 0xC2 || lead > 0xF4) return 1;
  const std::size_t whole = lead < 0xE0 ? 2 : lead < 0xF0 ? 3 : 4;
  if (!is_in(1, lead == 0xE0 ? 0xA0 : lead == 0xF0 ? 0x90 : 0x80, lead == 0xED ? 0x9F : lead == 0xF4 ? 0x8F : 0xBF))
    return 1;
  std::size_t size = 2;
  while (size < whole && is_in(size, 0x80, 0xBF)) ++size;
  return size;
}

/// The inverse of an orthonormal DCT-II of each column of (n, width).
std::vector<float> inverse_dct(const std::vector<double>& x, std::size_t n, std::size_t width) {
  std::vector<double> cosine(4 * n);
  for (std::size_t i = 0; i < 4 * n; ++i)
    cosine[i] = std::cos(std::numbers::pi * static_cast<double>(i) / static_cast<double>(2 * n));
  const double first = std::sqrt(1.0 / static_cast<double>(n)), other = std::sqrt(2.0 / static_cast<double>(n));
  std::vector<float> out(n * width);
  std::vector<double> sum(width);
  for (std::size_t row = 0; row < n; ++row) {
    std::fill(sum.begin(), sum.end(), 0.0);
    for (std::size_t k = 0; k < n; ++k) {
      const double factor = k == 0 ? first : other * cosine[(2 * row + 1) * k % (4 * n)];
      for (std::size_t column = 0; column < width; ++column) sum[column] += factor * x[k * width + column];
    }
    std::transform(sum.begin(), sum.end(), out.begin() + static_cast<std::ptrdiff_t>(row * width),
                   [](double value) { return static_cast<float>(value); });
  }
  return out;
}

}  // namespace

Result<FastTokens> FastTokens::read(const Keys& keys) {
  FastTokens tokens;
  VLA_TRY(const std::vector<std::string> texts, keys.strings("action_tokens.vocab"));
  if (texts.empty()) return misfit("action_tokens.vocab", "a text for each of FAST's tokens", "none");
  for (const std::string& text : texts) tokens.bytes_.push_back(bytes_of_token(text));
  VLA_TRY(tokens.min_token_, keys.number("action_tokens.min_token", {-1e6, 1e6}));
  if (tokens.min_token_ != std::round(tokens.min_token_))
    return misfit("action_tokens.min_token", "a whole number", fmt::format("{}", tokens.min_token_));
  VLA_TRY(tokens.scale_, keys.number("action_tokens.scale", {1e-6, 1e6}));
  VLA_TRY(tokens.n_vocab_, keys.integer("lm.n_vocab", {1, 1 << 24}));
  const Range is_id = {0, tokens.n_vocab_ - 1.0};
  VLA_TRY(tokens.first_id_, keys.integer("action_tokens.first_id", is_id));
  VLA_TRY(tokens.stop_token_, keys.integer("solver.stop_token", is_id));
  VLA_TRY(tokens.prefix_, keys.integers("action_tokens.prefix_ids", is_id));
  if (tokens.prefix_.empty()) return misfit("action_tokens.prefix_ids", "an id or several", "none");
  VLA_TRY(tokens.required_, keys.integers("action_tokens.required_ids", is_id));
  return tokens;
}

Result<std::vector<float>> FastTokens::decode(std::span<const std::int32_t> ids, int horizon, int d_action,
                                              std::string* note) const {
  VLA_CHECK(check(ids));
  const auto n = static_cast<std::size_t>(horizon), width = static_cast<std::size_t>(d_action);
  std::string why;
  std::vector<double> x = coefficients(action_ids(ids), why);
  if (why.empty() && x.size() != n * width)
    why = fmt::format("action tokens: {} coefficients instead of {}, {}", x.size(), n * width,
                      x.size() < n * width ? "the rest are zeros" : "the last ones are left out");
  x.resize(n * width);
  if (note != nullptr) *note = std::move(why);
  return inverse_dct(x, n, width);
}

Status FastTokens::check(std::span<const std::int32_t> ids) const {
  const auto is_unknown = [this](std::int32_t id) { return id < 0 || id >= n_vocab_; };
  if (const auto found = std::find_if(ids.begin(), ids.end(), is_unknown); found != ids.end())
    return Error{Code::bad_action, "action tokens", fmt::format("ids below {}", n_vocab_), std::to_string(*found)};
  const auto front = ids.first(std::min(ids.size(), required_.size()));
  if (std::equal(front.begin(), front.end(), required_.begin(), required_.end())) return {};
  return Error{Code::bad_action, "action tokens", fmt::format("ids {} first", fmt::join(required_, ", ")),
               fmt::format("{}", fmt::join(front, ", ")), "the policy did not answer with actions"};
}

/// The ids before the first stop token, without the occurrences of the prefix. The search continues after each
/// occurrence.
std::vector<std::int32_t> FastTokens::action_ids(std::span<const std::int32_t> ids) const {
  ids = ids.first(static_cast<std::size_t>(std::find(ids.begin(), ids.end(), stop_token_) - ids.begin()));
  std::vector<std::int32_t> kept;
  while (!ids.empty()) {
    const std::size_t n = prefix_.size();
    const bool is_prefix = ids.size() >= n && std::equal(prefix_.begin(), prefix_.end(), ids.begin());
    if (!is_prefix) kept.push_back(ids.front());
    ids = ids.subspan(is_prefix ? n : 1);
  }
  return kept;
}

/// Joins the tokens' bytes, decodes them to characters, and converts each character to a coefficient. As in the
/// reference, ids after FAST's last token are skipped, and an id before its first token makes the whole chunk zeros.
std::vector<double> FastTokens::coefficients(std::span<const std::int32_t> ids, std::string& note) const {
  std::string bytes;
  for (const std::int32_t id : ids) {
    if (id > first_id_) {
      note = fmt::format("action tokens: id {} is no action, so the chunk is zeros", id);
      return {};
    }
    const auto token = static_cast<std::size_t>(first_id_ - id);
    if (token < bytes_.size()) bytes += bytes_[token];
  }
  std::vector<double> x;
  for (std::string_view rest = bytes; !rest.empty();) {
    const unicode::Char c = unicode::first(rest);
    x.push_back((static_cast<double>(c.size > 0 ? c.code_point : kReplacement) + min_token_) / scale_);
    rest.remove_prefix(c.size > 0 ? c.size : damaged_size(rest));
  }
  return x;
}

}  // namespace vla
