// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// CUDA's words and the instructions of cuda/kernels/device.h for the host's compiler; included before every kernel.
/// The threads of a block are fibers of one thread of the operating system, which take turns where they wait for each
/// other. What a warp does as one is computed by the lane that comes last.
#define VLA_EMULATED_DEVICE 1

#include <array>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>

#define __shared__
#define VLA_DEVICE inline
#define VLA_EARLY_KERNEL VLA_KERNEL
#define VLA_KERNEL(name, threads, blocks, Job)                                                             \
  static void name##_kernel(const Job& job);                                                               \
  static const ::vla::test::cuda::Entry name##_entry(                                                      \
      #name, threads, sizeof(Job), [](const void* job) { name##_kernel(*static_cast<const Job*>(job)); }); \
  static void name##_kernel(const Job& job)

struct uint3 {
  unsigned x = 0, y = 0, z = 0;
};
struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
struct alignas(8) uint2 {
  unsigned x, y;
};
struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
inline uint3 threadIdx, blockIdx, blockDim, gridDim;

namespace vla::test::cuda {

/// A number of 16 bits: its exponent is widened by a product, which also makes subnormals right.
inline float f16_to_float(std::uint32_t half) {
  const auto size = std::bit_cast<float>((half & 0x7fff) << 13) * 0x1p112f;
  const bool finite = (half & 0x7c00) != 0x7c00;
  const auto bits = finite ? std::bit_cast<std::uint32_t>(size) : 0x7f800000 | (half & 0x3ff) << 13;
  return std::bit_cast<float>(bits | (half & 0x8000) << 16);
}

/// A kernel that the host's compiler made.
struct Entry {
  Entry(const char* name, int max_thread, std::size_t job_size, void (*run)(const void* job));
  const char* name;
  int max_thread;
  std::size_t job_size;
  void (*run)(const void* job);
};
const Entry* find_entry(const char* name);

/// Blocks, of which each `cluster` that follow each other in z are one cluster.
struct Extent {
  unsigned x, y, z, cluster = 1;
};
/// Runs all clusters, one after the other. Throws Fault.
void run_entry(const Entry& entry, Extent grid, unsigned n_thread, std::size_t shared, const void* job);

// What kernels call.

[[noreturn]] void fault(const char* what);
void barrier();
void cluster_barrier(bool releases);
std::byte* shared_memory();
void check_shared(const std::byte* p, std::size_t size, bool writes);
/// Where a block of the cluster has what this block has at p, to read it.
const std::byte* of_block(const std::byte* p, std::size_t size, int rank);
void copy_async(std::byte* to, const void* from, std::size_t size);
void commit_copies();
void wait_copies(std::size_t n_left);
unsigned shared_address(const std::byte* p);
void fence_async_proxy();
void begin_mbarrier(std::byte* mbarrier, int n_arrival);
void fence_mbarriers();
void arrive(std::byte* mbarrier, int n_byte);
void arrive_at_block(std::byte* mbarrier, int rank);
void wait_mbarrier(std::byte* mbarrier, unsigned parity);
/// Copies a box of a tensor map, from a place on, to those blocks of the cluster whose bits are set; 0: this one.
void copy_box(std::byte* to, const void* map, std::span<const int> place, std::byte* mbarrier, unsigned blocks);

/// A product of a warpgroup: sums[64][n] (+)= a[64][depth] * b[n][depth], or b[depth][n] if it is transposed.
struct WgmmaProduct {
  enum Kind { bf16, s8 } kind = bf16;
  int n = 0;
  std::uint64_t a = 0, b = 0;  // matrix descriptors; a is none if it is in registers
  bool adds = false, a_in_registers = false, b_transposed = false;

