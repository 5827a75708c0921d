// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/product_errors.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "kernels/numbers.h"

namespace vla {
namespace {

constexpr std::int64_t kRows = 32;         // rows sampled from a value
constexpr std::int64_t kMatrixRows = 128;  // rows of a matrix that multiply the sampled rows

/// Most bytes of sampled rows in memory at a time.
std::size_t most_sample_bytes(std::size_t budget) {
  constexpr std::size_t kMost = std::size_t{256} << 20;
  return budget > 0 ? std::min(kMost, budget / 8) : kMost;
}

/// A sample of a value's rows in which each row is equally likely (reservoir sampling). The same rows in every run.
class Sample {
 public:
  explicit Sample(std::size_t d) : d_(d), rows_(d * kRows) {}

  void add(std::span<const float> rows) {
    for (; !rows.empty(); rows = rows.subspan(d_), ++n_seen_) {
      const std::size_t slot = n_seen_ < kRows ? n_seen_ : random() % (n_seen_ + 1);
      if (slot < kRows) std::ranges::copy(rows.first(d_), rows_.begin() + static_cast<std::ptrdiff_t>(slot * d_));
    }
  }
  std::span<const float> rows() const { return std::span(rows_).first(d_ * std::min<std::size_t>(n_seen_, kRows)); }

 private:
  /// Knuth's MMIX generator.
  std::uint64_t random() {
    state_ = state_ * 6364136223846793005 + 1442695040888963407;
    return state_ >> 33;
  }

  std::size_t d_, n_seen_ = 0;
  std::uint64_t state_ = 1;
  std::vector<float> rows_;
};

using Samples = std::map<std::string, Sample>;

/// Rows as int8 kernels read them: divided by `by`, if given, and rounded to int8 with one scale per row.
std::vector<float> rounded(std::span<const float> rows, const std::vector<float>* by, std::size_t d) {
  std::vector<float> result(rows.begin(), rows.end());
  for (std::size_t first = 0; first < result.size(); first += d) {
    const std::span row(&result[first], d);
    float most = 1e-5f;
    for (std::size_t k = 0; k < d; ++k) {
      if (by != nullptr) row[k] /= (*by)[k];
      most = std::max(most, std::abs(row[k]));
    }
    for (float& x : row) x = std::nearbyint(x * (127 / most)) * (most / 127);
  }
  return result;
}

double dot(const float* a, const float* b, std::size_t n) {
  float sums[8] = {};
  std::size_t i = 0;
  for (; i + 8 <= n; i += 8)
    for (std::size_t lane = 0; lane < 8; ++lane) sums[lane] += a[i + lane] * b[i + lane];
  double sum = 0;
  for (; i < n; ++i) sum += double{a[i]} * b[i];
  for (const float lane : sums) sum += lane;
  return sum;
}

/// Rows of matrices, decoded.
class MatrixRows {
 public:
  static Result<MatrixRows> open(const std::string& path, Rounding codes) {
    VLA_TRY(Bundle bundle, Bundle::open(path));
    return MatrixRows(std::move(bundle), codes);
  }

  const TensorInfo& tensor(const std::string& name) const { return *bundle_.find(name); }
  /// Row i of a matrix of `d` columns, valid until the next call.
  Result<std::span<const float>> row(const TensorInfo& matrix, std::int64_t i, std::int64_t d) {
    row_.resize(static_cast<std::size_t>(d));
    const bool has_codes = matrix.type == DType::i8;
    const Encoding encoding = {codes_ == Rounding::int4 ? DType::int4 : DType::i8, d};
    const std::size_t size = has_codes ? encoding.size(d) : dtype_size(matrix.type, d);
    VLA_TRY(const auto stored, bundle_.read(matrix.data.subspan(static_cast<std::size_t>(i) * size, size), buffer_));
    if (has_codes) {
      const auto scale = tensor(scales_name(matrix.name, encoding)).data.subspan(static_cast<std::size_t>(i) * 4, 4);
      VLA_TRY(const auto read, bundle_.read(scale, scale_));
      widen_codes(encoding, stored.data(), reinterpret_cast<const float*>(read.data()), d, row_.data());
    } else {
      for (std::int64_t k = 0; k < d; ++k)
        row_[static_cast<std::size_t>(k)] = kernels::stored_number(matrix.type, stored.data(), k);
    }
    return std::span<const float>(row_);
  }

