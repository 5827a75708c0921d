// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_device.h"

#include <algorithm>
#include <limits>

#include "lower/cuda/cuda_program.h"

namespace vla::lower {
namespace {

constexpr std::int64_t kNoLimit = std::numeric_limits<std::int64_t>::max();
/// Fewest keys of attention in bf16. Over fewer keys rounding errors do not cancel, and float32 takes little time.
constexpr std::int64_t kMinRoundedKeys = 32;

/// Kernels that convert x also apply its norm; float32 kernels apply none.
Multiplier multiplier_of(const CudaWeight& weight) {
  static constexpr char kKinds[static_cast<int>(MatrixKind::int8) + 1] =
      {};  // distinct addresses, to tell kernels apart
  const std::int64_t max_norm = weight.kind == MatrixKind::f32 ? 0 : kNoLimit;
  return {&kKinds[static_cast<int>(weight.kind)], max_norm, false, true, &weight.encoding};
}

}  // namespace

Result<std::unique_ptr<Device>> CudaDevice::open(const cuda::Driver& driver, int index,
                                                 const std::vector<std::string>& modules, Rounding at_load) {
  VLA_TRY(const CudaWays ways, cuda_ways_of_environment());
  VLA_TRY(std::shared_ptr<CudaQueue> queue, CudaQueue::open(driver, index, modules));
  const std::string name = "cuda:" + std::to_string(index) + ", " + queue->gpu()->name();
  return std::unique_ptr<Device>(new CudaDevice(name, std::move(queue), ways, at_load));
}

Result<std::unique_ptr<Device>> CudaDevice::model(const std::string& name, Rounding at_load) {
  VLA_TRY(const CudaWays ways, cuda_ways_of_environment());
  VLA_TRY(const GpuModel found, find_gpu_model(name));
  std::unique_ptr<CudaDevice> device(new CudaDevice(std::string("model of ") + found.description,
                                                    std::make_shared<CudaQueue>(found.n_sm, found.is_hopper), ways,
                                                    at_load));
  device->model_ = found;
  return std::unique_ptr<Device>(std::move(device));
}

Status CudaDevice::load(const ParamList& params, bool fill, const WeightPlan& plan) {
  if (model_ && fill) return Error{Code::usage, "model", "a device that is there", name_, "it says times alone"};
  queue_->set_dry(!fill);
  arena_.reset();  // after a dry load the arena has no memory
  VLA_TRY(weights_, CudaWeights::load(params, rounding_, fill, plan, queue_));
  // Attention rounds if products do.
  const bool rounds =
      weights_.has(MatrixKind::bf16) || weights_.has(MatrixKind::int4) || weights_.has(MatrixKind::int8);
  min_rounded_keys_ = rounds ? kMinRoundedKeys : kNoLimit;
  return {};
}

Result<WeightPlan> CudaDevice::plan_weights(const Program& prefix, const Program& step, std::size_t size) const {
  const auto &first = static_cast<const CudaProgram&>(prefix), &then = static_cast<const CudaProgram&>(step);
  const auto size_of = [&](const Param& matrix) { return weights_.size_of(matrix); };
  return plan_streams({first.reads(), then.reads(), first.n_prepare(), size_of, weights_.memory()->size()}, size);
}

Precision CudaDevice::precision() const {
  if (weights_.has_codes()) return Precision::int8;
  return weights_.has(MatrixKind::bf16) ? Precision::bf16 : Precision::f32;
}
std::string CudaDevice::kernels() const {
  return precision() == Precision::f32 ? "float32" : precision_name(precision());
}

Status CudaDevice::allocate(Slots& slots) {
  std::size_t size = 0;
  for (const Slot& slot : slots.all()) size += device_aligned(slot.size());
  VLA_TRY(const std::shared_ptr<cuda::Buffer> memory, queue_->allocate(size, "inputs and cache"));
  cuda::Address place = memory->address();
  for (Slot& slot : slots.all()) slot.place = reinterpret_cast<void*>(place), place += device_aligned(slot.size());
  VLA_CHECK(queue_->fill_zeros(*memory));
  // Keeps the device alive as long as its memory.
  slots.hold(std::make_shared<std::pair<std::shared_ptr<CudaQueue>, std::shared_ptr<cuda::Buffer>>>(queue_, memory),
             size);
  return {};
}

void CudaDevice::set(const Slot& slot, const void* data, std::size_t size) {
  queue_->set(reinterpret_cast<cuda::Address>(slot.place), data, size);
}

std::shared_ptr<float[]> CudaDevice::host_memory(std::size_t n) {
  std::shared_ptr<std::byte> memory = queue_->host_memory(n * sizeof(float));
  auto* floats = reinterpret_cast<float*>(memory.get());
  return {std::move(memory), floats};
}

void CudaDevice::take(const Slot& slot, const Sent& sent) {
  queue_->take(reinterpret_cast<cuda::Address>(slot.place), static_cast<const CudaSent&>(sent), slot.size());
}

void CudaDevice::get(const Slot& slot, void* data, std::size_t size) const {
  queue_->get(data, reinterpret_cast<cuda::Address>(slot.place), size);
}

Result<std::unique_ptr<Program>> CudaDevice::lower(const Graph& graph, const LowerOptions& options) {
  if (!graph.problem().empty())
    return Error{Code::internal, "graph", "operands that fit", graph.problem(), "please report this"};
  const Target target = {.multiplier = [this](const Param& matrix) { return multiplier_of(weights_[matrix]); },
                         .norm_needs = Needs::even_rows,
                         .max_products = 1,
                         .min_rounded_keys = min_rounded_keys_,
                         .keeps_taps = true,
                         .alignment = kDeviceAlignment,
                         .groups = weights_.groups()};
  CudaLowering l({.graph = graph, .options = options, .target = target}, weights_, *queue_, ways_);
  start(l);
  std::vector<FusedOp> ops = fuse(l);
  store(l, ops);
  choose_layouts(l, std::move(ops));
  arrange(l, l.ops);
  if (!arena_ || l.arena_size > arena_->size()) {  // earlier programs keep their own arena
    VLA_TRY(arena_, queue_->allocate(l.arena_size, "working memory"));
  }
  return CudaProgram::make(l, queue_, {weights_.memory(), arena_}, model_ ? &*model_ : nullptr);
}

}  // namespace vla::lower
