// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Groups of matrices that come from a file while programs compute, and programs that read such matrices.
#include "lower/host/weight_stream.h"

#include <doctest/doctest.h>

#include <unistd.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>

#include "chain.h"
#include "lower/cpu/cpu_device.h"
#include "lower_case.h"

namespace weight_stream_test {

using namespace vla;
using namespace vla::lower;
using test::Chain;

namespace {

constexpr int kDepth = 96;

/// A file of groups of different sizes, each of several parts, and the windows that they go to.
class StreamedFile {
 public:
  StreamedFile(int n_group, int n_thread) {
    std::mt19937 random(7);
    std::string bytes;
    for (int group = 0; group < n_group; ++group) {
      sizes_.push_back(5000 + 37 * static_cast<std::size_t>(group));
      for (std::size_t i = 0; i < sizes_.back(); ++i) bytes += static_cast<char>(random());
    }
    std::ofstream(path_, std::ios::binary) << bytes;
    bytes_ = bytes;
    const std::shared_ptr<Content> content = *Content::open(path_);
    REQUIRE(content->seal([](std::span<const std::byte>) {}).ok());
    std::vector<std::vector<PackPart>> groups;
    std::size_t offset = 0;
    for (int group = 0; group < n_group; ++group) {
      std::byte* to = window(group);
      std::vector<PackPart>& parts = groups.emplace_back();
      for (std::size_t done = 0; done < size(group); done += 1000) {
        const std::size_t n = std::min<std::size_t>(1000, size(group) - done);
        parts.push_back({.from = content->bytes().subspan(offset + done, n), .to = to + done});
      }
      offset += size(group);
    }
    stream_ = std::move(*WeightStream::start(content, std::move(groups), n_thread));
  }
  ~StreamedFile() { std::filesystem::remove(path_); }

  WeightStream& stream() { return *stream_; }
  /// Whether the window of a group holds its bytes of the file.
  bool holds(int group) const {
    std::size_t offset = 0;
    for (int i = 0; i < group; ++i) offset += size(i);
    return std::memcmp(window(group), bytes_.data() + offset, size(group)) == 0;
  }
  void write(const std::string& bytes) const {
    std::fstream(path_, std::ios::binary | std::ios::in | std::ios::out) << bytes;
  }
  const std::string& bytes() const { return bytes_; }

 private:
  std::size_t size(int group) const { return sizes_[static_cast<std::size_t>(group)]; }
  std::byte* window(int group) const {
    return windows_.data() + WeightStream::window_of(static_cast<std::size_t>(group)) * 8192;
  }

  const std::string path_ =
      (std::filesystem::temp_directory_path() / ("stream-" + std::to_string(::getpid()))).string();
  std::string bytes_;
  std::vector<std::size_t> sizes_;
  Memory windows_ = *Memory::allocate(WeightStream::kWindows * 8192, "windows");
  std::unique_ptr<WeightStream> stream_;  // goes before its windows
};

}  // namespace

TEST_CASE("groups come in their order, round and round") {
  for (const int n_thread : {1, 3})
    for (const int n_group : {4, 6, 11}) {
      CAPTURE(n_group);
      StreamedFile file(n_group, n_thread);
      for (int round = 0; round < 20; ++round)
        for (int group = 0; group < n_group; ++group) {
          REQUIRE(file.stream().bring(group, group).ok());
          CHECK(file.holds(group));
          file.stream().release(group);
        }
    }
}

TEST_CASE("two groups stand side by side") {
  StreamedFile file(8, 2);
  for (int round = 0; round < 10; ++round)
    for (int group = 0; group + 1 < 8; ++group) {
      REQUIRE(file.stream().bring(group, group + 1).ok());
      CHECK(file.holds(group));
      CHECK(file.holds(group + 1));
    }
}

TEST_CASE("groups that are wanted in any order come") {
  std::mt19937 random(3);
  for (const int n_thread : {1, 4}) {
    StreamedFile file(10, n_thread);
    for (int i = 0; i < 500; ++i) {
      const int first = static_cast<int>(random() % 10), last = std::min(9, first + static_cast<int>(random() % 3));
      REQUIRE(file.stream().bring(first, last).ok());
      for (int group = first; group <= last; ++group) CHECK(file.holds(group));
      if (random() % 2 == 0) file.stream().release(last);
    }
  }
}

TEST_CASE("a file that changes while it is read is refused, and read again where its bytes are back") {
  StreamedFile file(9, 2);
  REQUIRE(file.stream().bring(0, 0).ok());
  file.write(std::string(file.bytes().size(), 'x'));
  Status status;
  for (int group = 1; group < 9 && status.ok(); ++group) status = file.stream().bring(group, group);
  REQUIRE_FALSE(status.ok());
  CHECK(status.error().code == Code::bad_bundle);
  file.write(file.bytes());
  for (int group = 0; group < 9; ++group) {
    REQUIRE(file.stream().bring(group, group).ok());
    CHECK(file.holds(group));
  }
}

TEST_CASE("matrices that are streamed give the bits of resident ones") {
  for (const KernelSet& set : test::lowered_kernels())
    for (const DType type : {DType::f32, DType::bf16})
      for (const int n_thread : {1, 2, 4}) {
        CAPTURE(set.name);
        CAPTURE(n_thread);
        const Chain chain(type, kDepth);
        const auto open = [&] {
          return std::move(*CpuDevice::open(n_thread, *Arithmetic::on_cpu(set.name, this_cpu())));
        };
        test::ChainAnswers resident(chain, open(), false), streamed(chain, open(), true);
        for (int seed = 0; seed < 4; ++seed) CHECK(streamed.run(seed) == resident.run(seed));
      }
}

TEST_CASE("a plan keeps what there is room for, spread evenly") {
  const Chain chain(DType::f32, kDepth);
  const std::unique_ptr<Device> device = std::move(*CpuDevice::open(1, *Arithmetic::on_cpu("portable", this_cpu())));
  REQUIRE(device->load(chain.list(), false).ok());
  Slots slots;
  Slot *x = slots.add_f32({kDepth, 5, 1, 1}), *y = slots.add_f32({kDepth, 5, 1, 1});
  REQUIRE(device->allocate(slots).ok());
  const auto prefix = chain.lower(*device, slots, x, y, 0, Chain::kLayers - 1),
             step = chain.lower(*device, slots, y, x, 0, 0);
  const std::size_t all = device->weights_size(), matrix = all / Chain::kLayers;
  CHECK(device->plan_weights(*prefix, *step, all)->streamed.empty());
  const WeightPlan some = *device->plan_weights(*prefix, *step, all - 1);
  CHECK(some.streamed.size() == 4);
  CHECK(some.window == matrix);
  CHECK(some.smallest == all - (Chain::kLayers - 1 - 3) * matrix);
  CHECK(some.n_read == 4 * kDepth * kDepth * sizeof(float));
  const WeightPlan most = *device->plan_weights(*prefix, *step, some.smallest);
  CHECK(most.streamed.size() == Chain::kLayers - 1);
  CHECK(device->plan_weights(*prefix, *step, 0)->streamed.size() == Chain::kLayers - 1);
  for (const auto& group : most.streamed) CHECK(group.front() != &chain.list().params().front());  // the step's
}

}  // namespace weight_stream_test
