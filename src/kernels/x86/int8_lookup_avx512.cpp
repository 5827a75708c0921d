// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Products of ternary matrices: permutations look up some of the sums while VNNI multiplies the rest.
//
// The products of three ternary elements with three given codes of x have one of 27 sums. A *table* holds all 27, 16
// bits each, in one register. vpermw takes three elements of each of 32 columns as indices and finds 32 sums in the
// table, and vpaddw adds them: 96 multiply-adds in two instructions; VNNI does 64 in one. AMD's cores permute and add
// while they multiply, so both methods run at the same time: of seven elements of a column, four are multiplied and
// three looked up. Both methods give the same sums.
#include "kernels/int8_loop.h"
#include "kernels/x86/vec_avx512.h"

namespace vla::kernels {

extern const LinearKernel kTernaryAvx512;

namespace {

using V = Avx512;
constexpr std::int64_t kRows = 4, kColumns = 64, kStrips = kColumns / Int8Panels::kColumns;
constexpr std::int64_t kRegister = 64;  // bytes

/// A part of the depth, starting at k: n_lookup times three elements that are looked up, then n_group times four
/// elements that are multiplied. A tile alternates one lookup and one multiplication, then multiplies the remaining
/// groups.
struct Step {
  std::int64_t k, n_lookup, n_group;

  /// kTableLines and kLines count lines of 16 elements; three lines make 16 tables.
  static constexpr std::int64_t kTableLines = 3, kLines = 14, kMaxLookup = 32, kMaxGroup = 4 * (2 * kLines - 1);
  static_assert(kMaxLookup * 2 * 3 * 127 <= 32767, "sums of 16 bits");

  static std::int64_t count(std::int64_t depth) {
    const std::int64_t n = depth / Int8Panels::kGroup / kLines;
    return n > 0 ? n : 1;
  }
  static Step at(std::int64_t i, std::int64_t n_step, std::int64_t depth) {
    const std::int64_t n_line = depth / Int8Panels::kGroup, line = n_line * i / n_step;
    const std::int64_t lines = n_line * (i + 1) / n_step - line, n_table = min(lines / (kLines / 2), 2);
    return {line * Int8Panels::kGroup, n_table * Int8Panels::kGroup, 4 * (lines - kTableLines * n_table)};
  }
  std::int64_t depth() const { return 3 * n_lookup + 4 * n_group; }
  /// The first element that is multiplied.
  std::int64_t multiplied() const { return k + 3 * n_lookup; }
};

/// The three elements, 0 to 2 each, that an index stands for: index = first + 3 second + 9 third. Byte 4 j + i is
/// element i of index 8 (j / 4) + j % 4 (+ 4 in the second half), the order in which vpackssdw interleaves.
struct TableNumbers {
  alignas(kRegister) std::uint8_t half[2][64] = {};

