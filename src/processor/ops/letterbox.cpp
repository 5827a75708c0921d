// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/letterbox.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "processor/byte_pixels.h"
#include "processor/json_fields.h"
#include "processor/recipe.h"
#include "processor/resample.h"

namespace vla {
namespace {

/// One output position along one axis: two source positions with weights.
struct Tap {
  int low, high;
  float low_weight, high_weight;
};

std::vector<Tap> make_taps(int n_in, int n_out) {
  const float scale = static_cast<float>(n_in) / static_cast<float>(n_out);
  std::vector<Tap> taps;
  taps.reserve(static_cast<std::size_t>(n_out));
  for (int i = 0; i < n_out; ++i) {
    // torch fuses this product and difference. Both are exact in double, so there is one rounding here too.
    const double exact = static_cast<double>(scale) * (static_cast<double>(i) + 0.5) - 0.5;
    const float source = std::max(static_cast<float>(exact), 0.0f);
    const int low = std::min(static_cast<int>(source), n_in - 1);
    const float high_weight = std::clamp(source - static_cast<float>(low), 0.0f, 1.0f);
    taps.push_back({low, std::min(low + 1, n_in - 1), 1.0f - high_weight, high_weight});
  }
  return taps;
}

struct ByteSource {
  const std::uint8_t* values;
  const float* table;  // byte / 255
  float operator()(std::size_t i) const { return table[values[i]]; }
};

struct FloatSource {
  const float* values;
  float operator()(std::size_t i) const { return values[i]; }
};

/// Where an image of `width` x `height` is written: planes of `plane` floats, with rows `stride` apart.
struct Target {
  float* out;
  std::size_t plane, stride;
  int width, height;
};

template <class Source>
inline __attribute__((always_inline)) void copy(Source source, const Target& to) {
  for (int y = 0; y < to.height; ++y)
    for (int x = 0; x < to.width; ++x)
      for (std::size_t c = 0; c < 3; ++c) {
        const auto row = static_cast<std::size_t>(y), column = static_cast<std::size_t>(x);
        to.out[c * to.plane + row * to.stride + column] =
            source((row * static_cast<std::size_t>(to.width) + column) * 3 + c);
      }
}

template <class Source>
inline __attribute__((always_inline)) void resample(Source source, int source_width, const std::vector<Tap>& rows,
                                                    const std::vector<Tap>& columns, const Target& to) {
  const auto row_size = static_cast<std::size_t>(source_width) * 3;
  for (std::size_t y = 0; y < rows.size(); ++y) {
    const Tap& row = rows[y];
    const std::size_t top = static_cast<std::size_t>(row.low) * row_size,
                      bottom = static_cast<std::size_t>(row.high) * row_size;
    float* out = to.out + y * to.stride;
    for (std::size_t x = 0; x < columns.size(); ++x) {
      const Tap& column = columns[x];
      const std::size_t left = static_cast<std::size_t>(column.low) * 3,
                        right = static_cast<std::size_t>(column.high) * 3;
      const float w00 = row.low_weight * column.low_weight, w01 = row.low_weight * column.high_weight;
      const float w10 = row.high_weight * column.low_weight, w11 = row.high_weight * column.high_weight;
      for (std::size_t c = 0; c < 3; ++c) {
        float sum = w01 * source(top + right + c);
        sum = std::fma(w00, source(top + left + c), sum);
        sum = std::fma(w10, source(bottom + left + c), sum);
        out[c * to.plane + x] = std::fma(w11, source(bottom + right + c), sum);
      }
    }
  }
}

// std::fma gives the same pixels on machines with and without the instruction; without it, it is a slow library
// function.
#if defined(__x86_64__)
template <class Source>
__attribute__((target("fma"))) void resample_fused(Source source, int source_width, const std::vector<Tap>& rows,
                                                   const std::vector<Tap>& columns, const Target& to) {
  resample(source, source_width, rows, columns, to);
}
#endif

template <class Source>
void place(Source source, int source_width, int source_height, const Target& to) {
  if (source_width == to.width && source_height == to.height) return copy(source, to);
  const std::vector<Tap> rows = make_taps(source_height, to.height), columns = make_taps(source_width, to.width);
#if defined(__x86_64__)
  if (__builtin_cpu_supports("fma")) return resample_fused(source, source_width, rows, columns, to);
#endif
  resample(source, source_width, rows, columns, to);
}

}  // namespace

namespace {

/// The frame as 8-bit pixels at the target size.
std::vector<std::uint8_t> resized_8bit(const Frame& frame, const Target& target) {
  const auto* given = std::get_if<std::vector<std::uint8_t>>(&frame.rgb);
  std::vector<std::uint8_t> bytes = given != nullptr ? *given : cut_to_bytes(std::get<std::vector<float>>(frame.rgb));
  if (frame.width == target.width && frame.height == target.height) return bytes;
  return resample_pillow_bilinear(bytes, frame.width, frame.height, target.width, target.height);
}

void place(const Frame& frame, const Target& target) {
  if (const auto* bytes = std::get_if<std::vector<std::uint8_t>>(&frame.rgb))
    return place(ByteSource{bytes->data(), byte_table().data()}, frame.width, frame.height, target);
  place(FloatSource{std::get<std::vector<float>>(frame.rgb).data()}, frame.width, frame.height, target);
}

}  // namespace

Status letterbox(const Frame& frame, const Letterbox& to, std::span<float> out, const std::string& where) {
  const auto stride = static_cast<std::size_t>(to.width);
  Target target{out.data(), stride * static_cast<std::size_t>(to.height), stride, to.width, to.height};
  if (frame.width != to.width || frame.height != to.height) {
    const double ratio =
        std::max(static_cast<double>(frame.width) / to.width, static_cast<double>(frame.height) / to.height);
    target.width = static_cast<int>(frame.width / ratio);
    target.height = static_cast<int>(frame.height / ratio);
    if (target.width < 1 || target.height < 1)
      return Error{Code::bad_observation, where,
                   fmt::format("an image that fits {} x {} with both sides", to.width, to.height),
                   fmt::format("{} x {}, which leaves a side shorter than a pixel", frame.width, frame.height)};
    for (std::size_t c = 0; c < 3; ++c)
      std::fill_n(out.begin() + static_cast<std::ptrdiff_t>(c * target.plane), target.plane, to.fill[c]);
  }
  const int share = to.align == Letterbox::Align::center ? 2 : 1;  // share of the padding at the left and top
  target.out += static_cast<std::size_t>((to.height - target.height) / share) * stride +
                static_cast<std::size_t>((to.width - target.width) / share);
  if (to.antialias) {
    const std::vector<std::uint8_t> bytes = resized_8bit(frame, target);
    copy(ByteSource{bytes.data(), byte_table().data()}, target);
  } else {
    place(frame, target);
  }
  return {};
}

void stretch(const Frame& frame, int width, int height, std::span<float> out) {
  const auto stride = static_cast<std::size_t>(width);
  place(frame, {out.data(), stride * static_cast<std::size_t>(height), stride, width, height});
}

namespace {

/// One number for all channels, or one per channel.
Result<std::array<float, 3>> read_fill(JsonFields& fields) {
  if (!fields.has_list("fill")) {
    VLA_TRY(const float all, fields.number("fill", {0, 1}));
    return std::array{all, all, all};
  }
  VLA_TRY(const std::vector<float> each, fields.numbers("fill", 3, {0, 1}));
  return std::array{each[0], each[1], each[2]};
}

Result<Letterbox> read_letterbox(JsonFields& fields) {
  Letterbox op;
  VLA_TRY(op.width, fields.integer("width", 1, kMaxImageSide));
  VLA_TRY(op.height, fields.integer("height", 1, kMaxImageSide));
  VLA_CHECK(fields.choice("filter", {"bilinear"}));
  VLA_TRY(op.antialias, fields.boolean("antialias"));
  VLA_TRY(const int align, fields.choice("align", {"bottom_right", "center"}));
  op.align = static_cast<Letterbox::Align>(align);
  VLA_TRY(op.fill, read_fill(fields));
  return op;
}

Status parse(JsonFields& fields, Recipe& recipe) {
  if (recipe.fit != nullptr) return misplaced(fields, "a letterbox as the first and only op on images of any size");
  VLA_TRY(const Letterbox op, read_letterbox(fields));
  recipe.fit = std::make_unique<OneFit<Letterbox>>("letterboxed", letterbox, op);
  recipe.width = op.width;
  recipe.height = op.height;
  return {};
}

}  // namespace

Ops letterbox_ops() { return {{"image", "letterbox", parse}}; }

}  // namespace vla
