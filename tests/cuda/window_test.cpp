// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/window.h"

#include <doctest/doctest.h>

#include "cuda/machine.h"
#include "cuda/numbers.h"

namespace window_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

/// What the window covers at each place, pixel by pixel with all their features, `beyond` the image too.
std::vector<float> covered(const WindowJob& job, const std::vector<float>& x, float beyond) {
  std::vector<float> y;
  for (int view = 0; view < job.n_view; ++view)
    for (int place = 0; place < job.n_column * job.n_row; ++place)
      for (int pixel = 0; pixel < job.size * job.size; ++pixel) {
        const int column = place % job.n_column * job.stride - job.padding + pixel % job.size;
        const int row = place / job.n_column * job.stride - job.padding + pixel / job.size;
        const bool is_inside = column >= 0 && column < job.width && row >= 0 && row < job.height;
        for (int i = 0; i < job.d; ++i)
          y.push_back(is_inside
                          ? x[static_cast<std::size_t>(((view * job.height + row) * job.width + column) * job.d + i)]
                          : beyond);
      }
  return y;
}

/// Of the pixels that each place covers the largest of each feature.
std::vector<float> largest(const WindowJob& job, const std::vector<float>& x) {
  const std::vector<float> all = covered(job, x, -INFINITY);
  std::vector<float> y;
  const int area = job.size * job.size, n_place = job.n_column * job.n_row * job.n_view;
  for (int place = 0; place < n_place; ++place)
    for (int i = 0; i < job.d; ++i) {
      float most = -INFINITY;
      for (int pixel = 0; pixel < area; ++pixel) {
        const float value = all[static_cast<std::size_t>((place * area + pixel) * job.d + i)];
        most = std::isnan(most) || value <= most ? most : value;
      }
      y.push_back(most);
    }
  return y;
}

/// The job of a window over images of as many pixels; d is odd.
WindowJob job_of(int width, int height, int size, int stride, int padding) {
  WindowJob job = {};
  job.d = 5, job.width = width, job.height = height, job.n_view = 2;
  job.size = size, job.stride = stride, job.padding = padding;
  job.n_column = (width + 2 * padding - size) / stride + 1, job.n_row = (height + 2 * padding - size) / stride + 1;
  return job;
}

/// Rows without what pads them, which must be left as it is.
std::vector<float> rows(const WindowJob& job, const std::vector<float>& padded) {
  std::vector<float> y;
  for (std::size_t i = 0; i < padded.size(); ++i)
    if (static_cast<std::int64_t>(i) % job.y_stride < job.n_of_row())
      y.push_back(padded[i]);
    else
      CHECK(std::isnan(padded[i]));
  return y;
}

}  // namespace

TEST_CASE("windows over images cover their pixels and zeros, or leave the largest, of float32 as it is") {
  for (WindowJob job : {job_of(11, 6, 7, 2, 3), job_of(4, 9, 3, 1, 1), job_of(12, 9, 3, 2, 1), job_of(5, 4, 1, 2, 0),
                        job_of(6, 5, 2, 1, 0)})
    for (const bool takes_largest : {false, true}) {
      CAPTURE(job.size);
      CAPTURE(takes_largest);
      Numbers numbers;
      std::vector<float> x = numbers.floats(job.d * job.width * job.height * job.n_view);
      for (float& value : x) value -= 2;  // most are below the zeros beyond the image
      const Device<float> gx(x);
      job.x = gx.get(), job.takes_largest = takes_largest, job.y_stride = job.n_of_row() + 3;
      const std::vector<float> expected = takes_largest ? largest(job, x) : covered(job, x, 0);
      const auto size = static_cast<std::size_t>(job.y_stride * (job.count() / job.n_of_row()));
      const Device<float> y(size);
      const Device<std::uint16_t> half(size);
      job.y = y.get(), job.is_bf16 = false;
      in_every_schedule([&] {
        launch(window_elements(job), job);
        CHECK(rows(job, y.host()) == expected);
      });
      job.y = half.get(), job.is_bf16 = true;
      launch(window_elements(job), job);
      CHECK(rows(job, widened(half.host())) == rounded_to_bf16(expected));
    }
}

TEST_CASE("the largest of a window is NaN where a pixel is, and minus infinity where nothing is larger") {
  WindowJob job = job_of(5, 3, 3, 2, 1);
  job.n_view = 1, job.takes_largest = true, job.y_stride = job.d;
  std::vector<float> x(static_cast<std::size_t>(job.d * job.width * job.height), -INFINITY);
  x[0] = NAN, x[static_cast<std::size_t>(job.d * 2 + 1)] = 3;  // of the first pixel, and of the third
  const Device<float> gx(x), y(static_cast<std::size_t>(job.count()));
  job.x = gx.get(), job.y = y.get();
  launch(window_elements(job), job);
  const std::vector<float> found = y.host(), expected = largest(job, x);
  CHECK(std::isnan(found[0]));
  for (std::size_t i = 1; i < found.size(); ++i) CHECK(found[i] == expected[i]);
}

TEST_CASE("the weighted sum of a window has its own weights for each feature and pixel, and a bias") {
  for (WindowJob job : {job_of(4, 9, 3, 1, 1), job_of(11, 6, 5, 2, 2)}) {
    CAPTURE(job.size);
    Numbers numbers;
    const int area = job.size * job.size;
    const std::vector<float> x = numbers.floats(job.d * job.width * job.height * job.n_view),
                             weight = numbers.floats(job.d * area), bias = numbers.floats(job.d);
    const Device<float> gx(x), gw(weight), gb(bias);
    job.x = gx.get(), job.weight = gw.get(), job.bias = gb.get(), job.y_stride = job.d + 3;
    const Device<float> y(static_cast<std::size_t>(job.y_stride * (job.count() / job.n_of_row())));
    job.y = y.get();
    launch(window_elements(job), job);
    const std::vector<float> found = rows(job, y.host()), all = covered(job, x, 0);
    REQUIRE(found.size() * static_cast<std::size_t>(area) == all.size());
    for (std::size_t at = 0; at < found.size(); ++at) {
      const auto d = static_cast<std::size_t>(job.d), i = at % d;
      double sum = bias[i];
      for (std::size_t pixel = 0; pixel < static_cast<std::size_t>(area); ++pixel)
        sum += double{all[(at / d * static_cast<std::size_t>(area) + pixel) * d + i]} * weight[pixel * d + i];
      CHECK(found[at] == doctest::Approx(sum).epsilon(1e-5));
    }
  }
}

}  // namespace window_test
