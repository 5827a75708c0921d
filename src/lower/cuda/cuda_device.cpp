// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_device.h"

#include <algorithm>
#include <limits>

#include "kernels/numbers.h"
#include "lower/cuda/cuda_program.h"

namespace vla::lower {
namespace {

constexpr std::size_t kAlignment = 256;
constexpr std::size_t aligned(std::size_t size) { return (size + kAlignment - 1) / kAlignment * kAlignment; }

/// Kernels in float32 that take one product at a time, and no norm on the way.
class CudaTarget final : public Target {
 public:
  const void* multiplier(const Param&) const override { return &encoding_; }
  std::size_t max_products() const override { return 1; }
  std::int64_t max_norm(const Param&) const override { return 0; }
  const Encoding& encoding(const Param&) const override { return encoding_; }
  std::int64_t min_rounded_keys() const override { return std::numeric_limits<std::int64_t>::max(); }
  std::size_t alignment() const override { return kAlignment; }

 private:
  Encoding encoding_;  // float32
};

bool widens(const Param& param) { return param.storage != Storage::table; }
std::size_t resident_size(const Param& param) {
  return dtype_size(widens(param) ? DType::f32 : param.encoding.type, param.count());
}

/// A parameter as it is resident; rooms are for what is read. Null where the file has changed.
const std::byte* resident(const Bundle& bundle, const Param& param, Room& room, Room& scale_room,
                          std::vector<float>& wide) {
  const std::byte* stored = bundle.content()->read(param.source->data, room);
  const DType type = param.encoding.type;
  if (stored == nullptr || !widens(param) || type == DType::f32) return stored;
  const std::byte* scales = nullptr;
  if (type == DType::i8) {
    scales = bundle.content()->read(param.scales->source->data, scale_room);
    if (scales == nullptr) return nullptr;
  }
  wide.resize(static_cast<std::size_t>(param.count()));
  for (std::int64_t i = 0; i < param.count(); ++i) {
    float& to = wide[static_cast<std::size_t>(i)];
    if (type == DType::i8)
      to = static_cast<float>(std::to_integer<std::int8_t>(stored[i])) *
           kernels::stored_number(DType::f32, scales, i / param.encoding.group);
    else
      to = kernels::stored_number(type, stored, i);
  }
  return reinterpret_cast<const std::byte*>(wide.data());
}

}  // namespace

Status CudaDevice::Shared::keep(Status status) {
  if (!status && failure) failure = status;
  return status;
}

Result<std::unique_ptr<Device>> CudaDevice::open(const cuda::Driver& driver, int index,
                                                 const std::vector<std::string>& modules) {
  std::unique_ptr<CudaDevice> device(new CudaDevice);
  device->shared_ = std::make_shared<Shared>();
  VLA_TRY(device->shared_->gpu, cuda::Gpu::open(driver, index, modules));
  VLA_TRY(cuda::Stream stream, device->shared_->gpu->stream());
  device->shared_->stream = std::make_unique<cuda::Stream>(std::move(stream));
  return std::unique_ptr<Device>(std::move(device));
}

Status CudaDevice::load(const ParamList& params, bool fill) {
  int n_matrix = 0;
  std::size_t size = 0;
  std::vector<std::size_t> begins;
  for (const Param& param : params.params()) {
    if (param.encoding.type == DType::ternary)
      return Error{Code::unsupported, param.name, "a matrix of floats", "a ternary one", "use --kernels ggml"};
    n_matrix += param.storage == Storage::matrix;
    begins.push_back(size);
    size += aligned(resident_size(param));
  }
  text_ = "linear_f32 (" + std::to_string(n_matrix) + ")";
  VLA_TRY(cuda::Buffer memory, shared_->gpu->allocate(std::max<std::size_t>(size, 1), "weights"));
  weights_ = std::make_shared<cuda::Buffer>(std::move(memory));
  places_.clear();
  for (const std::size_t begin : begins) places_.push_back(weights_->address() + begin);
  Room room, scale_room;
  std::vector<float> wide;
  for (const Param& param : params.params()) {
    if (!fill || param.source == nullptr) continue;
    const std::byte* from = resident(*params.bundle(), param, room, scale_room, wide);
    if (from == nullptr) return params.bundle()->content()->changed();
    VLA_CHECK(shared_->keep(
        shared_->stream->upload(places_[static_cast<std::size_t>(param.id)], from, resident_size(param))));
    VLA_CHECK(shared_->keep(shared_->stream->wait()));  // the rooms are used again
  }
  return {};
}

Status CudaDevice::allocate(Slots& slots) {
  std::size_t size = 0;
  for (const Slot& slot : slots.all()) size += aligned(slot.size());
  size = std::max<std::size_t>(size, 1);
  VLA_TRY(cuda::Buffer made, shared_->gpu->allocate(size, "inputs and cache"));
  const auto memory = std::make_shared<cuda::Buffer>(std::move(made));
  cuda::Address place = memory->address();
  for (Slot& slot : slots.all()) slot.place = reinterpret_cast<void*>(place), place += aligned(slot.size());
  const std::vector<std::byte> zeros(size);
  VLA_CHECK(shared_->keep(shared_->stream->upload(memory->address(), zeros.data(), size)));
  VLA_CHECK(shared_->keep(shared_->stream->wait()));
  // With the device, which must not go before its memory.
  slots.hold(std::make_shared<std::pair<std::shared_ptr<Shared>, std::shared_ptr<cuda::Buffer>>>(shared_, memory),
             size);
  return {};
}

void CudaDevice::set(const Slot& slot, const void* data, std::size_t size) {
  if (shared_->keep(shared_->stream->upload(reinterpret_cast<cuda::Address>(slot.place), data, size)))
    static_cast<void>(shared_->keep(shared_->stream->wait()));  // `data` is the caller's again
}

void CudaDevice::get(const Slot& slot, void* data, std::size_t size) const {
  if (shared_->keep(shared_->stream->download(data, reinterpret_cast<cuda::Address>(slot.place), size)))
    static_cast<void>(shared_->keep(shared_->stream->wait()));
}

Result<std::unique_ptr<Program>> CudaDevice::lower(const Graph& graph, const LowerOptions& options) {
  if (!graph.problem().empty())
    return Error{Code::internal, "graph", "operands that fit", graph.problem(), "please report this"};
  const CudaTarget target;
  CudaLowering l = {{.graph = graph, .options = options, .target = target}, places_};
  start(l);
  std::vector<FusedOp> ops = fuse(l);
  store(l, ops);
  choose_layouts(l, std::move(ops));
  std::vector<Step*> steps;
  for (CudaOp& op : l.ops) steps.push_back(&op);
  schedule(l, steps);
  place(l, steps);
  std::stable_sort(l.ops.begin(), l.ops.end(), [](const CudaOp& a, const CudaOp& b) {
    return std::pair(a.phase, a.order) < std::pair(b.phase, b.order);
  });
  if (!arena_ || l.arena_size > arena_->size()) {  // programs made before keep the memory that they were given
    VLA_TRY(cuda::Buffer memory, shared_->gpu->allocate(std::max<std::size_t>(l.arena_size, 1), "working memory"));
    arena_ = std::make_shared<cuda::Buffer>(std::move(memory));
  }
  return CudaProgram::make(l, shared_, {weights_, arena_});
}

}  // namespace vla::lower
