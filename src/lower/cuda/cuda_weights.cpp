// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_weights.h"

#include <algorithm>
#include <cstring>
#include <map>

#include "cuda/kernels/linear_int8.h"
#include "kernels/numbers.h"
#include "kernels/quantize_weights.h"

namespace vla::lower {
namespace {

constexpr std::size_t kAlignment = 256;
constexpr std::size_t aligned(std::size_t size) { return (size + kAlignment - 1) / kAlignment * kAlignment; }

constexpr const char* kKernels[] = {"linear_f32", "linear_bf16", "linear_ternary", "linear_int8"};

MatrixKind kind_of(const Param& param, const Encoding& encoding, Rounding rounding) {
  if (param.storage != Storage::matrix) return MatrixKind::f32;
  if (encoding.type == DType::ternary) return MatrixKind::ternary;
  if (encoding.type == DType::i8 && encoding.group == param.shape[0]) return MatrixKind::int8;
  return encoding.type == DType::bf16 && rounding != Rounding::float32 ? MatrixKind::bf16 : MatrixKind::f32;
}

bool has_codes(MatrixKind kind) { return kind == MatrixKind::ternary || kind == MatrixKind::int8; }
cuda::CodeKind code_kind(MatrixKind kind) {
  return kind == MatrixKind::ternary ? cuda::CodeKind::ternary : cuda::CodeKind::int8;
}

std::size_t size_of(const Param& param, MatrixKind kind) {
  if (param.storage == Storage::table) return dtype_size(param.encoding.type, param.count());
  if (has_codes(kind)) return cuda::packed_int8_size(code_kind(kind), param.shape[0], param.shape[1]);
  if (kind == MatrixKind::bf16) return static_cast<std::size_t>(bf16_stride(param.shape[0]) * param.shape[1]) * 2;
  return static_cast<std::size_t>(param.count()) * sizeof(float);
}

/// One parameter on its way from the bundle, in rooms that are used again.
class Reader {
 public:
  explicit Reader(const Content& content) : content_(content) {}

  /// Bytes as they are resident, and scales where it has codes. False where the file has changed.
  bool read(const Param& param, const CudaWeight& to) {
    stored_ = content_.read(param.source->data, room_);
    if (stored_ == nullptr) return false;
    stored_scales_ = nullptr;
    if (param.scales != nullptr) {
      stored_scales_ = reinterpret_cast<const float*>(content_.read(param.scales->source->data, scale_room_));
      if (stored_scales_ == nullptr) return false;
    }
    data_ = stored_;
    if (param.storage == Storage::table) return true;
    if (has_codes(to.kind))
      pack(param, to);
    else if (to.kind == MatrixKind::bf16)
      round(param);
    else if (param.encoding.type != DType::f32)
      widen(param);
    return true;
  }
  const std::byte* data() const { return data_; }
  const std::vector<float>& scales() const { return scales_; }

 private:
  static std::size_t at(std::int64_t i) { return static_cast<std::size_t>(i); }

  void widen(const Param& param) {
    wide_.resize(at(param.count()));
    if (is_float(param.encoding.type))
      for (std::int64_t i = 0; i < param.count(); ++i)
        wide_[at(i)] = kernels::stored_number(param.encoding.type, stored_, i);
    else
      widen_codes(param.encoding, stored_, stored_scales_, param.count(), wide_.data());
    data_ = reinterpret_cast<const std::byte*>(wide_.data());
  }
  void round(const Param& param) {
    const std::int64_t d_in = param.shape[0], stride = bf16_stride(d_in);
    bytes_.assign(size_of(param, MatrixKind::bf16), std::byte{0});
    for (std::int64_t i = 0; i < param.count(); ++i) {
      const std::uint16_t half = to_bf16(kernels::stored_number(param.encoding.type, stored_, i));
      std::memcpy(&bytes_[at(i / d_in * stride + i % d_in) * 2], &half, sizeof(half));
    }
    data_ = bytes_.data();
  }
  void pack(const Param& param, const CudaWeight& to) {
    const std::int64_t d_in = param.shape[0], d_out = param.shape[1];
    codes_.resize(at(param.count())), scales_.resize(at(d_out));
    if (is_float(param.encoding.type)) {
      wide_.resize(at(d_in));
      kernels::quantize_weights(param.encoding.type, stored_, d_in, d_out, reinterpret_cast<std::byte*>(codes_.data()),
                                scales_.data(), wide_.data());
    } else {
      for (std::int64_t row = 0; row < d_out; ++row)
        scales_[at(row)] = stored_scales_[row * d_in / param.encoding.group];
      if (param.encoding.type == DType::i8)
        std::memcpy(codes_.data(), stored_, codes_.size());
      else
        for (std::int64_t row = 0, row_bytes = (d_in + 3) / 4; row < d_out; ++row)
          for (std::int64_t i = 0; i < d_in; ++i)
            codes_[at(row * d_in + i)] =
                static_cast<std::int8_t>((std::to_integer<int>(stored_[row * row_bytes + i / 4]) >> i % 4 * 2 & 3) - 1);
    }
    bytes_.resize(size_of(param, to.kind));
    cuda::pack_int8(code_kind(to.kind), codes_.data(), d_in, d_out, bytes_.data());
    data_ = bytes_.data();
  }

  const Content& content_;
  Room room_, scale_room_;
  const std::byte *stored_ = nullptr, *data_ = nullptr;
  const float* stored_scales_ = nullptr;
  std::vector<float> wide_, scales_;
  std::vector<std::byte> bytes_;
  std::vector<std::int8_t> codes_;
};

}  // namespace

bool CudaWeights::has(MatrixKind kind) const {
  return std::any_of(all_.begin(), all_.end(), [&](const CudaWeight& weight) { return weight.kind == kind; });
}

Result<CudaWeights> CudaWeights::load(const ParamList& list, Rounding rounding, bool fill, CudaQueue& queue) {
  VLA_CHECK(check_rounding(list, rounding));
  CudaWeights weights;
  std::map<std::pair<MatrixKind, std::string>, int> counts;
  std::size_t size = 0;
  for (const Param& param : list.params()) {
    CudaWeight weight;
    weight.encoding = resident_encoding(param, rounding);
    weight.kind = kind_of(param, weight.encoding, rounding);
    weight.data = size, size += aligned(size_of(param, weight.kind));
    if (has_codes(weight.kind)) weight.scales = size, size += aligned(static_cast<std::size_t>(param.shape[1]) * 4);
    if (param.storage == Storage::matrix) ++counts[{weight.kind, dtype_name(param.encoding.type)}];
    weights.all_.push_back(weight);
  }
  for (const auto& [what, n] : counts)
    weights.text_ += (weights.text_.empty() ? "" : ", ") + std::string(kKernels[static_cast<int>(what.first)]) + " (" +
                     std::to_string(n) + " " + what.second + ")";
  VLA_TRY(weights.memory_, queue.allocate(size, "weights"));
  for (CudaWeight& weight : weights.all_)
    weight.data += weights.memory_->address(), weight.scales += weights.memory_->address();
  if (!fill || list.params().empty()) return weights;
  Reader reader(*list.bundle()->content());
  for (const Param& param : list.params()) {
    if (param.source == nullptr) continue;
    const CudaWeight& weight = weights[param];
    if (!reader.read(param, weight)) return list.bundle()->content()->changed();
    VLA_CHECK(queue.upload(weight.data, reader.data(), size_of(param, weight.kind)));
    if (has_codes(weight.kind))
      VLA_CHECK(queue.upload(weight.scales, reader.scales().data(), reader.scales().size() * 4));
  }
  return weights;
}

}  // namespace vla::lower
