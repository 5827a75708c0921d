// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_memory.h"

#include <doctest/doctest.h>
#include <ggml-cpu.h>

#include <limits>

#include "devices/devices.h"

namespace ggml_memory_test {

using namespace vla;

namespace {

/// Tensors of these sizes without a place.
ggml_context_ptr tensors(std::initializer_list<std::int64_t> sizes) {
  auto context = make_context(sizes.size());
  REQUIRE(context.ok());
  for (const std::int64_t size : sizes) ggml_new_tensor_1d(context->get(), GGML_TYPE_F32, size);
  return std::move(*context);
}

void* place_of(const ggml_context_ptr& context) { return ggml_get_first_tensor(context.get())->data; }

}  // namespace

TEST_CASE("memory that was given back is used again, for what fits without much waste") {
  GgmlMemory memory("cpu", ggml_backend_cpu_buffer_type(), nullptr);
  std::shared_ptr<void> holder, other;
  const auto large = tensors({100000, 7}), small = tensors({10}), again = tensors({90000});
  const auto size = memory.place(large.get(), "here", &holder);
  REQUIRE(size.ok());
  CHECK(*size >= 4 * 100007);
  void* const place = place_of(large);
  holder.reset();
  REQUIRE(memory.place(small.get(), "here", &other).ok());
  CHECK(place_of(small) != place);
  REQUIRE(memory.place(again.get(), "here", &holder).ok());
  CHECK(place_of(again) == place);
}

TEST_CASE("a dry memory has the same sizes and takes nothing") {
  GgmlMemory memory("cpu", ggml_backend_cpu_buffer_type(), nullptr), dry = memory;
  dry.set_dry(true);
  std::shared_ptr<void> holder, nothing;
  const auto real = tensors({1000, 3, 70}), counted = tensors({1000, 3, 70});
  const auto taken = memory.place(real.get(), "here", &holder), predicted = dry.place(counted.get(), "here", &nothing);
  REQUIRE(taken.ok());
  REQUIRE(predicted.ok());
  CHECK(*taken == *predicted);
  CHECK(ggml_get_first_tensor(counted.get())->buffer == nullptr);
}

TEST_CASE("more than the device has free is out_of_memory with both sizes") {
  const ggml_backend_ptr backend(ggml_backend_cpu_init());
  const GgmlMemory memory("vulkan:0", ggml_backend_cpu_buffer_type(), ggml_backend_get_device(backend.get()));
  CHECK(memory.check_free(1, "weights").ok());
  const Status refused = memory.check_free(std::numeric_limits<std::size_t>::max(), "weights");
  REQUIRE(!refused.ok());
  CHECK(refused.error().code == Code::out_of_memory);
  CHECK(refused.error().message().starts_with("weights: expected 18446744073709.6 MB free on vulkan:0, found "));
}

TEST_CASE("names of devices") {
  CHECK(DeviceName::parse("")->text() == "cpu");
  CHECK(DeviceName::parse("cpu")->text() == "cpu");
  CHECK(DeviceName::parse("vulkan")->text() == "vulkan:0");
  CHECK(DeviceName::parse("cuda:12")->text() == "cuda:12");
  for (const char* name : {"vulkan:", "vulkan:1x", "vulkan:-1", "cpu:0", "CUDA", ":1", "vulkan:0:1", " cuda"}) {
    CAPTURE(name);
    REQUIRE(!DeviceName::parse(name).ok());
    CHECK(DeviceName::parse(name).error().code == Code::usage);
  }
}

}  // namespace ggml_memory_test
