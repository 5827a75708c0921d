// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// The instructions beyond CUDA C++ that kernels use. For the host's compiler tests/cuda/emulation.h replaces this
/// file; the build includes it before every kernel. Source of layouts and operands: PTX ISA 9.0.
#include <cstddef>
#include <cstdint>

#include "cuda/kernels/launch.h"

#ifdef __CUDACC__

#define VLA_DEVICE __device__ __forceinline__
/// Defines a kernel with one parameter, `job`, under an unmangled name: at most `threads` threads per block, registers
/// for `blocks` blocks.
#define VLA_KERNEL(name, threads, blocks, Job)      \
  VLA_DEVICE void name##_body(const Job& job);      \
  VLA_EARLY_KERNEL(name, threads, blocks, Job) {    \
    dev::wait_for_earlier(), dev::let_next_begin(); \
    name##_body(job);                               \
  }                                                 \
  VLA_DEVICE void name##_body(const Job& job)
/// The same for a kernel that calls wait_for_earlier() and let_next_begin() itself. Before wait_for_earlier() it may
/// read only weights and must not write.
#define VLA_EARLY_KERNEL(name, threads, blocks, Job) \
  extern "C" __global__ void __launch_bounds__(threads, blocks) name(const __grid_constant__ Job job)

namespace vla::cuda::dev {

/// Shared memory whose size the launch sets.
VLA_DEVICE std::byte* shared_memory() {
  extern __shared__ __align__(1024) std::byte bytes[];
  return bytes;
}
/// Waits until the stream's previous kernel has ended and its writes are visible. Every thread must call it before it
/// reads results of kernels or writes. On devices before Hopper, kernels do not overlap.
VLA_DEVICE void wait_for_earlier() {
#if __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}
/// Once all blocks have called it, the stream's next kernel may begin and run up to its wait_for_earlier().
/// A kernel of many blocks calls it when little is left to do, because the next kernel's blocks crowd onto the
/// multiprocessors that become free first.
VLA_DEVICE void let_next_begin() {
#if __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}
VLA_DEVICE unsigned shared_address(const void* p) { return static_cast<unsigned>(__cvta_generic_to_shared(p)); }

/// Access to shared memory. Kernels use nothing else for it, so that the emulation sees every access.
template <class T>
VLA_DEVICE T read(const std::byte* p) {
  return *reinterpret_cast<const T*>(p);
}
template <class T>
VLA_DEVICE void write(std::byte* p, const T& value) {
  *reinterpret_cast<T*>(p) = value;
}

/// Copies `size` bytes, at most 16, from global to shared memory asynchronously, padded with zeros to 16.
VLA_DEVICE void copy_async(std::byte* to, const void* from, int size) {
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(shared_address(to)), "l"(from), "r"(size)
               : "memory");
}
VLA_DEVICE void commit_copies() { asm volatile("cp.async.commit_group;" ::: "memory"); }
/// Waits until all but the latest kLeft groups of this thread have arrived.
template <int kLeft>
VLA_DEVICE void wait_copies() {
  asm volatile("cp.async.wait_group %0;" ::"n"(kLeft) : "memory");
}

/// Loads four matrices of 8 rows of 16 bytes. Lane 8 j + i passes the address of row i of matrix j; lane l gets bytes 4
/// (l % 4) to 4 (l % 4) + 3 of row l / 4 of each.
VLA_DEVICE void load_matrices(unsigned (&to)[4], const std::byte* from) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(shared_address(from))
               : "memory");
}
/// The same for transposed matrices of 16-bit elements.
VLA_DEVICE void load_transposed(unsigned (&to)[4], const std::byte* from) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(shared_address(from))
               : "memory");
}