  constexpr TableNumbers() {
    for (int h = 0; h < 2; ++h)
      for (int j = 0; j < 16; ++j) {
        const int index = 8 * (j / 4) + j % 4 + 4 * h;
        for (int i = 0, rest = index; i < 3 && index < 27; ++i, rest /= 3)
          half[h][4 * j + i] = static_cast<std::uint8_t>(rest % 3);
      }
  }
};
constexpr TableNumbers kTableNumbers;

typedef std::uint32_t Words __attribute__((vector_size(kRegister)));

/// Makes 16 tables of a row, with a stride of kRows registers; table k is for codes k, 16 + k and 32 + k.
VLA_INLINE void make_tables(const std::byte* x, std::byte* to) {
  const auto widened = [&](int from) VLA_LAMBDA {
    struct Codes {
      std::byte code[16];
    };
    Words codes;  // GCC warns about the intrinsic in its own header
    asm("vpmovzxbd %1, %0" : "=v"(codes) : "m"(*reinterpret_cast<const Codes*>(x + from)));
    return codes;
  };
  alignas(kRegister) const Words three = widened(0) | widened(16) << 8 | widened(32) << 16;
#pragma GCC unroll 16
  for (int k = 0; k < 16; ++k, to += kRows * kRegister) {
    __m512i sums[2];
    for (int h = 0; h < 2; ++h) {
      sums[h] = _mm512_setzero_si512();
      asm("vpdpbusd %2%{1to16%}, %1, %0"
          : "+v"(sums[h])
          : "v"(_mm512_load_si512(kTableNumbers.half[h])), "m"(reinterpret_cast<const std::uint32_t*>(&three)[k]));
    }
    _mm512_store_si512(to, _mm512_packs_epi32(sums[0], sums[1]));
  }
}

/// Makes the indices of a panel's columns into these tables: from elements k of three lines of each strip. A register
/// interleaves the indices of two strips, each in the lowest five bits of 16; vpermw ignores the other bits.
VLA_INLINE void make_indices(const std::byte* strips, std::int64_t strip, std::byte* to) {
  for (int pair = 0; pair < kStrips / 2; ++pair)
    for (int s = 0; s < 4; ++s) {
      Words index[2];  // byte 4 n + i: column n, element 4 s + i
      for (int j = 0; j < 2; ++j) {
        const auto numbers = [&](int line) VLA_LAMBDA {
          Words codes;
          std::memcpy(&codes, strips + (2 * pair + j) * strip + line * Int8Panels::kLine, sizeof(codes));
          return codes >> 2 * s & 0x03030303U;
        };
        index[j] = numbers(0) + 3 * numbers(1) + 9 * numbers(2);
      }
      for (int i = 0; i < 4; ++i) {
        const Words first = index[0] >> 8 * i, second = i < 2 ? index[1] << (16 - 8 * i) : index[1] >> (8 * i - 16);
        const Words both = (first & 0xFFFFU) | (second & 0xFFFF0000U);
        std::memcpy(to + ((4 * s + i) * (kStrips / 2) + pair) * kRegister, &both, sizeof(both));
      }
    }
}

// Registers of a tile: 0 to 15 hold sums of four rows by four strips, 16 to 23 sums of 16 bits of four rows by two
// pairs of interleaved strips, 25 to 28 the elements of a group, 29 and 30 the indices of a lookup.
// clang-format off
#define VLA_FOR_SUMS(what)                                                                  \
  what("0", "0") what("1", "64") what("2", "128") what("3", "192")                          \
  what("4", "256") what("5", "320") what("6", "384") what("7", "448")                       \
  what("8", "512") what("9", "576") what("10", "640") what("11", "704")                     \
  what("12", "768") what("13", "832") what("14", "896") what("15", "960")
#define VLA_FOR_ROWS(what)                                                                  \
  what("0", "(%[x])", "0", "1", "2", "3", "16", "17")                                       \
  what("64", "(%[x],%[stride])", "4", "5", "6", "7", "18", "19")                            \
  what("128", "(%[x],%[stride],2)", "8", "9", "10", "11", "20", "21")                       \
  what("192", "(%[x],%[stride3])", "12", "13", "14", "15", "22", "23")
#define VLA_LOAD(sum, at) "vmovdqa64 " at "(%[sums]), %%zmm" sum "\n"
#define VLA_STORE(sum, at) "vmovdqa64 %%zmm" sum ", " at "(%[sums])\n"
#define VLA_NUMBERS                                                                         \
  "vmovdqa64 (%[numbers]), %%zmm25\n"                                                       \
  "vmovdqa64 64(%[numbers]), %%zmm26\n"                                                     \
  "vmovdqa64 128(%[numbers]), %%zmm27\n"                                                    \
  "vmovdqa64 192(%[numbers]), %%zmm28\n"                                                    \
  "add $256, %[numbers]\n"
#define VLA_MULTIPLY(table, x, a, b, c, d, even, odd)                                       \
  "vpbroadcastd " x ", %%zmm24\n"                                                           \
  "vpdpbusd %%zmm24, %%zmm25, %%zmm" a "\n"                                                 \
  "vpdpbusd %%zmm24, %%zmm26, %%zmm" b "\n"                                                 \
  "vpdpbusd %%zmm24, %%zmm27, %%zmm" c "\n"                                                 \
  "vpdpbusd %%zmm24, %%zmm28, %%zmm" d "\n"
#define VLA_LOOK_UP_AND_MULTIPLY(table, x, a, b, c, d, even, odd)                           \
  "vmovdqa64 " table "(%[tables]), %%zmm31\n"                                               \
  "vpermw %%zmm31, %%zmm29, %%zmm24\n"                                                      \
  "vpaddw %%zmm24, %%zmm" even ", %%zmm" even "\n"                                          \
  "vpermw %%zmm31, %%zmm30, %%zmm31\n"                                                      \
  "vpaddw %%zmm31, %%zmm" odd ", %%zmm" odd "\n"                                            \
  VLA_MULTIPLY(table, x, a, b, c, d, even, odd)
/// Adds the 16-bit sums at even places to the sums of the first strip, at odd places to those of the second.
#define VLA_ADD_LOOKED_UP(table, x, a, b, c, d, even, odd)                                  \
  "vpdpwssd %%zmm24, %%zmm" even ", %%zmm" a "\n"                                           \
  "vpdpwssd %%zmm25, %%zmm" even ", %%zmm" b "\n"                                           \
  "vpdpwssd %%zmm24, %%zmm" odd ", %%zmm" c "\n"                                            \
  "vpdpwssd %%zmm25, %%zmm" odd ", %%zmm" d "\n"
// clang-format on

/// sums [kColumns] x kRows += the products of a step. The whole tile is assembly, because with intrinsics compilers
/// copy every sum, and the tile needs all registers.
void tile(const std::byte* x, std::int64_t stride, const std::byte* numbers, const std::byte* indices,
          const std::byte* tables, const Step& step, std::int32_t* sums) {
  std::int64_t n_lookup = step.n_lookup, n_more = step.n_group - step.n_lookup;
  asm volatile(VLA_FOR_SUMS(VLA_LOAD)
               ".irp sum, 16,17,18,19,20,21,22,23\n"
               "vpxord %%zmm\\sum, %%zmm\\sum, %%zmm\\sum\n"
               ".endr\n"
               "test %[n_lookup], %[n_lookup]\n"
               "jz 2f\n"
               ".p2align 6\n"
               "1:\n"
               "vmovdqa64 (%[indices]), %%zmm29\n"
               "vmovdqa64 64(%[indices]), %%zmm30\n"
               VLA_NUMBERS VLA_FOR_ROWS(VLA_LOOK_UP_AND_MULTIPLY)
               "add $4, %[x]\n"
               "add $128, %[indices]\n"
               "add $256, %[tables]\n"
               "dec %[n_lookup]\n"
               "jnz 1b\n"
               "2:\n"
               "test %[n_more], %[n_more]\n"
               "jz 4f\n"
               "3:\n"
               VLA_NUMBERS VLA_FOR_ROWS(VLA_MULTIPLY)
               "add $4, %[x]\n"
               "dec %[n_more]\n"
               "jnz 3b\n"
               "4:\n"
               "vpbroadcastd %[low], %%zmm24\n"
               "vpslld $16, %%zmm24, %%zmm25\n"
               VLA_FOR_ROWS(VLA_ADD_LOOKED_UP) VLA_FOR_SUMS(VLA_STORE)
               : [x] "+r"(x), [numbers] "+r"(numbers), [indices] "+r"(indices), [tables] "+r"(tables),
                 [n_lookup] "+r"(n_lookup), [n_more] "+r"(n_more)
               : [stride] "r"(stride), [stride3] "r"(3 * stride), [sums] "r"(sums), [low] "r"(1)
               : "cc", "memory", "xmm0", "xmm1", "xmm2", "xmm3", "xmm4", "xmm5", "xmm6", "xmm7", "xmm8", "xmm9", "xmm10",
                 "xmm11", "xmm12", "xmm13", "xmm14", "xmm15", "xmm16", "xmm17", "xmm18", "xmm19", "xmm20", "xmm21",
                 "xmm22", "xmm23", "xmm24", "xmm25", "xmm26", "xmm27", "xmm28", "xmm29", "xmm30", "xmm31");
}

#undef VLA_FOR_SUMS
#undef VLA_FOR_ROWS
#undef VLA_LOAD
#undef VLA_STORE
#undef VLA_NUMBERS
#undef VLA_MULTIPLY
#undef VLA_LOOK_UP_AND_MULTIPLY
#undef VLA_ADD_LOOKED_UP

/// An item: some panels by a block of rows, one step of the depth after the other. A step of all panels is expanded
/// once for the block; tables are made for four rows at a time, and all panels share them.
class LookupLoop {
  static constexpr std::int64_t kBlockRows = 108;
  static constexpr std::int64_t kPanels = 20;                   // panels whose steps and sums fit into L2
  static constexpr std::int64_t kManyPanels = 8;                // panels that share the cost of making tables
  static constexpr std::int64_t kMinItems = 2, kManyItems = 8;  // per thread, if there are that many

