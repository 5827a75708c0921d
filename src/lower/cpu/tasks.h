// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstring>
#include <span>
#include <vector>

#include "kernels/attention_kernel.h"
#include "kernels/channel_attention.h"
#include "kernels/executor.h"
#include "kernels/linear_kernel.h"
#include "kernels/numbers.h"
#include "kernels/row_kernel.h"
#include "kernels/sizes.h"
#include "kernels/window.h"
#include "lower/cpu/table_rows.h"

/// The tasks of a program on the CPU: for each kind of operation what an item of it is and how it runs. Everything is
/// an address or a size by then; emit() fills them in.
namespace vla::lower {

using kernels::Task;
using kernels::Worker;

struct LinearTask : Task {
  const kernels::LinearKernel* kernel;
  kernels::LinearJob job = {};
  void run(std::int64_t item, Worker& worker) const override { kernel->run(job, item, worker); }
};

/// An item is a block of rows that goes through two products of tiles. What lies between them begins at `inner` of a
/// thread's scratch memory, behind that of the kernels.
struct BlockedTask : Task {
  const kernels::LinearKernel* kernel[2];
  kernels::LinearJob job[2];
  std::size_t inner;

  void run(std::int64_t item, Worker& worker) const override {
    const std::int64_t n_square = kernels::ceil_div(job[0].n_row, kernels::kTileSide);
    const std::int64_t first = n_square * item / n_item * kernels::kTileSide;
    const std::int64_t n = kernels::min(n_square * (item + 1) / n_item * kernels::kTileSide, job[0].n_row) - first;
    kernels::LinearJob up = rows_of(job[0], first, n), down = rows_of(job[1], first, n);
    // Each product starts anew: jobs of other blocks lay at the same addresses.
    up.part[up.n_part - 1].y = worker.scratch_from(inner);
    run_all(*kernel[0], up, worker);
    down.x = worker.scratch_from(inner);
    run_all(*kernel[1], down, worker);
  }

 private:
  /// The job for n rows from `first` on, a multiple of kTileSide, since bf16 lies in tiles.
  static kernels::LinearJob rows_of(kernels::LinearJob job, std::int64_t first, std::int64_t n) {
    const auto offset = [&](DType type, std::int64_t d, std::int64_t stride) {
      return type == DType::bf16 ? 2 * kernels::place_in_tiles(first, 0, d)
                                 : static_cast<std::int64_t>(dtype_size(type, first * stride));
    };
    job.n_row = n;
    job.x += offset(job.x_type, job.d_in, job.x_stride);
    for (kernels::LinearJob::Part& part : std::span(job.part, static_cast<std::size_t>(job.n_part))) {
      part.y += offset(part.y_type, part.d_out, part.d_out);
      if (part.residual != nullptr) part.residual += first * part.d_out;
    }
    return job;
  }

  static void run_all(const kernels::LinearKernel& kernel, kernels::LinearJob& job, Worker& worker) {
    const std::int64_t n = kernel.cut(job, 1);
    for (std::int64_t i = 0; i < n; ++i) kernel.run(job, i, worker);
  }
};

/// An item is some rows of x, or of its norm.
struct QuantizeTask : Task {
  kernels::LinearJob::Norm norm;
  void (*quantize)(const float* x, std::int64_t n, std::byte* row);
  const float* x;
  std::byte* codes;
  std::int64_t d, n_row, x_stride, codes_stride, item_rows;

  void run(std::int64_t item, Worker& worker) const override {
    for (std::int64_t i = item * item_rows; i < std::min(n_row, (item + 1) * item_rows); ++i) {
      const float* row = norm(x + i * x_stride, d, worker.scratch<float>());
      quantize(row, d, codes + i * codes_stride);
    }
  }
};

struct PackTask : Task {
  const kernels::AttentionKernel* kernel;
  kernels::PackJob job;
  void run(std::int64_t item, Worker&) const override { kernel->pack(job, item); }
};

struct AttentionTask : Task {
  const kernels::AttentionKernel* kernel;
  kernels::AttentionJob job = {};
  void run(std::int64_t item, Worker&) const override { kernel->run(job, item); }
};

/// Rows of up to two operands through a row kernel; the result is contiguous.
struct RowTask : Task {
  kernels::RowKernel kernel;
  const float *x, *w = nullptr, *b = nullptr;
  float s = 0;
  float* y;
  Shape shape, x_stride, w_stride = {};
  bool w_is_scalar = false;  // of each row
  std::int64_t item_rows;