/// sum[16, 8] += a[16, 32] * b[32, 8] of signed bytes, exactly.
VLA_DEVICE void multiply_s8(int (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1) {
  asm("mma.sync.aligned.m16n8k32.row.col.s32.s8.s8.s32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
      : "+r"(sum[0]), "+r"(sum[1]), "+r"(sum[2]), "+r"(sum[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}
/// sum[16, 8] += a[16, 16] * b[16, 8] of bf16, with sums in float32.
VLA_DEVICE void multiply_bf16(float (&sum)[4], const unsigned (&a)[4], unsigned b0, unsigned b1) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
      "%3};"
      : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}
/// sum + the dot product of the four signed bytes of a and b.
VLA_DEVICE int dot4(unsigned a, unsigned b, int sum) { return __dp4a(static_cast<int>(a), static_cast<int>(b), sum); }

/// The value of the lane whose index differs in the bits of `mask`.
template <class T>
VLA_DEVICE T shuffle_xor(T value, int mask) {
  return __shfl_xor_sync(0xffffffffU, value, mask);
}
template <class T>
VLA_DEVICE T shuffle(T value, int lane) {
  return __shfl_sync(0xffffffffU, value, lane);
}

// Operations that are rounded separately, for results equal to another machine's to the bit: nvcc would fuse a product
// and a sum.
VLA_DEVICE float multiply(float a, float b) { return __fmul_rn(a, b); }
VLA_DEVICE float add(float a, float b) { return __fadd_rn(a, b); }
VLA_DEVICE float divide(float a, float b) { return __fdiv_rn(a, b); }
VLA_DEVICE float multiply_add(float a, float b, float c) { return __fmaf_rn(a, b, c); }
VLA_DEVICE int bits_of(float x) { return __float_as_int(x); }
VLA_DEVICE float float_of(int bits) { return __int_as_float(bits); }
/// Two values rounded to bf16, the first in the lower half.
VLA_DEVICE unsigned to_bf16(float low, float high) {
  unsigned pair;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(high), "f"(low));
  return pair;
}
/// Widens a 16-bit float exactly.
VLA_DEVICE float from_f16(unsigned bits) {
  float x;
  asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(static_cast<unsigned short>(bits)));
  return x;
}
/// 1 / x with a relative error of 2^-23; zero for x above 2^126, and for infinity.
VLA_DEVICE float reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
/// 2^x with a relative error of 2^-22; zero for minus infinity and below the normal floats.
VLA_DEVICE float power_of_two(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

}  // namespace vla::cuda::dev

#elif !defined(VLA_EMULATED_DEVICE)
#error "kernels are compiled by nvcc, or by the build of tests/cuda"
#endif

namespace vla::cuda {

constexpr int kLanes = 32;

/// Calls run(job, block within the job) for the job that `block` belongs to.
template <class Job, int kMost, class Run>
VLA_DEVICE void run_one(const Several<Job, kMost>& jobs, unsigned block, Run run) {
  int i = 0;
  while (i + 1 < jobs.n && block >= jobs.end[i]) ++i;
  run(jobs.job[i], static_cast<int>(i == 0 ? block : block - jobs.end[i - 1]));
}

VLA_DEVICE int thread_index() { return static_cast<int>(threadIdx.x); }
VLA_DEVICE float from_bf16(std::uint16_t bits) { return dev::float_of(static_cast<int>(bits) << 16); }
/// Stores element `at` of an array of bf16 or float32.
VLA_DEVICE void store(void* y, bool is_bf16, std::int64_t at, float value) {
  if (is_bf16)
    static_cast<std::uint16_t*>(y)[at] = static_cast<std::uint16_t>(dev::to_bf16(value, 0));
  else
    static_cast<float*>(y)[at] = value;
}

/// Stores elements `at`, which must be even, and at + 1.
VLA_DEVICE void store_pair(void* y, bool is_bf16, std::int64_t at, float low, float high) {
  if (is_bf16)
    *reinterpret_cast<unsigned*>(static_cast<std::uint16_t*>(y) + at) = dev::to_bf16(low, high);
  else
    *reinterpret_cast<float2*>(static_cast<float*>(y) + at) = {low, high};
}

/// Reduces over the lanes of a warp in a fixed order. All lanes get the same result.
VLA_DEVICE float sum_of_warp(float x) {
  for (int mask = 16; mask > 0; mask /= 2) x += dev::shuffle_xor(x, mask);
  return x;
}
VLA_DEVICE int sum_of_warp(int x) {
  for (int mask = 16; mask > 0; mask /= 2) x += dev::shuffle_xor(x, mask);
  return x;
}
VLA_DEVICE int most_of_warp(int x) {
  for (int mask = 16; mask > 0; mask /= 2) {
    const int other = dev::shuffle_xor(x, mask);
    x = other > x ? other : x;
  }
  return x;
}

/// Reduces over the warps of a block with `combine`, through one word of shared memory per warp. All threads must call
/// it; `room` may be reused after their next barrier.
template <class T, class Combine>
VLA_DEVICE T across_warps(T of_warp, std::byte* room, Combine combine) {
  const int n_warp = static_cast<int>(blockDim.x) / kLanes;
  if (thread_index() % kLanes == 0) dev::write(room + thread_index() / kLanes * 4, of_warp);
  __syncthreads();
  T all = dev::read<T>(room);
  for (int i = 1; i < n_warp; ++i) all = combine(all, dev::read<T>(room + i * 4));
  return all;
}

}  // namespace vla::cuda