  struct Tile {
    using V = kernels::V;
    [[maybe_unused]] static constexpr int kRows = kernels::kRows;
    static constexpr int kColumns = kernels::kColumns;
  };
  using Stripes = LinearStripes<Tile>;

  /// A step of a panel, as a tile reads it.
  struct Numbers {
    alignas(kRegister) std::byte multiplied[Step::kMaxGroup * kStrips * kRegister];
    alignas(kRegister) std::byte indices[Step::kMaxLookup * kStrips / 2 * kRegister];
  };
  struct Scratch {
    alignas(kRegister) std::byte tables[Step::kMaxLookup * kRows * kRegister];
    Numbers numbers[kPanels];
    alignas(kRegister) std::int32_t sums[kPanels][kBlockRows * kColumns];
    alignas(kRegister) float gates[kBlockRows * kColumns], scaled[kRows * kColumns];
  };

 public:
  static constexpr std::size_t kScratch = sizeof(Scratch);

  static std::int64_t cut(LinearJob& job, int n_thread) {
    const std::int64_t n_block = ceil_div(job.n_row, block_rows(job));
    const auto groups = [&](std::int64_t items) { return ceil_div(items * n_thread, n_block); };
    const std::int64_t n_panel = Stripes::n_panel(job), most = min(groups(kManyItems), n_panel / kManyPanels);
    job.n_group = n_thread == 1 ? 1 : min(most > groups(kMinItems) ? most : groups(kMinItems), n_panel);
    return n_block * job.n_group;
  }

