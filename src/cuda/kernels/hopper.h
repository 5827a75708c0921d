// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "cuda/kernels/device.h"
#include "cuda/kernels/tensor_map.h"

/// Products of a warpgroup (four consecutive warps from a multiple of four on), clusters of blocks, mbarriers and
/// copies that they count, for files that are compiled only for sm_90a. For the host's compiler tests/cuda/emulation.h
/// has the same functions. Source: PTX ISA 9.0, "Asynchronous Warpgroup Level Matrix Multiply-Accumulate Instructions".
#ifdef __CUDACC__

namespace vla::cuda::dev {

/// Makes this thread's writes to shared memory visible to wgmma, also those of copies that it has waited for. A barrier
/// must follow before another thread's wgmma reads them.
VLA_DEVICE void fence_async_proxy() { asm volatile("fence.proxy.async.shared::cta;" ::: "memory"); }

/// Waits until all threads of the cluster have come here. What they wrote to shared memory before is visible to all.
VLA_DEVICE void meet_cluster() {
  asm volatile("barrier.cluster.arrive.release.aligned;\nbarrier.cluster.wait.acquire.aligned;" ::: "memory");
}
/// Waits likewise, but makes nothing visible: a block whose shared memory others read calls it at its end.
VLA_DEVICE void leave_cluster() {
  asm volatile("barrier.cluster.arrive.relaxed.aligned;\nbarrier.cluster.wait.acquire.aligned;" ::: "memory");
}
/// Reads the 16 bytes that block `rank` of the cluster has where this block has those at p.
VLA_DEVICE uint4 read_of_block(const std::byte* p, int rank) {
  unsigned from;
  uint4 to;
  asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(from) : "r"(shared_address(p)), "r"(rank));
  asm volatile("ld.shared::cluster.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(to.x), "=r"(to.y), "=r"(to.z), "=r"(to.w)
               : "r"(from)
               : "memory");
  return to;
}

