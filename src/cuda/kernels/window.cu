// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/window.h"

#include <cmath>

#include "cuda/kernels/device.h"

namespace vla::cuda {
namespace {

/// A position of the window: its upper left pixel, which may be outside of the image.
struct Place {
  const float* image;
  int column, row;
};

VLA_DEVICE Place place_of(const WindowJob& job, std::int64_t number) {
  const std::int64_t view = number / job.n_column / job.n_row;
  return {job.x + view * job.height * job.width * job.d,
          static_cast<int>(number % job.n_column) * job.stride - job.padding,
          static_cast<int>(number / job.n_column % job.n_row) * job.stride - job.padding};
}

/// Feature i of a pixel, or `beyond` outside of the image.
VLA_DEVICE float feature(const WindowJob& job, const float* image, int column, int row, int i, float beyond) {
  if (column < 0 || column >= job.width || row < 0 || row >= job.height) return beyond;
  return image[(static_cast<std::int64_t>(row) * job.width + column) * job.d + i];
}

/// The maximum of feature i in the window; NaN if any value is NaN.
VLA_DEVICE float largest(const WindowJob& job, const Place& place, int i) {
  float most = -INFINITY;
  for (int pixel = 0; pixel < job.size * job.size; ++pixel) {
    const float x = feature(job, place.image, place.column + pixel % job.size, place.row + pixel / job.size, i, most);
    if (x > most || x != x) most = x;
  }
  return most;
}

/// Sums products with the feature's weights in the order of the window's pixels.
VLA_DEVICE float weighted(const WindowJob& job, const Place& place, int i) {
  float sum = job.bias[i];
  for (int pixel = 0; pixel < job.size * job.size; ++pixel) {
    const float x = feature(job, place.image, place.column + pixel % job.size, place.row + pixel / job.size, i, 0);
    sum += x * job.weight[pixel * job.d + i];
  }
  return sum;
}

}  // namespace

/// A thread computes four elements, 256 apart, so that accesses of a warp are coalesced.
VLA_KERNEL(window_elements, 256, 4, WindowJob) {
  const std::int64_t n = job.count(), n_of_row = job.n_of_row();
  for (int k = 0; k < 4; ++k) {
    const std::int64_t at = static_cast<std::int64_t>(blockIdx.x) * 1024 + k * 256 + thread_index();
    if (at >= n) return;
    const Place place = place_of(job, at / n_of_row);
    const int i = static_cast<int>(at % n_of_row), pixel = i / job.d;
    const float value = job.takes_largest       ? largest(job, place, i)
                        : job.weight != nullptr ? weighted(job, place, i)
                                                : feature(job, place.image, place.column + pixel % job.size,
                                                          place.row + pixel / job.size, i % job.d, 0);
    store(job.y, job.is_bf16, at / n_of_row * job.y_stride + i, value);
  }
}

}  // namespace vla::cuda