  static void run(const LinearJob& job, std::int64_t item, Worker& worker) {
    LookupLoop loop(job, worker.scratch<Scratch>());
    const std::int64_t n_panel = Stripes::n_panel(job), group = item % job.n_group;
    loop.row_ = item / job.n_group * block_rows(job);
    loop.n_row_ = min(block_rows(job), job.n_row - loop.row_);
    const std::int64_t end = n_panel * (group + 1) / job.n_group, most = job.gated ? kPanels / 2 : kPanels;
    for (std::int64_t panel = n_panel * group / job.n_group; panel < end; panel += most)
      loop.panels(panel, min(panel + most, end));
  }

 private:
  LookupLoop(const LinearJob& job, Scratch* scratch) : job_(job), scratch_(*scratch) {}

  static std::int64_t block_rows(const LinearJob& job) { return even_block(job.n_row, kBlockRows, kRows); }
  const std::byte* row_of(std::int64_t r) const { return job_.x + (row_ + r) * job_.x_stride; }

  void panels(std::int64_t first, std::int64_t end) {
    std::memset(scratch_.sums, 0,
                static_cast<std::size_t>((end - first) * (job_.gated ? 2 : 1)) * sizeof(*scratch_.sums));
    const std::int64_t depth = quantized_depth(job_.d_in), n_step = Step::count(depth);
    for (std::int64_t i = 0; i < n_step; ++i) {
      const Step step = Step::at(i, n_step, depth);
      Numbers* numbers = scratch_.numbers;
      for (std::int64_t panel = first; panel < end; ++panel) {
        const Stripe s = Stripes::of_panel(job_, panel);
        if (job_.gated) expand(job_.part[0], s.column, step, *numbers++);
        expand(job_.part[s.part], s.column, step, *numbers++);
      }
      for (std::int64_t r = 0; r < n_row_; r += kRows) multiply(step, r, numbers - scratch_.numbers);
    }
    std::int32_t(*sums)[kBlockRows * kColumns] = scratch_.sums;
    for (std::int64_t panel = first; panel < end; ++panel, ++sums) {
      Stripe s = Stripes::of_panel(job_, panel);
      s.row = row_, s.n_row = n_row_, s.depth = job_.d_in, s.gates = scratch_.gates;
      if (job_.gated) scale(job_.part[0], s, *sums++, 0, n_row_, scratch_.gates);
      for (std::int64_t r = 0; r < n_row_; r += kRows) {
        const std::int64_t n = min(kRows, n_row_ - r);
        Stripes::fetch(job_, s, r + kRows, min(kRows, n_row_ - r - kRows));
        scale(job_.part[s.part], s, *sums, r, n, scratch_.scaled);
        Stripes::finish(job_, s, scratch_.scaled, r, n);
      }
    }
  }

