// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_weights.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <map>

namespace vla::lower {
namespace {

MatrixKind kind_of(const Param& param, const Encoding& encoding, Rounding rounding) {
  if (param.storage != Storage::matrix) return MatrixKind::f32;
  if (encoding.type == DType::ternary) return MatrixKind::ternary;
  if (encoding.type == DType::int4 && encoding.group == param.shape[0]) return MatrixKind::int4;
  if (encoding.type == DType::i8 && encoding.group == param.shape[0]) return MatrixKind::int8;
  return encoding.type == DType::bf16 && rounding != Rounding::float32 ? MatrixKind::bf16 : MatrixKind::f32;
}

std::size_t f32_size(const kernels::MatrixDesc& desc) { return dtype_size(DType::f32, desc.d_in * desc.d_out); }
void pack_f32(const kernels::MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  std::memcpy(packed, stored, f32_size(desc));
}

std::size_t bf16_size(const kernels::MatrixDesc& desc) {
  return dtype_size(DType::bf16, bf16_stride(desc.d_in) * desc.d_out);
}
void pack_bf16(const kernels::MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  const std::size_t row = dtype_size(DType::bf16, desc.d_in), stride = dtype_size(DType::bf16, bf16_stride(desc.d_in));
  for (std::int64_t i = 0; i < desc.d_out; ++i, stored += row, packed += stride) {
    std::memcpy(packed, stored, row);
    std::memset(packed + row, 0, stride - row);
  }
}

template <cuda::CodeKind kKind>
std::size_t code_size(const kernels::MatrixDesc& desc) {
  return cuda::packed_int8_size(kKind, desc.d_in, desc.d_out);
}
template <cuda::CodeKind kKind>
void pack_codes(const kernels::MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  cuda::pack_int8(kKind, stored, desc.d_in, desc.d_out, packed);
}

/// Indexed by MatrixKind.
constexpr Packing kPacking[] = {{f32_size, pack_f32},
                                {bf16_size, pack_bf16},
                                {code_size<cuda::CodeKind::ternary>, pack_codes<cuda::CodeKind::ternary>},
                                {code_size<cuda::CodeKind::int4>, pack_codes<cuda::CodeKind::int4>},
                                {code_size<cuda::CodeKind::int8>, pack_codes<cuda::CodeKind::int8>}};

MatrixPlace place_of(const Param& matrix, const CudaWeight& weight) {
  MatrixPlace place;
  place.encoding = is_of_codes(weight.kind)          ? weight.encoding
                   : weight.kind == MatrixKind::bf16 ? Encoding{DType::bf16}
                                                     : Encoding{DType::f32};
  place.packing = kPacking[static_cast<int>(weight.kind)];
  place.n_scale = is_of_codes(weight.kind) ? matrix.shape[1] : 0;
  return place;
}

/// Copies groups of matrices into windows of device memory over a separate stream, while kernels read other windows.
/// The host's windows are page-locked, so that the device reads them directly.
class CudaWindows final : public WindowMemory {
 public:
  /// device: address of the first window; each has `size` bytes. Errors: device, out_of_memory.
  static Result<std::unique_ptr<WindowMemory>> open(std::shared_ptr<CudaQueue> queue, cuda::Address device,
                                                    std::size_t size) {
    const std::shared_ptr<cuda::Gpu> gpu = queue->gpu();
    VLA_CHECK(gpu->use());
    VLA_TRY(cuda::Stream copies, gpu->stream());
    std::unique_ptr<CudaWindows> windows(new CudaWindows(std::move(queue), std::move(copies), device, size));
    for (cuda::Owned& event : windows->read_) {
      VLA_TRY(event, gpu->event(false));
    }
    VLA_TRY(windows->host_, gpu->allocate_host(WeightStream::kWindows * size));
    return std::unique_ptr<WindowMemory>(std::move(windows));
  }
  ~CudaWindows() override { static_cast<void>(queue_->gpu()->use()); }

  std::byte* host(int window) override { return static_cast<std::byte*>(host_.get()) + offset(window); }
  Status note_read(int window) override { return queue_->keep(queue_->record(read(window))); }
  Status upload(int window, std::size_t size) override { return queue_->keep(copy(window, size)); }

 private:
  CudaWindows(std::shared_ptr<CudaQueue> queue, cuda::Stream copies, cuda::Address device, std::size_t size)
      : queue_(std::move(queue)), copies_(std::move(copies)), device_(device), size_(size) {}
  std::size_t offset(int window) const { return static_cast<std::size_t>(window) * size_; }
  /// The event recorded after the kernels that have read a window so far.
  const cuda::Owned& read(int window) const { return read_[static_cast<std::size_t>(window)]; }
  Status copy(int window, std::size_t size) {
    VLA_CHECK(queue_->gpu()->use());
    VLA_CHECK(copies_.after(read(window)));
    VLA_CHECK(copies_.upload(device_ + offset(window), host(window), size));
    return copies_.wait();
  }

