// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_device.h"

#include <fmt/format.h>
#include <ggml-cpu.h>

#include <atomic>
#include <cstring>
#include <vector>

#include "ggml/ggml_packing.h"
#include "ggml/ggml_program.h"
#include "ggml/ggml_windows.h"
#include "ggml/reference.h"

namespace vla {
void GgmlDevice::FreePool::operator()(ggml_threadpool* pool) const { ggml_threadpool_free(pool); }

Result<std::unique_ptr<Device>> GgmlDevice::cpu(int n_thread) {
  set_guard();
  auto device = std::make_unique<GgmlDevice>();
  Held& held = *device->held_;
  device->n_thread_ = n_thread;
  device->text_ = fmt::format("cpu, {} thread{}", n_thread, n_thread == 1 ? "" : "s");
  held.backend.reset(ggml_backend_cpu_init());
  if (!held.backend) return Error{Code::device, "cpu", "a backend", "the system refused it"};
  ggml_threadpool_params params = ggml_threadpool_params_default(n_thread);
  params.poll = 0;  // its threads sleep between two runs
  held.pool.reset(ggml_threadpool_new(&params));
  ggml_backend_cpu_set_threadpool(held.backend.get(), held.pool.get());
  ggml_backend_cpu_set_n_threads(held.backend.get(), n_thread);
  held.memory.emplace("cpu", ggml_backend_get_default_buffer_type(held.backend.get()), nullptr);
  return std::unique_ptr<Device>(std::move(device));
}

Result<std::unique_ptr<Device>> open_reference(int n_thread) { return GgmlDevice::cpu(n_thread); }

Result<std::unique_ptr<Device>> GgmlDevice::open(ggml_backend_dev_t of, const std::string& name, bool keeps_f16,
                                                 Rounding rounding) {
  auto device = std::make_unique<GgmlDevice>();
  device->n_thread_ = 1;  // the calling thread
  device->text_ = fmt::format("{}, {}", name, ggml_backend_dev_description(of));
  device->keeps_f16_ = keeps_f16, device->rounding_ = rounding;
  Held& held = *device->held_;
  VLA_CHECK(device->guarded([&] { held.backend.reset(ggml_backend_dev_init(of, nullptr)); }));
  if (!held.backend) return Error{Code::device, name, "a device that starts", "its driver refused it"};
  held.memory.emplace(name, ggml_backend_dev_buffer_type(of), of);
  return std::unique_ptr<Device>(std::move(device));
}

/// Leaks what a lost device holds until the process ends: freeing it would raise another driver error, which a
/// destructor cannot report. After an abort in ggml, also leaks what other devices hold: the abort may have left their
/// locks held.
GgmlDevice::~GgmlDevice() {
  if (!backend()) return;
  const Status answers = guarded([&] { ggml_backend_synchronize(backend()); });
  if (answers && !ggml_aborted()) return;
  static std::atomic<Held*> kept = nullptr;
  Held* held = held_.release();
  held->next = kept.exchange(held);
}

/// The type of a parameter on the device. Matrices become float32 if the backend's products of bf16 and f16 would round
/// activations, unless rounding is requested. Table rows are widened exactly at lookup.
ggml_type GgmlDevice::resident_type(const Param& param) const {
  const ggml_type type = type_of(resident_encoding(param, rounding_).type);
  const bool kept = type == GGML_TYPE_F16 ? keeps_f16_ : type == GGML_TYPE_BF16 && rounding_ == Rounding::bf16;
  return param.storage == Storage::table || (param.storage == Storage::matrix && kept) ? type : GGML_TYPE_F32;
}

Status GgmlDevice::load(const ParamList& params, bool fill, const WeightPlan& plan) {
  VLA_CHECK(check_rounding(params, rounding_));
  memory().set_dry(!fill);
  held_->working.clear();  // memory of freed programs
  windows_.reset();
  VLA_CHECK(make_tensors(params, plan));
  if (weights_.empty()) return {};
  VLA_CHECK(give_places(plan));
  if (!fill) return {};
  VLA_CHECK(upload(params));
  return start_stream(params, plan);
}

Status GgmlDevice::make_tensors(const ParamList& params, const WeightPlan& plan) {
  const std::size_t n = params.params().size();
  groups_ = lower::groups_by_id(plan, n);
  VLA_TRY(weight_context_, make_context(n + lower::WeightStream::kWindows));
  VLA_TRY(streamed_context_, make_context(n));
  weights_.clear(), linear_text_.clear();
  int n_f32 = 0, n_f16 = 0, n_bf16 = 0;
  for (const Param& param : params.params()) {
    const ggml_type type = resident_type(param);
    if (param.storage == Storage::matrix) ++(type == GGML_TYPE_F16 ? n_f16 : type == GGML_TYPE_BF16 ? n_bf16 : n_f32);
    ggml_context* context = is_streamed(param) ? streamed_context_.get() : weight_context_.get();
    weights_.push_back(ggml_new_tensor(context, type, static_cast<int>(param.shape.size()), param.shape.data()));
    ggml_set_name(weights_.back(), param.name.c_str());
  }
  if (n_bf16 > 0) precision_ = Precision::bf16;
  for (const auto& [n_of, type] : {std::pair{n_f32, "f32"}, {n_f16, "f16"}, {n_bf16, "bf16"}})
    if (n_of > 0) linear_text_ += fmt::format("{}{} {}", linear_text_.empty() ? "ggml (" : " + ", n_of, type);
  if (!linear_text_.empty()) linear_text_ += ")";
  return {};
}

/// Places resident parameters and windows in order, and streamed matrices inside the windows.
Status GgmlDevice::give_places(const WeightPlan& plan) {
  window_tensors_.clear();
  for (int i = 0; i < lower::WeightStream::kWindows && !plan.streamed.empty(); ++i)
    window_tensors_.push_back(
        ggml_new_tensor_1d(weight_context_.get(), GGML_TYPE_I8, static_cast<std::int64_t>(plan.window)));
  VLA_TRY(weights_size_, memory().place(weight_context_.get(), "weights", &weight_memory_));
  for (std::size_t i = 0; i < plan.streamed.size(); ++i) {
    const ggml_tensor* window = window_tensors_[static_cast<std::size_t>(lower::WeightStream::window_of(i))];
    std::size_t offset = 0;
    for (const Param* matrix : plan.streamed[i]) {
      VLA_CHECK(memory().place_inside(*window, offset, weight(matrix)));
      offset += size_of(*matrix);
    }
  }
  return {};
}

/// Bytes from a matrix to the next one in its window.
std::size_t GgmlDevice::size_of(const Param& matrix) const { return memory().size_of(weight(&matrix)); }

Status GgmlDevice::upload(const ParamList& params) {
  const Content& content = *params.bundle()->content();
  lower::Packer packer;
  ReadBuffer buffer;
  for (const Param& param : params.params()) {
    if (is_streamed(param)) continue;
    ggml_tensor* tensor = weight(&param);
    std::span<const std::byte> data;
    if (param.storage == Storage::matrix) {
      lower::MatrixPlace place = place_of(param, tensor->type);
      place.put(param, buffer.take(ggml_nbytes(tensor)));
      std::vector<lower::PackPart> parts;
      lower::add_parts(param, place, parts);
      for (const lower::PackPart& part : parts)
        if (!packer.run(content, part)) return content.changed();
      data = {place.data, ggml_nbytes(tensor)};
    } else {
      VLA_TRY(data, params.bundle()->read(param.source->data, buffer));
    }
    VLA_CHECK(guarded([&] { ggml_backend_tensor_set(tensor, data.data(), 0, data.size()); }));
  }
  return {};
}

Status GgmlDevice::start_stream(const ParamList& params, const WeightPlan& plan) {
  if (plan.streamed.empty()) return {};
  VLA_TRY(std::unique_ptr<GgmlWindows> memory, GgmlWindows::open(*this, window_tensors_));
  held_->windows = memory->held();
  VLA_TRY(windows_, lower::DeviceWindows::start(
                        std::move(memory), params.bundle()->content(), plan,
                        [this](const Param& matrix) { return place_of(matrix, weight(&matrix)->type); },
                        [this](const Param& matrix) { return size_of(matrix); }));
  return {};
}

Status GgmlDevice::allocate(Slots& slots) {
  struct Placed {
    ggml_context_ptr context;
    std::shared_ptr<void> buffers;
  };
  if (slots.all().empty()) return {};
  auto placed = std::make_shared<Placed>();
  VLA_TRY(placed->context, make_context(slots.all().size()));
  for (Slot& slot : slots.all())
    slot.place = ggml_new_tensor(placed->context.get(), type_of(slot.type), 4, slot.shape.data());
  VLA_TRY(const std::size_t size, memory().place(placed->context.get(), "inputs and cache", &placed->buffers));
  slots.hold(placed, size);
  if (memory().is_dry()) return {};
  return guarded([&] {
    for (Slot& slot : slots.all()) {
      auto* tensor = static_cast<ggml_tensor*>(slot.place);
      ggml_backend_tensor_memset(tensor, 0, 0, ggml_nbytes(tensor));
    }
  });
}

Result<ggml_backend_buffer_ptr> GgmlDevice::allocate_host(std::size_t size) const {
  ggml_backend_buffer_type_t type = ggml_backend_dev_host_buffer_type(ggml_backend_get_device(backend()));
  if (type == nullptr) type = ggml_backend_cpu_buffer_type();
  ggml_backend_buffer_ptr buffer;
  VLA_CHECK(guarded([&] {
    buffer.reset(ggml_backend_buft_alloc_buffer(type, size));
    if (buffer == nullptr) throw std::bad_alloc();
  }));
  return buffer;
}

/// Returns staging memory of at least `size` bytes that keeps earlier uploads; null if memory is short.
std::byte* GgmlDevice::staging(std::size_t size) {
  ggml_backend_buffer_ptr& staging = held_->staging;
  if (staging != nullptr && size <= ggml_backend_buffer_get_size(staging.get()))
    return static_cast<std::byte*>(ggml_backend_buffer_get_base(staging.get()));
  constexpr std::size_t kRest = 65536;  // images come first, so the inputs after them fit too
  auto larger = allocate_host(size + kRest);
  if (!larger) return nullptr;
  void* to = ggml_backend_buffer_get_base(larger->get());
  if (!uploads_.empty())
    std::memcpy(to, ggml_backend_buffer_get_base(staging.get()), uploads_.back().begin + uploads_.back().size);
  staging.swap(*larger);
  return static_cast<std::byte*>(to);
}

void GgmlDevice::set(const Slot& slot, const void* data, std::size_t size) {
  if (failure_) return;
  const auto* tensor = static_cast<const ggml_tensor*>(slot.place);
  std::size_t begin = 0;
  bool follows = false;  // adjacent to the last upload, except for alignment padding
  if (!uploads_.empty()) {
    const Upload& last = uploads_.back();
    const auto distance = static_cast<std::size_t>(static_cast<const std::byte*>(tensor->data) -
                                                   static_cast<const std::byte*>(last.first->data));
    begin = last.begin + last.size;
    follows = tensor->buffer == last.first->buffer && distance >= last.size &&
              distance - last.size < ggml_backend_buft_get_alignment(memory().type());
    if (follows) begin = last.begin + distance;
  }
  std::byte* to = staging(begin + size);
  if (to == nullptr) return;
  std::memcpy(to + begin, data, size);
  if (!follows) uploads_.push_back({tensor, begin, 0});
  uploads_.back().size = begin + size - uploads_.back().begin;
}

/// Uploads the bytes of all `set` calls.
Status GgmlDevice::flush() const {
  const Status done = guarded([&] {
    for (const Upload& upload : uploads_) {
      ggml_tensor bytes = *upload.first;
      bytes.type = GGML_TYPE_I8;
      bytes.ne[0] = static_cast<std::int64_t>(upload.size), bytes.ne[1] = bytes.ne[2] = bytes.ne[3] = 1;
      bytes.nb[0] = 1, bytes.nb[1] = bytes.nb[2] = bytes.nb[3] = upload.size;
      const void* base = ggml_backend_buffer_get_base(held_->staging.get());
      ggml_backend_tensor_set(&bytes, static_cast<const std::byte*>(base) + upload.begin, 0, upload.size);
    }
  });
  uploads_.clear();
  return done;
}

void GgmlDevice::get(const Slot& slot, void* data, std::size_t size) const {
  static_cast<void>(flush());
  static_cast<void>(
      guarded([&] { ggml_backend_tensor_get(static_cast<const ggml_tensor*>(slot.place), data, 0, size); }));
}

Status GgmlDevice::failure() const { return failure_ ? Status(*failure_) : Status(); }

Status GgmlDevice::bring(const lower::Groups& groups) {
  VLA_CHECK(flush());
  return windows_->bring(groups);
}

Status GgmlDevice::launch(ggml_cgraph* graph) {
  VLA_CHECK(flush());
  ggml_status status = GGML_STATUS_FAILED;
  const auto run = [&] { status = ggml_backend_graph_compute_async(backend(), graph); };
  if (held_->pool) {
    run();
  } else {
    VLA_CHECK(guarded(run));
  }
  if (status == GGML_STATUS_ALLOC_FAILED)
    return Error{Code::out_of_memory, "graph", "", "the device ran out of memory"};
  if (status != GGML_STATUS_SUCCESS) failure_ = lost_device(text_, ggml_status_to_string(status));
  return failure();
}

Status GgmlDevice::wait() {
  return guarded([&] { ggml_backend_synchronize(backend()); });
}

Result<std::shared_ptr<ggml_gallocr>> GgmlDevice::place(ggml_cgraph* graph) {
  const auto make = [&] { return std::shared_ptr<ggml_gallocr>(ggml_gallocr_new(memory().type()), ggml_gallocr_free); };
  std::shared_ptr<ggml_gallocr> places = make();
  std::size_t size = 0;
  ggml_gallocr_reserve_n_size(places.get(), graph, nullptr, nullptr, &size);
  // Memory that programs share must be one buffer, so that no value moves.
  const bool fits = !held_->working.empty() && size <= held_->working.back().size &&
                    held_->working.back().size <= ggml_backend_buft_get_max_size(memory().type());
  if (!fits) {
    VLA_CHECK(memory().check_free(size, "working memory"));
    held_->working.push_back({make(), size});
  }
  places = held_->working.back().places;
  if (memory().is_dry()) return places;
  bool done = false;
  VLA_CHECK(guarded([&] { done = ggml_gallocr_alloc_graph(places.get(), graph); }));
  if (done) return places;
  if (!fits) held_->working.pop_back();
  return memory().refused(size, "working memory");
}

Result<std::unique_ptr<Program>> GgmlDevice::lower(const Graph& graph, const LowerOptions&) {
  if (!graph.problem().empty())
    return Error{Code::internal, "graph", "operands that fit", graph.problem(), "please report this"};
  return GgmlProgram::make(graph, *this);
}

/// No streaming on the host: its budget is that of the process, which would hold every window twice.
Result<WeightPlan> GgmlDevice::plan_weights(const Program& prefix, const Program& step, std::size_t size) const {
  if (is_host()) return Device::plan_weights(prefix, step, size);
  const auto &first = static_cast<const GgmlProgram&>(prefix), &then = static_cast<const GgmlProgram&>(step);
  return lower::plan_streams(
      {first.reads(), then.reads(), 0, [&](const Param& matrix) { return size_of(matrix); }, weights_size_}, size);
}

std::size_t GgmlDevice::working_size() const {
  std::size_t size = memory().idle_size();
  for (const Working& working : held_->working) size += working.size;
  return size;
}

}  // namespace vla
