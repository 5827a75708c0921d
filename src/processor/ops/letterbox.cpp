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

/// The taps of the output positions in `of`.
std::vector<Tap> make_taps(int n_in, int n_out, Rows of) {
  const float scale = static_cast<float>(n_in) / static_cast<float>(n_out);
  std::vector<Tap> taps;
  taps.reserve(static_cast<std::size_t>(of.end - of.first));
  for (int i = of.first; i < of.end; ++i) {
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

/// The memory to which an image of `width` x `height` is written: planes of `plane` floats, with rows `stride` floats
/// apart.
struct Target {
  float* out;
  std::size_t plane, stride;
  int width, height;
};

template <class Source>
void copy(Source source, const Target& to, Rows rows) {
  for (int y = rows.first; y < rows.end; ++y)
    for (int x = 0; x < to.width; ++x)
      for (std::size_t c = 0; c < 3; ++c) {
        const auto row = static_cast<std::size_t>(y), column = static_cast<std::size_t>(x);
        to.out[c * to.plane + row * to.stride + column] =
            source((row * static_cast<std::size_t>(to.width) + column) * 3 + c);
      }
}

/// The pixels of a source row that the output's columns read: (3, width) at each column's left and at its right
/// position.
struct SourceRow {
  int row = -1;
  std::vector<float> left, right;
};

template <class Source>
void read(Source source, std::size_t row_size, int row, std::span<const Tap> columns, SourceRow& to) {
  if (to.row == row) return;
  to.row = row;
  const std::size_t first = static_cast<std::size_t>(row) * row_size, width = columns.size();
  to.left.resize(3 * width), to.right.resize(3 * width);
  for (std::size_t x = 0; x < width; ++x)
    for (std::size_t c = 0; c < 3; ++c) {
      to.left[c * width + x] = source(first + 3 * static_cast<std::size_t>(columns[x].low) + c);
      to.right[c * width + x] = source(first + 3 * static_cast<std::size_t>(columns[x].high) + c);
    }
}

/// The weights of all columns.
struct ColumnWeights {
  std::vector<float> low, high;
};

/// Computes a row of the output, for one channel. The loop's iterations are independent, so the compiler vectorizes it.
inline __attribute__((always_inline)) void sum_row(const Tap& row, const ColumnWeights& columns, const float* top_left,
                                                   const float* top_right, const float* bottom_left,
                                                   const float* bottom_right, float* __restrict out) {
  const float *low = columns.low.data(), *high = columns.high.data();
  for (std::size_t x = 0; x < columns.low.size(); ++x) {
    const float w00 = row.low_weight * low[x], w01 = row.low_weight * high[x];
    const float w10 = row.high_weight * low[x], w11 = row.high_weight * high[x];
    float sum = w01 * top_right[x];
    sum = std::fma(w00, top_left[x], sum);
    sum = std::fma(w10, bottom_left[x], sum);
    out[x] = std::fma(w11, bottom_right[x], sum);
  }
}

inline __attribute__((always_inline)) void sum_rows(const Tap& row, const ColumnWeights& columns, const SourceRow& top,
                                                    const SourceRow& bottom, float* out, std::size_t plane) {
  const std::size_t width = columns.low.size();
  for (std::size_t c = 0; c < 3; ++c)
    sum_row(row, columns, &top.left[c * width], &top.right[c * width], &bottom.left[c * width],
            &bottom.right[c * width], out + c * plane);
}

// std::fma gives the same pixels on machines with and without the instruction; without it, it is a slow library
// function.
#if defined(__x86_64__)
__attribute__((target("fma"))) void sum_rows_fused(const Tap& row, const ColumnWeights& columns, const SourceRow& top,
                                                   const SourceRow& bottom, float* out, std::size_t plane) {
  sum_rows(row, columns, top, bottom, out, plane);
}
#endif

/// Keeps two neighbouring rows of the source, because the next output rows read them again if the image grows.
template <class Source>
void resample(Source source, int source_width, int source_height, const Target& to, Rows rows) {
  const std::vector<Tap> row_taps = make_taps(source_height, to.height, rows);
  const std::vector<Tap> column_taps = make_taps(source_width, to.width, {0, to.width});
  ColumnWeights columns;
  for (const Tap& tap : column_taps) columns.low.push_back(tap.low_weight), columns.high.push_back(tap.high_weight);
  SourceRow kept[2];
  float* out = to.out + static_cast<std::size_t>(rows.first) * to.stride;
  for (const Tap& row : row_taps) {
    SourceRow &top = kept[row.low % 2], &bottom = kept[row.high % 2];
    read(source, static_cast<std::size_t>(source_width) * 3, row.low, column_taps, top);
    read(source, static_cast<std::size_t>(source_width) * 3, row.high, column_taps, bottom);
#if defined(__x86_64__)
    if (__builtin_cpu_supports("fma"))
      sum_rows_fused(row, columns, top, bottom, out, to.plane);
    else
#endif
      sum_rows(row, columns, top, bottom, out, to.plane);
    out += to.stride;
  }
}

template <class Source>
void place(Source source, int source_width, int source_height, const Target& to, Rows rows) {
  if (source_width == to.width && source_height == to.height) return copy(source, to, rows);
  resample(source, source_width, source_height, to, rows);
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

void place(const Frame& frame, const Target& target, Rows rows) {
  if (const auto* bytes = std::get_if<std::vector<std::uint8_t>>(&frame.rgb))
    return place(ByteSource{bytes->data(), byte_table().data()}, frame.width, frame.height, target, rows);
  place(FloatSource{std::get<std::vector<float>>(frame.rgb).data()}, frame.width, frame.height, target, rows);
}

/// Fills the part of the rows that the image does not cover.
void fill(const Letterbox& to, const Target& target, std::span<float> out, int left, Rows rows, Rows image) {
  const auto n_left = static_cast<std::size_t>(left), stride = target.stride;
  const std::size_t end = n_left + static_cast<std::size_t>(target.width);
  for (std::size_t c = 0; c < 3; ++c)
    for (int y = rows.first; y < rows.end; ++y) {
      const std::span<float> row = out.subspan(c * target.plane + static_cast<std::size_t>(y) * stride, stride);
      const bool crosses = y >= image.first && y < image.end;
      std::ranges::fill(row.first(crosses ? n_left : stride), to.fill[c]);
      if (crosses) std::ranges::fill(row.subspan(end), to.fill[c]);
    }
}

}  // namespace

Status letterbox(const Frame& frame, const Letterbox& to, std::span<float> out, const std::string& where) {
  return letterbox_rows(frame, to, {0, to.height}, out, where);
}

Status letterbox_rows(const Frame& frame, const Letterbox& to, Rows rows, std::span<float> out,
                      const std::string& where) {
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
  }
  const int share = to.align == Letterbox::Align::center ? 2 : 1;  // 1 / share of the padding is at the left and top
  const int top = (to.height - target.height) / share, left = (to.width - target.width) / share;
  fill(to, target, out, left, rows, {top, top + target.height});
  target.out += static_cast<std::size_t>(top) * stride + static_cast<std::size_t>(left);
  // From here on, rows of the image.
  rows = {std::clamp(rows.first - top, 0, target.height), std::clamp(rows.end - top, 0, target.height)};
  if (to.antialias) {
    const std::vector<std::uint8_t> bytes = resized_8bit(frame, target);
    copy(ByteSource{bytes.data(), byte_table().data()}, target, rows);
  } else {
    place(frame, target, rows);
  }
  return {};
}

void stretch(const Frame& frame, int width, int height, std::span<float> out) {
  const auto stride = static_cast<std::size_t>(width);
  place(frame, {out.data(), stride * static_cast<std::size_t>(height), stride, width, height}, {0, height});
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

struct LetterboxFit final : OneFit<Letterbox> {
  explicit LetterboxFit(const Letterbox& given) : OneFit("letterboxed", letterbox, given) {}
  /// With antialiasing, the whole image is resized before it is spread over planes.
  bool makes_rows() const override { return !op.antialias; }
  Status apply_rows(const Frame& frame, Rows rows, std::span<float> planes, const std::string& where) const override {
    return letterbox_rows(frame, op, rows, planes, where);
  }
};

Status parse_letterbox(JsonFields& fields, Recipe& recipe) {
  if (recipe.fit != nullptr) return misplaced(fields, "a letterbox as the first and only op on images of any size");
  VLA_TRY(const Letterbox op, read_letterbox(fields));
  recipe.fit = std::make_unique<LetterboxFit>(op);
  recipe.width = op.width;
  recipe.height = op.height;
  return {};
}

}  // namespace

Ops letterbox_ops() { return {{"image", "letterbox", parse_letterbox}}; }

}  // namespace vla
