// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Groups of matrices that come from a file while programs compute, and programs that read such matrices.
#include "lower/cpu/weight_stream.h"

#include <doctest/doctest.h>

#include <unistd.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>

#include "lower/cpu/cpu_device.h"
#include "lower_case.h"

using namespace vla;
using namespace vla::lower;

namespace {

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

namespace {

constexpr int kDepth = 96, kLayers = 9;

/// A chain of layers as the prefix, and a product as the step, whose matrix is the prefix's last as well.
class Chain {
 public:
  explicit Chain(DType type) : set_(pieces(type)) {
    for (int i = 0; i < kLayers; ++i) matrices_.push_back(set_.scope().matrix(name(i), kDepth, kDepth));
  }
  const ParamList& list() const { return set_.list(); }

  /// x through the layers from `first` to `last`.
  std::unique_ptr<Program> lower(Device& device, Slots& slots, const Slot* x, Slot* y, int first, int last) const {
    Graph g(slots);
    Tensor at = g.input(x);
    for (int i = first; i <= last; ++i)
      at = g.add(op::Activate{Activation::gelu_tanh},
                 {g.add(op::Linear{matrices_[static_cast<std::size_t>(i)], nullptr}, {at})});
    g.write(at, y);
    auto program = device.lower(g, {});
    REQUIRE(program.ok());
    return std::move(*program);
  }

 private:
  static std::string name(int i) { return "layer." + std::to_string(i); }
  static std::vector<test::ParamSet::Piece> pieces(DType type) {
    std::vector<test::ParamSet::Piece> all;
    for (int i = 0; i < kLayers; ++i)
      all.push_back(
          {name(i), {kDepth, kDepth}, test::ramp(kDepth * kDepth, 0.1f + 0.02f * static_cast<float>(i)), type});
    return all;
  }
  test::ParamSet set_;
  std::vector<const Param*> matrices_;
};

/// What programs on a device answer, with all matrices in memory or as few as it can.
class Answers {
 public:
  Answers(const Chain& chain, const std::string& kernels, int n_thread, bool streams) : chain_(chain) {
    device_ = std::move(*CpuDevice::open(n_thread, *Arithmetic::on_cpu(kernels, this_cpu())));
    WeightPlan plan;
    if (streams) {
      REQUIRE(device_->load(chain.list(), false).ok());
      make_programs();
      plan = *device_->plan_weights(*prefix_, *step_, 0);
      resident_ = device_->weights_size();
      CHECK(plan.streamed.size() == kLayers - 1);
      CHECK(plan.n_read > 0);
    }
    REQUIRE(device_->load(chain.list(), true, plan).ok());
    make_programs();
    if (streams) {
      CHECK(device_->weights_size() < resident_);
      CHECK(device_->weights_size() == plan.smallest);
    }
  }

  std::vector<float> run(int seed) {
    std::vector<float> rows = test::ramp(kDepth * 5, 1.0f + static_cast<float>(seed));
    device_->set(*x_, rows.data(), x_->size());
    REQUIRE(prefix_->run().ok());
    for (int k = 0; k < 3; ++k) REQUIRE(step_->run().ok());
    std::vector<float> all = device_->get(*z_);
    REQUIRE(backward_->run().ok());  // another order than the plan's
    for (const float value : device_->get(*z_)) all.push_back(value);
    return all;
  }

 private:
  void make_programs() {
    slots_ = Slots();
    x_ = slots_.add_f32({kDepth, 5, 1, 1}), y_ = slots_.add_f32({kDepth, 5, 1, 1}),
    z_ = slots_.add_f32({kDepth, 5, 1, 1});
    REQUIRE(device_->allocate(slots_).ok());
    prefix_ = chain_.lower(*device_, slots_, x_, y_, 0, kLayers - 1);
    step_ = chain_.lower(*device_, slots_, y_, z_, kLayers - 1, kLayers - 1);
    backward_ = chain_.lower(*device_, slots_, x_, z_, 2, 4);
  }

  const Chain& chain_;
  std::unique_ptr<Device> device_;
  Slots slots_;
  Slot *x_ = nullptr, *y_ = nullptr, *z_ = nullptr;
  std::unique_ptr<Program> prefix_, step_, backward_;
  std::size_t resident_ = 0;
};

}  // namespace

TEST_CASE("matrices that are streamed give the bits of resident ones") {
  for (const KernelSet& set : test::lowered_kernels())
    for (const DType type : {DType::f32, DType::bf16})
      for (const int n_thread : {1, 2, 4}) {
        CAPTURE(set.name);
        CAPTURE(n_thread);
        const Chain chain(type);
        Answers resident(chain, set.name, n_thread, false), streamed(chain, set.name, n_thread, true);
        for (int seed = 0; seed < 4; ++seed) CHECK(streamed.run(seed) == resident.run(seed));
      }
}

TEST_CASE("a plan keeps what there is room for, spread evenly") {
  const Chain chain(DType::f32);
  const std::unique_ptr<Device> device = std::move(*CpuDevice::open(1, *Arithmetic::on_cpu("portable", this_cpu())));
  REQUIRE(device->load(chain.list(), false).ok());
  Slots slots;
  Slot *x = slots.add_f32({kDepth, 5, 1, 1}), *y = slots.add_f32({kDepth, 5, 1, 1});
  REQUIRE(device->allocate(slots).ok());
  const auto prefix = chain.lower(*device, slots, x, y, 0, kLayers - 1), step = chain.lower(*device, slots, y, x, 0, 0);
  const std::size_t all = device->weights_size(), matrix = all / kLayers;
  CHECK(device->plan_weights(*prefix, *step, all)->streamed.empty());
  const WeightPlan some = *device->plan_weights(*prefix, *step, all - 1);
  CHECK(some.streamed.size() == 4);
  CHECK(some.window == matrix);
  CHECK(some.smallest == all - (kLayers - 1 - 3) * matrix);
  CHECK(some.n_read == 4 * kDepth * kDepth * sizeof(float));
  const WeightPlan most = *device->plan_weights(*prefix, *step, some.smallest);
  CHECK(most.streamed.size() == kLayers - 1);
  CHECK(device->plan_weights(*prefix, *step, 0)->streamed.size() == kLayers - 1);
  for (const auto& group : most.streamed) CHECK(group.front() != &chain.list().params().front());  // the step's
}