  std::shared_ptr<CudaQueue> queue_;
  cuda::Stream copies_;
  cuda::Address device_;
  std::size_t size_;
  cuda::Owned host_;
  std::array<cuda::Owned, WeightStream::kWindows> read_;
};

}  // namespace

std::string kernel_name(MatrixKind kind) {
  constexpr const char* kNames[] = {"f32", "bf16", "ternary", "int4", "int8"};
  return std::string("linear_") + kNames[static_cast<int>(kind)];
}

bool CudaWeights::has(MatrixKind kind) const { return std::ranges::find(all_, kind, &CudaWeight::kind) != all_.end(); }

bool CudaWeights::has_codes() const { return std::ranges::any_of(all_, is_of_codes, &CudaWeight::kind); }

std::size_t CudaWeights::size_of(const Param& matrix) const {
  return device_aligned(place_of(matrix, (*this)[matrix]).size_of(matrix));
}

Result<CudaWeights> CudaWeights::load(const ParamList& list, Rounding rounding, bool fill, const WeightPlan& plan,
                                      const std::shared_ptr<CudaQueue>& queue) {
  VLA_CHECK(check_rounding(list, rounding));
  CudaWeights weights;
  weights.choose(list, rounding);
  VLA_CHECK(weights.give_places(list, plan, *queue));
  if (!fill || list.params().empty()) return weights;
  VLA_CHECK(weights.fill(list, *queue));
  VLA_CHECK(weights.start_stream(list, plan, queue));
  return weights;
}

/// Chooses the storage and the kernel of each parameter.
void CudaWeights::choose(const ParamList& list, Rounding rounding) {
  std::map<std::pair<MatrixKind, std::string>, int> counts;
  for (const Param& param : list.params()) {
    CudaWeight& weight = all_.emplace_back();
    weight.encoding = resident_encoding(param, rounding);
    weight.kind = kind_of(param, weight.encoding, rounding);
    if (param.storage == Storage::matrix) ++counts[{weight.kind, dtype_name(param.encoding.type)}];
  }
  for (const auto& [what, n] : counts)
    text_ += (text_.empty() ? "" : ", ") + kernel_name(what.first) + " (" + std::to_string(n) + " " + what.second + ")";
}

/// Places resident parameters one after the other, then the windows.
Status CudaWeights::give_places(const ParamList& list, const WeightPlan& plan, CudaQueue& queue) {
  groups_ = groups_by_id(plan, all_.size());
  std::size_t size = 0;
  for (const Param& param : list.params()) {
    if (is_streamed(param)) continue;
    at(param).data = size;
    size += param.storage == Storage::matrix ? size_of(param)
                                             : device_aligned(dtype_size(param.encoding.type, param.count()));
  }
  const std::size_t windows = plan.streamed.empty() ? 0 : WeightStream::kWindows * plan.window;
  for (std::size_t i = 0; i < plan.streamed.size(); ++i) {
    std::size_t place = size + static_cast<std::size_t>(WeightStream::window_of(i)) * plan.window;
    for (const Param* matrix : plan.streamed[i]) at(*matrix).data = place, place += size_of(*matrix);
  }
  VLA_TRY(memory_, queue.allocate(size + windows, "weights"));
  for (const Param& param : list.params()) {
    CudaWeight& weight = at(param);
    weight.data += memory_->address();
    if (is_of_codes(weight.kind)) weight.scales = weight.data + place_of(param, weight).scales_begin(param);
  }
  return {};
}

/// Reads, packs and uploads the resident parameters.
Status CudaWeights::fill(const ParamList& list, CudaQueue& queue) const {
  const Content& content = *list.bundle()->content();
  Packer packer;
  ReadBuffer buffer;
  for (const Param& param : list.params()) {
    if (param.source == nullptr || is_streamed(param)) continue;
    std::vector<PackPart> parts;
    std::size_t size = param.source->data.size();
    if (param.storage == Storage::matrix) {
      MatrixPlace place = place_of(param, (*this)[param]);
      size = place.size_of(param);
      place.put(param, buffer.take(size));
      add_parts(param, place, parts);
    } else {
      parts.push_back({.from = param.source->data, .to = buffer.take(size)});
    }
    for (const PackPart& part : parts)
      if (!packer.run(content, part)) return content.changed();
    VLA_CHECK(queue.upload((*this)[param].data, buffer.take(size), size));
  }
  return {};
}

Status CudaWeights::start_stream(const ParamList& list, const WeightPlan& plan,
                                 const std::shared_ptr<CudaQueue>& queue) {
  if (plan.streamed.empty()) return {};
  const cuda::Address end = memory_->address() + memory_->size();
  VLA_TRY(std::unique_ptr<WindowMemory> memory,
          CudaWindows::open(queue, end - WeightStream::kWindows * plan.window, plan.window));
  VLA_TRY(windows_, DeviceWindows::start(
                        std::move(memory), list.bundle()->content(), plan,
                        [this](const Param& matrix) { return place_of(matrix, (*this)[matrix]); },
                        [this](const Param& matrix) { return size_of(matrix); }));
  return {};
}

}  // namespace vla::lower