 private:
  MatrixRows(Bundle bundle, Rounding codes) : bundle_(std::move(bundle)), codes_(codes) {}
  Bundle bundle_;
  Rounding codes_;
  ReadBuffer buffer_, scale_;
  std::vector<float> row_;
};

/// Judges scalings by the products of sampled rows.
class Judge {
 public:
  static Result<Judge> open(const std::string& floats, const CodedPair& coded, Rounding codes) {
    VLA_TRY(MatrixRows exact, MatrixRows::open(floats, codes));
    VLA_TRY(MatrixRows plain, MatrixRows::open(coded.plain, codes));
    VLA_TRY(MatrixRows smoothed, MatrixRows::open(coded.smoothed, codes));
    return Judge(std::move(exact), std::move(plain), std::move(smoothed));
  }

  Result<bool> helps(const Scaling& scaling, std::span<const float> x) {
    const std::size_t d = scaling.by.size();
    const std::vector<float> as_is = rounded(x, nullptr, d), divided = rounded(x, &scaling.by, d);
    double before = 0, after = 0;
    for (const std::string& reader : scaling.readers) {
      const TensorInfo& matrix = exact_.tensor(reader);
      if (plain_.tensor(reader).type != DType::i8) continue;  // too small for codes
      double value = 0, missed[2] = {};
      const std::int64_t n_row = matrix.shape[1];
      for (std::int64_t i = 0; i < n_row; i += (n_row + kMatrixRows - 1) / kMatrixRows) {
        VLA_TRY(const auto w, exact_.row(matrix, i, matrix.shape[0]));
        VLA_TRY(const auto of_plain, plain_.row(plain_.tensor(reader), i, matrix.shape[0]));
        VLA_TRY(const auto of_smoothed, smoothed_.row(smoothed_.tensor(reader), i, matrix.shape[0]));
        for (std::size_t first = 0; first < x.size(); first += d) {
          const double y = dot(w.data(), &x[first], d);
          value += y * y;
          missed[0] += square(dot(of_plain.data(), &as_is[first], d) - y);
          missed[1] += square(dot(of_smoothed.data(), &divided[first], d) - y);
        }
      }
      if (value > 0) before += missed[0] / value, after += missed[1] / value;
    }
    return after < before;
  }

 private:
  Judge(MatrixRows exact, MatrixRows plain, MatrixRows smoothed)
      : exact_(std::move(exact)), plain_(std::move(plain)), smoothed_(std::move(smoothed)) {}
  static double square(double x) { return x * x; }

  MatrixRows exact_, plain_, smoothed_;
};

/// Samples rows of the scalings' values: of as many values as fit in memory, at least of one.
Result<Samples> take_samples(const std::string& bundle, std::span<const Scaling> scalings,
                             std::span<const Judged> observations, EngineOptions options) {
  Samples samples;
  std::size_t size = 0;
  options.kernels = "float32";
  for (const Scaling& scaling : scalings) {
    size += scaling.by.size() * kRows * sizeof(float);
    if (!samples.empty() && size > most_sample_bytes(options.memory)) break;
    samples.try_emplace(scaling.path, scaling.by.size());
    options.tap_pattern += fmt::format("{0},step.*.{0},", scaling.path);
  }
  options.tap_pattern.pop_back();
  options.see_tap = [&](const std::string& path, auto, auto values) { samples.at(without_step(path)).add(values); };
  VLA_TRY(const Chunks chunks, chunks_of(bundle, options, observations));
  return samples;
}

}  // namespace

Result<std::vector<Scaling>> helpful_scalings(const std::string& floats, const CodedPair& coded, Rounding codes,
                                              std::span<const Scaling> scalings, std::span<const Judged> observations,
                                              EngineOptions options) {
  std::vector<Scaling> helpful;
  while (!scalings.empty()) {
    VLA_TRY(const Samples samples, take_samples(floats, scalings, observations, options));
    VLA_TRY(Judge judge, Judge::open(floats, coded, codes));
    for (const Scaling& scaling : scalings.first(samples.size())) {
      VLA_TRY(const bool helps, judge.helps(scaling, samples.at(scaling.path).rows()));
      if (helps) helpful.push_back(scaling);
    }
    scalings = scalings.subspan(samples.size());
  }
  return helpful;
}

}  // namespace vla