  void run(std::int64_t item, Worker&) const override {
    const std::int64_t n_row = shape[1] * shape[2] * shape[3], end = std::min(n_row, (item + 1) * item_rows);
    for (std::int64_t row = item * item_rows; row < end; ++row) {
      const std::int64_t i = row % shape[1], j = row / shape[1] % shape[2], k = row / shape[1] / shape[2];
      const float* w_row = w != nullptr ? w + i * w_stride[1] + j * w_stride[2] + k * w_stride[3] : nullptr;
      kernel(x + i * x_stride[1] + j * x_stride[2] + k * x_stride[3], w_row, b, w_is_scalar ? *w_row : s,
             y + row * shape[0], shape[0]);
    }
  }
};

/// Words of four bytes from one place to another; an item is some rows of a part.
struct CopyTask : Task {
  struct Part {
    const std::uint32_t* from;
    std::uint32_t* to;
    Shape shape, from_stride, to_stride;
    std::int64_t item_rows, first_item;
  };
  std::vector<Part> parts;

  void run(std::int64_t item, Worker&) const override {
    std::size_t i = parts.size() - 1;
    while (parts[i].first_item > item) --i;
    const Part& part = parts[i];
    const Shape& n = part.shape;
    const std::int64_t begin = (item - part.first_item) * part.item_rows;
    const std::int64_t end = std::min(n[1] * n[2] * n[3], begin + part.item_rows);
    const auto place = [&](const Shape& stride, std::int64_t row) {
      return row % n[1] * stride[1] + row / n[1] % n[2] * stride[2] + row / n[1] / n[2] * stride[3];
    };
    for (std::int64_t row = begin; row < end; ++row) {
      const std::uint32_t* from = part.from + place(part.from_stride, row);
      std::uint32_t* to = part.to + place(part.to_stride, row);
      if (part.from_stride[0] == 1)
        std::memcpy(to, from, static_cast<std::size_t>(n[0]) * 4);
      else
        for (std::int64_t j = 0; j < n[0]; ++j) to[j] = from[j * part.from_stride[0]];
    }
  }
};

/// Rows of a parameter, widened to float32 where they will lie: a row of two bytes an element fills the second half of
/// its place first.
struct EmbeddingTask : Task {
  TableRows* table;
  DType type;
  const std::int32_t* ids;
  float* y;
  std::int64_t d, n;

  void run(std::int64_t, Worker&) const override {
    for (std::int64_t i = 0; i < n; ++i) {
      float* const to = y + i * d;
      std::byte* const stored = reinterpret_cast<std::byte*>(to + d) - table->row_size();
      table->copy(ids[i], stored);
      for (std::int64_t j = 0; type != DType::f32 && j < d; ++j) to[j] = kernels::stored_number(type, stored, j);
    }
  }
};

/// Rows of a value.
struct GatherTask : Task {
  const float* rows;
  const std::int32_t* ids;
  float* y;
  std::int64_t d, n, item_rows, row_stride;

  void run(std::int64_t item, Worker&) const override {
    for (std::int64_t i = item * item_rows; i < std::min(n, (item + 1) * item_rows); ++i)
      std::memcpy(y + i * d, rows + ids[i] * row_stride, static_cast<std::size_t>(d) * sizeof(float));
  }
};

/// An item is a row of patches of a view.
struct PatchesTask : Task {
  const float* images;
  float* y;
  std::int64_t width, height, size;

  void run(std::int64_t item, Worker&) const override {
    const std::int64_t n_column = width / size, n_row = height / size, view = item / n_row, row = item % n_row;
    float* to = y + item * n_column * 3 * size * size;
    for (std::int64_t column = 0; column < n_column; ++column)
      for (std::int64_t channel = 0; channel < 3; ++channel)
        for (std::int64_t line = 0; line < size; ++line, to += size)
          std::memcpy(to, images + ((view * 3 + channel) * height + row * size + line) * width + column * size,
                      static_cast<std::size_t>(size) * sizeof(float));
  }
};

/// Copies the elements that a window covers, or their largest, or their weighted sum; an item is a row of places.
struct WindowTask : Task {
  kernels::Window window;
  kernels::RowKernel largest, multiply_add;  // both null: all of it
  const float *x, *weight, *bias;
  float* y;

  void run(std::int64_t item, Worker&) const override {
    const std::int64_t n_row = window.n_row, view = item / n_row, row = item % n_row;
    const std::int64_t d = largest != nullptr || multiply_add != nullptr ? window.d : window.width_of_place();
    for (std::int64_t column = 0; column < window.n_column; ++column) {
      const std::int64_t place = (view * n_row + row) * window.n_column + column;
      if (largest != nullptr)
        window.largest(largest, x, place, y + place * d);
      else if (multiply_add != nullptr)
        window.weigh(multiply_add, x, weight, bias, place, y + place * d);
      else
        window.copy(x, place, 0, d, y + place * d);
    }
  }
};

/// An item is a group of a view.
struct ChannelTask : Task {
  kernels::ChannelAttentionKernel kernel;
  kernels::ChannelAttentionJob job;

  void run(std::int64_t item, Worker&) const override { kernel(job, item); }
};

}  // namespace vla::lower