/// An mbarrier takes 8 bytes of shared memory. A phase of it ends after n_arrival arrivals and as many bytes as these
/// expect.
VLA_DEVICE void begin_mbarrier(std::byte* mbarrier, int n_arrival) {
  asm volatile("mbarrier.init.shared::cta.b64 [%0], %1;" ::"r"(shared_address(mbarrier)), "r"(n_arrival) : "memory");
}
/// Makes the mbarriers that this thread has begun visible to copies, and after a barrier to the cluster's threads.
VLA_DEVICE void fence_mbarriers() { asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory"); }
VLA_DEVICE void arrive(std::byte* mbarrier) {
  asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0];" ::"r"(shared_address(mbarrier)) : "memory");
}
/// Arrives, and lets the phase expect n_byte of copies.
VLA_DEVICE void arrive_expecting(std::byte* mbarrier, int n_byte) {
  asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(shared_address(mbarrier)), "r"(n_byte)
               : "memory");
}
/// Arrives at the mbarrier that block `rank` of the cluster has where this block has one: to say that wgmma has read a
/// stage. What threads wrote it makes visible to the own block alone, as more would cost a MEMBAR.GPU.
VLA_DEVICE void arrive_at_block(std::byte* mbarrier, int rank) {
  unsigned of_block;
  asm("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(of_block) : "r"(shared_address(mbarrier)), "r"(rank));
  asm volatile("mbarrier.arrive.shared::cluster.b64 _, [%0];" ::"r"(of_block) : "memory");
}
/// Waits until the phase of this parity has ended; phases are numbered from 0. Parity 1 has ended at first.
VLA_DEVICE void wait_mbarrier(std::byte* mbarrier, unsigned parity) {
  int has_ended;
  do {
    asm volatile(
        "{\n.reg .pred ended;\nmbarrier.try_wait.parity.shared::cta.b64 ended, [%1], %2;\n"
        "selp.s32 %0, 1, 0, ended;\n}"
        : "=r"(has_ended)
        : "r"(shared_address(mbarrier)), "r"(parity)
        : "memory");
  } while (has_ended == 0);
}
/// Copies a box of the map's rows, from (column, row) on, to shared memory; zeros where there are no rows or columns.
/// An mbarrier's phase gets the box's bytes when they are there.
VLA_DEVICE void copy_box(std::byte* to, const TensorMap& map, int column, int row, std::byte* mbarrier) {
  asm volatile(
      "cp.async.bulk.tensor.2d.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1, {%2, %3}], [%4];" ::"r"(
          shared_address(to)),
      "l"(&map), "r"(column), "r"(row), "r"(shared_address(mbarrier))
      : "memory");
}
/// The same to those blocks of the cluster whose bits are set, each with its own mbarrier.
VLA_DEVICE void copy_box_to_blocks(std::byte* to, const TensorMap& map, int column, int row, std::byte* mbarrier,
                                   unsigned blocks) {
  asm volatile(
      "cp.async.bulk.tensor.2d.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster"
      " [%0], [%1, {%2, %3}], [%4], %5;" ::"r"(shared_address(to)),
      "l"(&map), "r"(column), "r"(row), "r"(shared_address(mbarrier)), "h"(static_cast<unsigned short>(blocks))
      : "memory");
}
/// Copies a box of a map of heads likewise, from (column, token) on of one head in one batch.
VLA_DEVICE void copy_box_of_head(std::byte* to, const TensorMap& map, int column, int head, int token, int batch,
                                 std::byte* mbarrier) {
  asm volatile(
      "cp.async.bulk.tensor.4d.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1, {%2, %3, %4, %5}], "
      "[%6];" ::"r"(shared_address(to)),
      "l"(&map), "r"(column), "r"(head), "r"(token), "r"(batch), "r"(shared_address(mbarrier))
      : "memory");
}

/// Must precede the first wgmma, and each wgmma after other instructions have touched its registers.
VLA_DEVICE void wgmma_fence() { asm volatile("wgmma.fence.sync.aligned;" ::: "memory"); }
VLA_DEVICE void wgmma_commit() { asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory"); }
/// Waits until all but the latest kLeft groups of this warpgroup have ended: then their operands may be overwritten.
template <int kLeft>
VLA_DEVICE void wgmma_wait() {
  asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(kLeft) : "memory");
}
/// Nothing that computes or reads these registers moves across it.
template <class T, int kCount>
VLA_DEVICE void pin(T (&registers)[kCount]) {
#pragma unroll
  for (int i = 0; i < kCount; ++i) {
    if constexpr (T(0.5f) == T(0))
      asm volatile("" : "+r"(registers[i])::"memory");
    else
      asm volatile("" : "+f"(registers[i])::"memory");
  }
}
/// Waits likewise: then these sums may be read.
template <int kLeft, class T, int kCount>
VLA_DEVICE void wgmma_wait_for(T (&sum)[kCount]) {
  wgmma_wait<kLeft>();
  pin(sum);
}
/// Waits for all groups.
template <class T, int kCount>
VLA_DEVICE void wgmma_wait_all(T (&sum)[kCount]) {
  wgmma_wait_for<0>(sum);
}

// clang-format off
// VLA_Rn names registers %0 to %(n - 1); VLA_Sn lists the sums as operands for these registers.
#define VLA_R8 "%0, %1, %2, %3, %4, %5, %6, %7"
#define VLA_R16 VLA_R8 ", %8, %9, %10, %11, %12, %13, %14, %15"
#define VLA_R24 VLA_R16 ", %16, %17, %18, %19, %20, %21, %22, %23"
#define VLA_R32 VLA_R24 ", %24, %25, %26, %27, %28, %29, %30, %31"
#define VLA_R40 VLA_R32 ", %32, %33, %34, %35, %36, %37, %38, %39"
#define VLA_R48 VLA_R40 ", %40, %41, %42, %43, %44, %45, %46, %47"
#define VLA_R56 VLA_R48 ", %48, %49, %50, %51, %52, %53, %54, %55"
#define VLA_R64 VLA_R56 ", %56, %57, %58, %59, %60, %61, %62, %63"
#define VLA_R72 VLA_R64 ", %64, %65, %66, %67, %68, %69, %70, %71"
#define VLA_R80 VLA_R72 ", %72, %73, %74, %75, %76, %77, %78, %79"
#define VLA_R88 VLA_R80 ", %80, %81, %82, %83, %84, %85, %86, %87"
#define VLA_R96 VLA_R88 ", %88, %89, %90, %91, %92, %93, %94, %95"
#define VLA_R104 VLA_R96 ", %96, %97, %98, %99, %100, %101, %102, %103"
#define VLA_R112 VLA_R104 ", %104, %105, %106, %107, %108, %109, %110, %111"
#define VLA_R120 VLA_R112 ", %112, %113, %114, %115, %116, %117, %118, %119"
#define VLA_R128 VLA_R120 ", %120, %121, %122, %123, %124, %125, %126, %127"
#define VLA_SUMS(c, i) c(sum[i]), c(sum[i + 1]), c(sum[i + 2]), c(sum[i + 3]), c(sum[i + 4]), c(sum[i + 5]), c(sum[i + 6]), c(sum[i + 7])
#define VLA_S8(c) VLA_SUMS(c, 0)
#define VLA_S16(c) VLA_S8(c), VLA_SUMS(c, 8)
#define VLA_S24(c) VLA_S16(c), VLA_SUMS(c, 16)
#define VLA_S32(c) VLA_S24(c), VLA_SUMS(c, 24)
#define VLA_S40(c) VLA_S32(c), VLA_SUMS(c, 32)
#define VLA_S48(c) VLA_S40(c), VLA_SUMS(c, 40)
#define VLA_S56(c) VLA_S48(c), VLA_SUMS(c, 48)
#define VLA_S64(c) VLA_S56(c), VLA_SUMS(c, 56)
#define VLA_S72(c) VLA_S64(c), VLA_SUMS(c, 64)
#define VLA_S80(c) VLA_S72(c), VLA_SUMS(c, 72)
#define VLA_S88(c) VLA_S80(c), VLA_SUMS(c, 80)
#define VLA_S96(c) VLA_S88(c), VLA_SUMS(c, 88)
#define VLA_S104(c) VLA_S96(c), VLA_SUMS(c, 96)
#define VLA_S112(c) VLA_S104(c), VLA_SUMS(c, 104)
#define VLA_S120(c) VLA_S112(c), VLA_SUMS(c, 112)
#define VLA_S128(c) VLA_S120(c), VLA_SUMS(c, 120)
// half: n / 2, the number of a thread's sums and of the operand that follows them; p1 to p5: numbers of those after it.
#define VLA_WGMMA(n, half, operand_a, b, adds, shape, tail, c, ...)                                              \
  if constexpr (kN == n)                                                                                         \
    asm volatile("{\n.reg .pred adds;\nsetp.ne.b32 adds, %" #adds ", 0;\n"                                       \
                 "wgmma.mma_async.sync.aligned.m64n" #n shape " {" VLA_R##half "}, " operand_a ", %" #b          \
                 ", adds" tail ";\n}"                                                                            \
                 : VLA_S##half(c) : __VA_ARGS__ : "memory")
// Operand a in shared memory, or in four registers.
#define VLA_WGMMA_OF_SHARED(n, half, p1, p2, p3, p4, p5, shape, tail, c) \
  VLA_WGMMA(n, half, "%" #half, p1, p2, shape, tail, c, "l"(a), "l"(b), "r"(static_cast<int>(adds)))
#define VLA_WGMMA_OF_REGISTERS(n, half, p1, p2, p3, p4, p5, shape, tail, c)                                      \
  VLA_WGMMA(n, half, "{%" #half ", %" #p1 ", %" #p2 ", %" #p3 "}", p4, p5, shape, tail, c, "r"(a[0]), "r"(a[1]), \
            "r"(a[2]), "r"(a[3]), "l"(b), "r"(static_cast<int>(adds)))
#define VLA_WGMMA_OF_ANY_SIZE(form, shape, tail, c)         \
  form(48, 24, 25, 26, 27, 28, 29, shape, tail, c);         \
  form(64, 32, 33, 34, 35, 36, 37, shape, tail, c);         \
  form(80, 40, 41, 42, 43, 44, 45, shape, tail, c);         \
  form(96, 48, 49, 50, 51, 52, 53, shape, tail, c);         \
  form(112, 56, 57, 58, 59, 60, 61, shape, tail, c);        \
  form(128, 64, 65, 66, 67, 68, 69, shape, tail, c);        \
  form(144, 72, 73, 74, 75, 76, 77, shape, tail, c);        \
  form(160, 80, 81, 82, 83, 84, 85, shape, tail, c);        \
  form(176, 88, 89, 90, 91, 92, 93, shape, tail, c);        \
  form(192, 96, 97, 98, 99, 100, 101, shape, tail, c);      \
  form(208, 104, 105, 106, 107, 108, 109, shape, tail, c);  \
  form(224, 112, 113, 114, 115, 116, 117, shape, tail, c);  \
  form(240, 120, 121, 122, 123, 124, 125, shape, tail, c);  \
  form(256, 128, 129, 130, 131, 132, 133, shape, tail, c)
// clang-format on

/// sum[64, kN] (+)= a[64, 16] * b[kN, 16]^T of bf16 with sums in float32; `adds` keeps the old sums.
/// a and b are descriptors of shared memory. Each warp has 16 rows of the sums; register 4 j + 2 h + c of lane l is
/// row l / 4 + 8 h of these, column 8 j + 2 (l % 4) + c.
template <int kN>
VLA_DEVICE void wgmma_bf16(float (&sum)[kN / 2], std::uint64_t a, std::uint64_t b, bool adds) {
  static_assert(kN % 16 == 0 && kN >= 48 && kN <= 256);
  VLA_WGMMA_OF_ANY_SIZE(VLA_WGMMA_OF_SHARED, "k16.f32.bf16.bf16", ", 1, 1, 0, 0", "+f");
}

/// sum[64, kN] += a[64, 16] * b[16, kN] of bf16. a is in registers, which nobody may touch before the product was
/// waited for: in each warp those of operand a of dev::multiply_bf16. b is a descriptor of shared memory, see
/// swizzled_descriptor.
template <int kN>
VLA_DEVICE void wgmma_bf16(float (&sum)[kN / 2], const unsigned (&a)[4], std::uint64_t b) {
  static_assert(kN % 16 == 0 && kN >= 48 && kN <= 256);
  constexpr bool adds = true;
  VLA_WGMMA_OF_ANY_SIZE(VLA_WGMMA_OF_REGISTERS, "k16.f32.bf16.bf16", ", 1, 1, 1", "+f");
}

/// sum[64, kN] (+)= a[64, 32] * b[kN, 32]^T of signed bytes, exactly, else as wgmma_bf16 with a in registers: register
/// h + 2 k of lane l has bytes 16 k + 4 (l % 4) to + 3 of row l / 4 + 8 h of the warp's 16.
template <int kN>
VLA_DEVICE void wgmma_s8(int (&sum)[kN / 2], const unsigned (&a)[4], std::uint64_t b, bool adds) {
  static_assert(kN % 16 == 0 && kN >= 48 && kN <= 256);
  VLA_WGMMA_OF_ANY_SIZE(VLA_WGMMA_OF_REGISTERS, "k32.s32.s8.s8", "", "+r");
}

}  // namespace vla::cuda::dev

#endif

namespace vla::cuda {

/// Operands of wgmma are rows of kRow bytes, 128 or 32: of the depth, or of b's columns where b is transposed. Eight
/// rows follow each other and are aligned to their size. The 16-byte chunks of rows are permuted by the rows'
/// addresses: swizzling over kRow bytes. Source: PTX ISA 9.0, "Strides", "Matrix descriptor format".
constexpr int kSwizzledRow = 128, kSwizzledRows = 8;
template <int kRow = kSwizzledRow>
VLA_DEVICE int swizzled(int row, int chunk) {
  static_assert(kRow == 128 || kRow == 32);
  return row * kRow + (chunk ^ row * kRow / 128 % (kRow / 16)) * 16;
}

/// The matrix descriptor of such rows. To advance by k bytes of a row, add k / 16. A transposed b has a row for each
/// element of the depth, with kRow / 2 columns; further columns are in rows that lie `next` bytes on. To advance by 16
/// of its depth, add kRow.
template <int kRow = kSwizzledRow>
VLA_DEVICE std::uint64_t swizzled_descriptor(const std::byte* rows, int next = 16) {
  constexpr std::uint64_t kSwizzling = std::uint64_t{kRow == 128 ? 1 : 3} << 62, kStride = kRow * kSwizzledRows / 16;
  const std::uint64_t first = (dev::shared_address(rows) & 0x3ffffU) >> 4;
  return first | static_cast<std::uint64_t>(next / 16) << 16 | kStride << 32 | kSwizzling;
}

}  // namespace vla::cuda
