// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_memory.h"

#include <fmt/format.h>
#include <ggml-alloc.h>

#include <algorithm>
#include <cstdint>
#include <iterator>

#include "ggml/guard.h"

namespace vla {
namespace {

/// A placeholder address for tensors without memory. ggml would place a tensor whose address is null.
void* const kNowhere = reinterpret_cast<void*>(std::uintptr_t{4096});

std::string size_text(std::size_t bytes) {
  const auto size = static_cast<double>(bytes);
  return size >= 1e6 ? fmt::format("{:.1f} MB", 1e-6 * size) : fmt::format("{:.1f} kB", 1e-3 * size);
}

}  // namespace

Result<ggml_context_ptr> make_context(std::size_t n, std::size_t extra) {
  ggml_context_ptr context(
      ggml_init({.mem_size = n * ggml_tensor_overhead() + extra, .mem_buffer = nullptr, .no_alloc = true}));
  if (context) return context;
  return Error{Code::out_of_memory, "graph", "", "the system refused the allocation", "free memory"};
}

Error GgmlMemory::refused(std::size_t size, const char* what) const {
  return {Code::out_of_memory, what, fmt::format("{} on {}", size_text(size), name_),
          "the device refused the allocation", "free memory or use a smaller model"};
}

/// A tensor must fit into one buffer. Backends state a preferred buffer size and accept larger ones up to the driver's
/// limit.
Error GgmlMemory::refused(const Part& part, const char* what) const {
  const std::size_t most = ggml_backend_buft_get_max_size(type_);
  if (part.size <= most) return refused(part.size, what);
  return {Code::unsupported, part.tensors.front()->name,
          fmt::format("at most {}, a buffer of {}", size_text(most), name_), size_text(part.size),
          "use another device"};
}

Status GgmlMemory::check_free(std::size_t size, const char* what) const {
  if (device_ == nullptr || dry_) return {};
  std::size_t free = 0, total = 0;
  VLA_CHECK(guarded(name_, [&] { ggml_backend_dev_memory(device_, &free, &total); }));
  free += idle_size();
  if (size <= free) return {};
  return Error{Code::out_of_memory, what, fmt::format("{} free on {}", size_text(size), name_),
               fmt::format("{} of {}", size_text(free), size_text(total)),
               "free memory of the device or use a smaller model"};
}

std::size_t GgmlMemory::idle_size() const {
  std::size_t size = 0;
  for (const Buffer& buffer : *kept_) size += buffer.size;
  return size;
}

/// Reuses a returned buffer that fits without much waste, or allocates one.
GgmlMemory::Buffer GgmlMemory::take(std::size_t size) const {
  const auto fits = [&](const Buffer& buffer) { return buffer.size >= size && buffer.size <= 2 * size + 65536; };
  const auto found = std::find_if(kept_->begin(), kept_->end(), fits);
  if (found == kept_->end())
    return {size, ggml_backend_buffer_ptr(dry_ ? nullptr : ggml_backend_buft_alloc_buffer(type_, size))};
  Buffer buffer = std::move(*found);
  kept_->erase(found);
  return buffer;
}

Result<std::size_t> GgmlMemory::place(ggml_context* tensors, const char* what, std::shared_ptr<void>* holder) {
  const std::vector<Part> parts = cut(tensors);
  std::size_t wanted = 0, total = 0;
  for (const Part& part : parts) wanted += part.size;
  VLA_CHECK(check_free(wanted, what));
  const std::shared_ptr<Buffers> buffers(new Buffers, [kept = kept_](Buffers* given) {
    std::move(given->begin(), given->end(), std::back_inserter(*kept));
    delete given;
  });
  *holder = buffers;
  for (const Part& part : parts) {
    VLA_CHECK(guarded(name_, [&] { buffers->push_back(take(part.size)); }));
    total += buffers->back().size;
    if (dry_) {
      for (ggml_tensor* tensor : part.tensors) tensor->data = kNowhere;
      continue;
    }
    ggml_backend_buffer_t buffer = buffers->back().memory.get();
    if (buffer == nullptr) {
      buffers->pop_back();
      return refused(part, what);
    }
    ggml_tallocr places = ggml_tallocr_new(buffer);
    VLA_CHECK(guarded(name_, [&] {
      for (ggml_tensor* tensor : part.tensors) ggml_tallocr_alloc(&places, tensor);
    }));
  }
  return total;
}

Status GgmlMemory::place_inside(const ggml_tensor& larger, std::size_t offset, ggml_tensor* tensor) const {
  if (dry_) {
    tensor->data = kNowhere;
    return {};
  }
  return guarded(
      name_, [&] { ggml_backend_tensor_alloc(larger.buffer, tensor, static_cast<std::byte*>(larger.data) + offset); });
}

std::size_t GgmlMemory::size_of(const ggml_tensor* tensor) const {
  return GGML_PAD(ggml_backend_buft_get_alloc_size(type_, tensor), ggml_backend_buft_get_alignment(type_));
}

/// Fills each buffer with as many tensors as fit, in order.
std::vector<GgmlMemory::Part> GgmlMemory::cut(ggml_context* tensors) const {
  const std::size_t most = ggml_backend_buft_get_max_size(type_);
  std::vector<Part> parts;
  for (ggml_tensor* t = ggml_get_first_tensor(tensors); t != nullptr; t = ggml_get_next_tensor(tensors, t)) {
    const std::size_t size = size_of(t);
    if (parts.empty() || parts.back().size + size > most) parts.emplace_back();
    parts.back().size += size;
    parts.back().tensors.push_back(t);
  }
  return parts;
}

}  // namespace vla