  /// Expands a step of a part's columns.
  void expand(const LinearJob::Part& part, std::int64_t column, const Step& step, Numbers& numbers) {
    const std::int64_t strip = TernaryPanels::strip_size(job_.d_in);
    const std::byte* strips = part.weight + column / Int8Panels::kColumns * strip;
    const auto line = [&](std::int64_t k) { return strips + k / Int8Panels::kGroup * Int8Panels::kLine; };
    for (std::int64_t i = 0; i < kStrips; ++i)
      for (std::int64_t k = 0; k < step.depth(); k += Int8Panels::kGroup)
        __builtin_prefetch(line(step.k + step.depth() + k) + i * strip, 0, 2);
    for (std::int64_t k = 0; k < step.n_lookup; k += 16)
      make_indices(line(step.k + 3 * k), strip, numbers.indices + k * kStrips / 2 * kRegister);
    const TernaryPanels::Strips<kStrips> multiplied(line(step.multiplied()), job_.d_in, 0);
    kernels::expand<V::Int, kStrips, Int8Panels::kGroup>(multiplied, 0, 4 * step.n_group, numbers.multiplied);
  }

  /// Multiplies a step of kRows rows, starting at r, by n panels. Rows after the block's are read (kMaxTernaryRows),
  /// and their sums ignored.
  void multiply(const Step& step, std::int64_t r, std::int64_t n) {
    for (std::int64_t i = 0; i < kRows; ++i)
      for (std::int64_t k = 0; k < step.n_lookup; k += 16) {
        __builtin_prefetch(row_of(r + kRows + i) + step.k + 3 * k);
        make_tables(row_of(r + i) + step.k + 3 * k, scratch_.tables + (k * kRows + i) * kRegister);
      }
    for (std::int64_t i = 0; i < n; ++i)
      tile(row_of(r) + step.multiplied(), job_.x_stride, scratch_.numbers[i].multiplied, scratch_.numbers[i].indices,
           scratch_.tables, step, scratch_.sums[i] + r * kColumns);
  }

  /// Writes the values of rows r to r + n from their sums.
  void scale(const LinearJob::Part& part, const Stripe& s, const std::int32_t* sums, std::int64_t r, std::int64_t n,
             float* to) const {
    for (std::int64_t i = r; i < r + n; ++i, to += kColumns)
      scale_sums<V, TernaryPanels, kColumns, TernaryPanels::kOffset>(part, s, row_scale(row_of(i), job_.d_in),
                                                                     sums + i * kColumns, to);
  }

  const LinearJob& job_;
  Scratch& scratch_;
  std::int64_t row_ = 0, n_row_ = 0;
};

bool supports(const MatrixDesc& desc, Features use) {
  return desc.type == DType::ternary && use.has(Feature::permutes_beside_vnni);
}

constexpr std::int64_t kFewRows = 32;  // fewer rows do not repay the tables

}  // namespace

extern const LinearKernel kTernaryLookup;
const LinearKernel kTernaryLookup = {
    .name = "avx512_lookup",
    .packed_size = TernaryPanels::packed_size,
    .pack = TernaryPanels::pack,
    .supports = supports,
    .cut = LookupLoop::cut,
    .run = LookupLoop::run,
    .scratch_size = LookupLoop::kScratch,
    .max_norm = kAnyDepth,
    .small_batch = &kTernaryAvx512,
    .max_small_batch = kFewRows,
    .quantize = [](const float* x, std::int64_t n, std::byte* to) { quantize_row<V>(x, n, to); },
};

}  // namespace vla::kernels