  int depth() const { return kind == bf16 ? 16 : 32; }
  friend bool operator==(const WgmmaProduct&, const WgmmaProduct&) = default;
};

/// What lanes that meet hold out: registers to read, and where results go.
struct Meeting {
  enum Kind { kSync, kShuffle, kMatrices, kTransposed, kS8, kBf16, kWgmma, kWgmmaFence, kWgmmaCommit, kWgmmaWait } kind;
  const std::uint32_t *a = nullptr, *b = nullptr;
  std::uint32_t* to = nullptr;  // of products also the sums so far
  const std::byte* row = nullptr;
  int lane = 0;  // whose value a shuffle takes
  const WgmmaProduct* product = nullptr;
  std::size_t n_left = 0;  // groups of products that a wait leaves
};
void meet(Meeting& mine);
int lane_index();

}  // namespace vla::test::cuda

inline void __syncthreads() { vla::test::cuda::barrier(); }
inline void __syncwarp() {
  vla::test::cuda::Meeting mine = {vla::test::cuda::Meeting::kSync};
  vla::test::cuda::meet(mine);
}

namespace vla::cuda::dev {

using test::cuda::commit_copies, test::cuda::shared_memory, test::cuda::shared_address, test::cuda::fence_async_proxy;
inline void wait_for_earlier() {}
inline void let_next_begin() {}
template <class T>
T read(const std::byte* p) {
  test::cuda::check_shared(p, sizeof(T), false);
  T value;
  std::memcpy(&value, p, sizeof(T));
  return value;
}
template <class T>
void write(std::byte* p, const T& value) {
  test::cuda::check_shared(p, sizeof(T), true);
  std::memcpy(p, &value, sizeof(T));
}
inline void copy_async(std::byte* to, const void* from, int size) {
  test::cuda::copy_async(to, from, static_cast<std::size_t>(size));
}
template <int kLeft>
void wait_copies() {
  test::cuda::wait_copies(kLeft);
}
using test::cuda::arrive_at_block, test::cuda::begin_mbarrier, test::cuda::fence_mbarriers, test::cuda::wait_mbarrier;
inline void arrive(std::byte* mbarrier) { test::cuda::arrive(mbarrier, 0); }
inline void arrive_expecting(std::byte* mbarrier, int n_byte) { test::cuda::arrive(mbarrier, n_byte); }
template <class Map>
void copy_box(std::byte* to, const Map& map, int column, int row, std::byte* mbarrier) {
  test::cuda::copy_box(to, &map, std::array{column, row}, mbarrier, 0);
}
template <class Map>
void copy_box_of_head(std::byte* to, const Map& map, int column, int head, int token, int batch, std::byte* mbarrier) {
  test::cuda::copy_box(to, &map, std::array{column, head, token, batch}, mbarrier, 0);
}
template <class Map>
void copy_box_to_blocks(std::byte* to, const Map& map, int column, int row, std::byte* mbarrier, unsigned blocks) {
  test::cuda::copy_box(to, &map, std::array{column, row}, mbarrier, blocks);
}
inline void meet_cluster() { test::cuda::cluster_barrier(true); }
inline void leave_cluster() { test::cuda::cluster_barrier(false); }
inline uint4 read_of_block(const std::byte* p, int rank) {
  uint4 value;
  std::memcpy(&value, test::cuda::of_block(p, sizeof(value), rank), sizeof(value));
  return value;
}
inline void load_matrices(unsigned (&to)[4], const std::byte* from) {
  test::cuda::Meeting mine = {test::cuda::Meeting::kMatrices, nullptr, nullptr, to, from};
  test::cuda::meet(mine);
}
inline void load_transposed(unsigned (&to)[4], const std::byte* from) {
  test::cuda::Meeting mine = {test::cuda::Meeting::kTransposed, nullptr, nullptr, to, from};
  test::cuda::meet(mine);
}
inline void multiply_s8(int (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1) {
  const unsigned b[2] = {b0, b1};
  test::cuda::Meeting mine = {test::cuda::Meeting::kS8, a, b, reinterpret_cast<unsigned*>(sum)};
  test::cuda::meet(mine);
}
inline void multiply_bf16(float (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1) {
  const unsigned b[2] = {b0, b1};
  unsigned bits[4];
  std::memcpy(bits, sum, sizeof(bits));
  test::cuda::Meeting mine = {test::cuda::Meeting::kBf16, a, b, bits};
  test::cuda::meet(mine);
  std::memcpy(sum, bits, sizeof(bits));
}
template <class T>
void wgmma(const test::cuda::WgmmaProduct& product, T* sum, const unsigned* a = nullptr) {
  test::cuda::Meeting mine = {test::cuda::Meeting::kWgmma, a};
  mine.to = reinterpret_cast<std::uint32_t*>(sum), mine.product = &product;
  test::cuda::meet(mine);
}
template <int kN>
void wgmma_bf16(float (&sum)[kN / 2], std::uint64_t a, std::uint64_t b, bool adds) {
  wgmma({test::cuda::WgmmaProduct::bf16, kN, a, b, adds}, sum);
}
template <int kN>
void wgmma_bf16(float (&sum)[kN / 2], const unsigned (&a)[4], std::uint64_t b) {
  wgmma({test::cuda::WgmmaProduct::bf16, kN, 0, b, true, true, true}, sum, a);
}
template <int kN>
void wgmma_s8(int (&sum)[kN / 2], const unsigned (&a)[4], std::uint64_t b, bool adds) {
  wgmma({test::cuda::WgmmaProduct::s8, kN, 0, b, adds, true}, sum, a);
}
inline void wgmma_fence() {
  test::cuda::Meeting mine = {test::cuda::Meeting::kWgmmaFence};
  test::cuda::meet(mine);
}
inline void wgmma_commit() {
  test::cuda::Meeting mine = {test::cuda::Meeting::kWgmmaCommit};
  test::cuda::meet(mine);
}
template <int kLeft>
void wgmma_wait() {
  test::cuda::Meeting mine = {test::cuda::Meeting::kWgmmaWait};
  mine.n_left = kLeft;
  test::cuda::meet(mine);
}
template <class T, int kCount>
void pin(T (&)[kCount]) {}
template <int kLeft, class T, int kCount>
void wgmma_wait_for(T (&)[kCount]) {
  wgmma_wait<kLeft>();
}
template <class T, int kCount>
void wgmma_wait_all(T (&)[kCount]) {
  wgmma_wait<0>();
}
inline int dot4(unsigned a, unsigned b, int sum) {
  for (int i = 0; i < 32; i += 8) sum += static_cast<std::int8_t>(a >> i) * static_cast<std::int8_t>(b >> i);
  return sum;
}
template <class T>
T shuffle(T value, int lane) {
  const auto bits = std::bit_cast<unsigned>(value);
  unsigned other = 0;
  test::cuda::Meeting mine = {test::cuda::Meeting::kShuffle, &bits, nullptr, &other, nullptr, lane};
  test::cuda::meet(mine);
  return std::bit_cast<T>(other);
}
template <class T>
T shuffle_xor(T value, int mask) {
  return shuffle(value, test::cuda::lane_index() ^ mask);
}

// Kernels are compiled with -ffp-contract=off.
inline float multiply(float a, float b) { return a * b; }
inline float add(float a, float b) { return a + b; }
inline float divide(float a, float b) { return a / b; }
inline float multiply_add(float a, float b, float c) { return std::fma(a, b, c); }
inline int bits_of(float x) { return std::bit_cast<int>(x); }
inline float float_of(int bits) { return std::bit_cast<float>(bits); }
inline unsigned to_bf16(float low, float high) {
  const auto half = [](float x) {
    const auto bits = std::bit_cast<unsigned>(x);
    return std::isnan(x) ? 0x7fffU : (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
  };
  return half(low) | half(high) << 16;
}
inline float from_f16(unsigned bits) { return test::cuda::f16_to_float(bits); }
inline float reciprocal(float x) { return 1 / x; }
inline float power_of_two(float x) { return exp2f(x); }

}  // namespace vla::cuda::dev
