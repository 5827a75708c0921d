# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes made in kernels, one at a time: the tests must see each. A kernel is compiled with the mistake to PTX, which
also shows those in assembly, and runs in the place of the right one."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor

import cuda_kernels
from conftest import run_tests

# File with the mistake, kernel to compile, what is there, what is there instead.
MISTAKES = {
    # Products of codes.
    "no barrier before a stage is read": (
        "linear_int8.cu",
        "linear_int8",
        "    __syncthreads();  // the stage is",
        "    // the stage is",
    ),
    "barrier before the wait": (
        "linear_int8.cu",
        "linear_int8",
        "    dev::wait_copies<S::kStages - 2>();\n    __syncthreads();",
        "    __syncthreads();\n    dev::wait_copies<S::kStages - 2>();",
    ),
    "waits for a group too few": (
        "linear_int8.cu",
        "linear_int8",
        "wait_copies<S::kStages - 2>",
        "wait_copies<S::kStages - 1>",
    ),
    "no group where nothing is fetched": (
        "linear_int8.cu",
        "linear_int8",
        "shared + next * S::kStage);\n    dev::commit_copies();",
        "shared + next * S::kStage), dev::commit_copies();",
    ),
    "fetches into the stage that is read": (
        "linear_int8.cu",
        "linear_int8",
        "next = S::kStages - 1;",
        "next = S::kStages - 2;",
    ),
    "halves of the depth swapped": (
        "linear_int8.cu",
        "linear_int8",
        "half * 2 + lane / 16)",
        "(1 - half) * 2 + lane / 16)",
    ),
    "fragments of codes swapped": (
        "packed_codes.h",
        "linear_int8",
        "words_[eight] >> 2 * i &",
        "words_[eight] >> 2 * (i ^ 1) &",
    ),
    "halves of bytes swapped": (
        "packed_codes.h",
        "linear_int8",
        ">> i % 2 * 4 &",
        ">> (i + 1) % 2 * 4 &",
    ),
    "codes of four bits are not centred": (
        "packed_codes.h",
        "linear_int8",
        "(0x80808080U - step * 0x08080808U)",
        "0x80808080U",
    ),
    "steps of other columns": (
        "packed_codes.h",
        "linear_int8",
        "steps_ >> 8 * eight &",
        "steps_ >> 8 * (eight ^ 1) &",
    ),
    "steps of other lanes": (
        "packed_codes.h",
        "linear_int8",
        "+ lane / 4 * 4)",
        "+ lane % 8 * 4)",
    ),
    "rows of fragments in another order": (
        "linear_int8.cu",
        "linear_int8",
        "m * 16 + lane % 16,",
        "m * 16 + (lane % 16 ^ 8),",
    ),
    "no swizzle, which is slow": ("linear_int8.cu", "linear_int8", "(chunk ^ (row >> 1 & 3)) * 16", "chunk * 16"),
    "rows behind the last are copied": (
        "linear_int8.cu",
        "linear_int8",
        "const bool valid = row0 + row < job.n_row;",
        "const bool valid = true;",
    ),
    "columns behind the last are copied": (
        "linear_int8.cu",
        "linear_int8",
        "const bool valid = tile < n_tile;",
        "const bool valid = true;",
    ),
    "the offset of codes stays": (
        "linear_int8.cu",
        "linear_int8",
        "first -= offset, second -= offset;",
        "first -= offset;",
    ),
    "the offset comes off each split": (
        "linear_int8.cu",
        "linear_int8",
        "kKind == CodeKind::ternary && blockIdx.z == 0 ?",
        "kKind == CodeKind::ternary ?",
    ),
    "scales multiplied in another order": (
        "row_scale.h",
        "linear_int8",
        "dev::multiply(static_cast<float>(product), dev::divide(scale, s))",
        "dev::divide(dev::multiply(static_cast<float>(product), scale), s)",
    ),
    "a quotient without its correction": (
        "row_scale.h",
        "hopper_linear_int8",
        "return dev::multiply_add(dev::multiply_add(-b, q, a), reciprocal, q);",
        "return dev::multiply(a, reciprocal);",
    ),
    "no division near the ends of the exponents": (
        "row_scale.h",
        "hopper_linear_int8",
        "if (are_plain && is_plain(row_scale.s)) return;",
        "return;",
    ),
    "a split too short": (
        "linear_int8.cu",
        "linear_int8",
        "end = n_step * (z + 1) / job.n_split",
        "end = n_step / job.n_split * (z + 1)",
    ),
    "some lanes shuffle": (
        "linear_int8.cu",
        "linear_int8",
        "total += dev::shuffle_xor(total, 2);",
        "if (lane < 16) total += dev::shuffle_xor(total, 2);",
    ),
    "no barrier before stages become room": (
        "linear_int8.cu",
        "linear_int8",
        "  __syncthreads();  // the stages' memory",
        "  // the stages' memory",
    ),
    "sums pass without waiting for lanes": (
        "store_sums.h",
        "linear_int8",
        "    __syncwarp();\n#pragma unroll 1",
        "#pragma unroll 1",
    ),
    "product and sum in one rounding": (
        "finish.h",
        "linear_int8",
        "sum = dev::add(sum, bias);",
        "sum += bias * 1.0000001f;",
    ),
    "columns behind the last are written": (
        "finish.h",
        "linear_int8",
        "ends.has_second = column + 1 < n_column,",
        "ends.has_second = true,",
    ),
    # Products of floats.
    "zeros are not filled in": ("device.h", "linear_bf16", '[%0], [%1], 16, %2;"', '[%0], [%1], 16, 16;"'),
    "registers of b swapped": (
        "device.h",
        "linear_bf16",
        '"r"(b0), "r"(b1));\n}\n/// sum + the',
        '"r"(b1), "r"(b0));\n}\n/// sum + the',
    ),
    "halves of a bf16 pair swapped": ("device.h", "linear_bf16", '"f"(high), "f"(low)', '"f"(low), "f"(high)'),
    "depth ends a step too late": (
        "linear_bf16.cu",
        "linear_bf16",
        "const int left = (depth - k) * 2,",
        "const int left = 16,",
    ),
    "depth of few rows ends too late": ("linear_bf16.cu", "linear_bf16", "k + i < end ?", "true ?"),
    "few rows anywhere are read in 16 bytes": (
        "linear_bf16.cu",
        "linear_bf16",
        "const bool is_aligned = reinterpret_cast",
        "const bool is_aligned = true || reinterpret_cast",
    ),
    "few rows are rounded": (
        "linear_bf16.cu",
        "linear_bf16",
        "k + i < end ? row[k + i] : 0;",
        "k + i < end ? dev::float_of(static_cast<int>(dev::to_bf16(0, row[k + i]))) : 0;",
    ),
    "columns of two tiles swapped": (
        "linear_bf16.cu",
        "linear_bf16",
        "lane / 16 * 8 + lane % 8, half",
        "(1 - lane / 16) * 8 + lane % 8, half",
    ),
    "a split is added twice": (
        "linear_bf16.cu",
        "linear_bf16",
        "sum.of[c] += share[z].of[c];",
        "sum.of[c] += (z == 1 ? 2 : 1) * share[z].of[c];",
    ),
    "the gate is not activated": ("finish.h", "linear_bf16", "activate(has_gate ? gate : sum)", "has_gate ? gate : activate(sum)"),
    "the factor comes after the residual": (
        "finish.h",
        "linear_bf16",
        "sum = dev::add(sum, residual);",
        "sum = dev::add(sum, residual) * factor;",
    ),
    "the last ReLU comes before the residual": (
        "finish.h",
        "linear_bf16",
        "sum = dev::add(sum, residual);\n",
        "if (e.ends_in_relu && sum < 0) sum = 0;\n  return dev::add(sum, residual);\n",
    ),
    "no barrier before x is written again": (
        "linear_f32.cu",
        "linear_f32",
        "    __syncthreads();  // all threads have read",
        "    // all threads have read",
    ),
    "a row of float32 too far": (
        "linear_f32.cu",
        "linear_f32",
        "row0 + row < n_row && k0 + k < depth;",
        "row0 + row <= n_row && k0 + k < depth;",
    ),
    # Products in tiles for Hopper.
    "no fence before wgmma reads copies": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "    dev::fence_async_proxy();\n",
        "",
    ),
    "fence behind the barrier": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "    dev::fence_async_proxy();\n    __syncthreads();",
        "    __syncthreads();\n    dev::fence_async_proxy();",
    ),
    "no barrier before wgmma": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "    __syncthreads();  // all warpgroups",
        "    // all warpgroups",
    ),
    "wgmma of a stage too early": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "wait_copies<T::kStages - 3>",
        "wait_copies<T::kStages - 2>",
    ),
    "fetches into the stage that wgmma reads": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "next = T::kStages - 2;",
        "next = T::kStages - 1;",
    ),
    "waits for wgmma too late": ("hopper_linear_bf16.cu", "hopper_linear_bf16", "wgmma_wait<1>", "wgmma_wait<2>"),
    "sums are read before wgmma has ended": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "  dev::wgmma_wait_all(sum);\n",
        "",
    ),
    "no fence of wgmma's registers": ("hopper_linear_bf16.cu", "hopper_linear_bf16", "    dev::wgmma_fence();\n", ""),
    "only the first warps multiply": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "    dev::wgmma_fence();\n",
        "    if (thread_index() < 96) dev::wgmma_fence();\n",
    ),
    "each part of the first step anew": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "x + 2 * k, i + k > 0",
        "x + 2 * k, i > 0",
    ),
    "a descriptor moves too far": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "w + 2 * k, x + 2 * k",
        "w + 2 * k, x + k",
    ),
    "a descriptor's stride of another swizzling": (
        "hopper.h",
        "hopper_linear_bf16",
        "kStride = kSwizzledRow * kSwizzledRows / 16",
        "kStride = kSwizzledRow * kSwizzledRows / 32",
    ),
    "a descriptor without swizzling": ("hopper.h", "hopper_linear_bf16", "{1} << 62", "{0} << 62"),
    "rows are not swizzled": ("hopper.h", "hopper_linear_bf16", "(chunk ^ row % kSwizzledRows)", "chunk"),
    "rows of a tile behind the last": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "i < n_left_ ? size : 0",
        "size",
    ),
    "depth of a tile ends too late": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "left < 0 ? 0 : left > 16 ? 16 : left",
        "left < 0 ? 0 : 16",
    ),
    "no barrier before stages become room for y": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "  __syncthreads();  // the stages' memory",
        "  // the stages' memory",
    ),
    "no barrier before y is read": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "  End::place(sum, shared);\n  __syncthreads();\n",
        "  End::place(sum, shared);\n",
    ),
    "rows of y without padding, which is slow": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "(kColumns + 4)",
        "kColumns",
    ),
    "rows of y behind the last": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "left < kRows ? left : kRows",
        "kRows",
    ),
    "four columns are always there": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "together_ = job.n_column % 4 == 0 &&",
        "together_ =",
    ),
    "the gate's matrix comes second": (
        "hopper_linear_bf16.cu",
        "hopper_linear_bf16",
        "if constexpr (T::kGated) fetch_gate(stage, step);\n    fetch_matrix(stage + (T::kColumns - T::kColumnsY) * kSwizzledRow, step);",
        "fetch_matrix(stage, step);\n    if constexpr (T::kGated) fetch_gate(stage + T::kColumnsY * kSwizzledRow, step);",
    ),
    "every product's columns begin at the first one's": (
        "device.h",
        "hopper_linear_bf16",
        "block - jobs.end[i - 1]",
        "block",
    ),
    "a share of the gate's sums in the place of another": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "(row0_ + row) * kHalves + half;",
        "(row0_ + row) * kHalves + kHalves - 1 - half;",
    ),
    "the gate's bias is not added": (
        "hopper_tile.h",
        "hopper_linear_bf16",
        "dev::add(value(of[i], gates[c], c), gate_bias.of[c])",
        "value(of[i], gates[c], c)",
    ),
    "codes are unpacked before they came": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "dev::wait_copies<T::kStages - 3>();",
        "dev::wait_copies<T::kStages - 2>();",
    ),
    "codes are unpacked to rows that wgmma reads": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "if (i + 1 < n) codes.unpack(packed + stage * kPacked, rows_w + stage_w * T::kBytesW);",
        "if (i + 1 < n) codes.unpack(packed + stage * kPacked, rows_w + (stage_w + 2) % 3 * T::kBytesW);",
    ),
    "the first codes are read too early": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "  dev::wait_copies<T::kStages - 2>();\n  codes.unpack",
        "  codes.unpack",
    ),
    "no fence before wgmma reads unpacked codes": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "    dev::fence_async_proxy();\n",
        "",
    ),
    "unpacked codes are not swizzled": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "swizzled(column, warp() % 2 * 4 + fragment)",
        "column * kSwizzledRow + (warp() % 2 * 4 + fragment) * 16",
    ),
    "fragments of unpacked codes swapped": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "codes.fragment(eight, i)",
        "codes.fragment(eight, i ^ 1)",
    ),
    "codes of a tile behind the last": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "const bool valid = is_there_ && tile < n_tile_;",
        "const bool valid = true;",
    ),
    "each share of the depth takes the offset off": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "T::kKind == CodeKind::ternary && z == 0 ?",
        "T::kKind == CodeKind::ternary ?",
    ),
    "scales of other columns": (
        "hopper_linear_int8.cu",
        "hopper_linear_int8",
        "job.scale[column + c]",
        "job.scale[column]",
    ),
    # Attention.
    "values are not transposed": ("device.h", "attention", "x4.trans.shared", "x4.shared"),
    "no barrier before keys are fetched again": (
        "attention.cu",
        "attention",
        "    __syncthreads();  // all threads have read the stage",
        "    // all threads have read the stage",
    ),
    "no barrier before weights are read": (
        "attention.cu",
        "attention",
        "    __syncthreads();  // values and weights are visible",
        "    // values and weights are visible",
    ),
    "values are not waited for": (
        "attention.cu",
        "attention",
        "    dev::wait_copies<1>();\n    __syncthreads();  // values and",
        "    __syncthreads();  // values and",
    ),
    "no barrier before values of warps are combined": (
        "attention.cu",
        "attention",
        "    __syncthreads();  // every warp's values are written",
        "    // every warp's values are written",
    ),
    "what was summed does not shrink": (
        "attention.cu",
        "attention",
        "y_[s][n][2 * h] *= factor, y_[s][n][2 * h + 1] *= factor;",
        "y_[s][n][2 * h] *= factor;",
    ),
    "keys behind the last count": (
        "attention.cu",
        "attention",
        "is_whole || at < n_key ? 0 : kMinusInfinity",
        "0",
    ),
    "no zeros behind the last key": ("attention.cu", "attention", "clear_rows<S>(n, S::kKeys, to);", ";"),
    "the mask of an earlier tile": (
        "attention.cu",
        "attention",
        "mask_[0] + first + key, mask_[1] + first + key",
        "mask_[0] + key, mask_[1] + key",
    ),
    "keys of an earlier segment": ("attention.cu", "attention", "from_ + (first - begin_) * token_", "from_ + first * token_"),
    "heads of another group": (
        "attention_rows.h",
        "attention",
        "unit.head_kv * job.group() + row % job.group()",
        "unit.head_kv + row % job.group() * job.n_head_kv",
    ),
    "the sum of weights of one lane": (
        "attention.cu",
        "attention",
        "      total_[h] += dev::shuffle_xor(total_[h], 1);\n",
        "",
    ),
    "the sum of weights of one warp": (
        "attention.cu",
        "attention",
        "room, [](float a, float b) { return a + b; }",
        "room, [](float a, float) { return a; }",
    ),
    "sums of every second product": ("attention.cu", "attention", "if constexpr (S::kSums > 1) add", "if (false) add"),
    "shares of the keys are not weighed": (
        "attention_f32.cu",
        "attention_f32",
        "sums[j] += values[z][j] * weight;",
        "sums[j] += values[z][j];",
    ),
    "keys of a batch": (
        "attention.cu",
        "attention",
        "rows, unit_.head_kv, 0, unit_.batch",
        "rows, unit_.head_kv, 0, 0",
    ),
    # Rows and elements.
    "no barrier before partial sums are read": ("device.h", "rows", "of_warp);\n  __syncthreads();", "of_warp);"),
    "no barrier before partial sums are written again": (
        "rows.cu",
        "rows",
        "  __syncthreads();  // earlier values may",
        "  // earlier values may",
    ),
    "codes rounded half away from zero": (
        "rows.cu",
        "rows",
        "dev::add(dev::multiply(x, s), kRound)",
        "dev::add(floorf(dev::multiply(x, s) + 0.5f), kRound)",
    ),
    "127 / a in one rounding": (
        "rows.cu",
        "rows",
        "dev::multiply(dev::divide(1.0f, a < 1e-5f ? 1e-5f : a), 127.0f)",
        "dev::divide(127.0f, a < 1e-5f ? 1e-5f : a)",
    ),
    "a layer norm without the mean": ("rows.cu", "rows", "if (job.norm == RowNorm::layer) mean =", "if (false) mean ="),
    "eps outside of the root": (
        "rows.cu",
        "rows",
        "sqrtf(sum_of_block(squares, room) / static_cast<float>(n) + job.eps)",
        "(sqrtf(sum_of_block(squares, room) / static_cast<float>(n)) + 100 * job.eps)",
    ),
    "a norm leaves out the last share": (
        "rows.cu",
        "rows",
        "z < kMostSplits; ++z) sum +=",
        "z + 1 < kMostSplits; ++z) sum +=",
    ),
    "a warp norms a row behind the last": ("rows.cu", "rows", "if (row >= job.n_row) return;  // the whole warp", ""),
    "a wide row is kept all the same": ("rows.cu", "rows", "const bool is_kept = n <= kMaxKept;", "const bool is_kept = true;"),
    "a wide row without what was added": ("rows.cu", "rows", ": load(i); };", ": job.x[row * job.x_stride + i]; };"),
    "heads turn the other way": ("rows.cu", "rows", "low[k] * cosine[k] - high[k] * sine[k]", "low[k] * cosine[k] + high[k] * sine[k]"),
    "the table's row of another token": (
        "rows.cu",
        "rows",
        "job.table + token * job.d_head",
        "job.table + head * job.d_head",
    ),
    "an id outside of the table": ("rows.cu", "rows", "id >= 0 && id < job.n_table;", "id < job.n_table;"),
    "steps of another operand": ("map.cu", "map", "b += i * job.b_step[d]", "b += i * job.a_step[d]"),
    "the last element is left out": ("map.cu", "map", "n = job.count(), first", "n = job.count() - 1, first"),
    # Windows over images.
    "pixels of the line above": ("window.cu", "window", "column >= job.width || row < 0", "row < 0"),
    "pixels behind the last line": ("window.cu", "window", " || row >= job.height)", ")"),
    "a window turned": (
        "window.cu",
        "window",
        "place.column + pixel % job.size,\n                                                          place.row + pixel / job.size",
        "place.column + pixel / job.size, place.row + pixel % job.size",
    ),
    "a sum without its bias": ("window.cu", "window", "float sum = job.bias[i];", "float sum = 0;"),
    "weights of another pixel": ("window.cu", "window", "job.weight[pixel * job.d + i]", "job.weight[i * job.size * job.size + pixel]"),
    # Features that attend to features.
    "features of another group": ("channel_attention.cu", "channel_attention", "blockIdx.x) * d,", "blockIdx.y) * d,"),
    "queries and keys change places": ("channel_attention.cu", "channel_attention", "q + pair % d, k + pair / d", "q + pair / d, k + pair % d"),
    "a softmax over the tokens' number": ("channel_attention.cu", "channel_attention", "kLogOfE / sqrtf(static_cast<float>(job.n))", "kLogOfE / static_cast<float>(job.n)"),
    "zeros beyond the image are the largest": ("window.cu", "window", "float most = -INFINITY;", "float most = 0;"),
    "NaN is not the largest": ("window.cu", "window", "x > most || x != x", "x > most"),
    "an image too far": ("window.cu", "window", "view * job.height * job.width", "view * job.height * job.height"),
}
MISTAKES |= {
    # Strips of few rows.
    "sums are added before all warps have theirs": ("linear_strip.cu", "linear_strip", "  __syncthreads();  // sums of all warps are there\n", ""),
    "a strip does not wait for earlier kernels": ("linear_strip.cu", "linear_strip", "  dev::wait_for_earlier();\n", ""),
    "a strip multiplies what lies behind the depth": ("linear_strip.cu", "linear_strip", "chunk < n_chunk_ ? *reinterpret", "true ? *reinterpret"),
    "gate and product change places": ("linear_strip.cu", "linear_strip", "is_gate ? job.gate_weight : job.weight", "is_gate ? job.weight : job.gate_weight"),
    "rows behind the last of a strip are stored": ("linear_strip.cu", "linear_strip", "row0 + row < job.n_row && column", "column"),
    "halves of eight elements change places": ("linear_strip.cu", "linear_strip", "first[4] = {low.x, high.x, low.y, high.y}", "first[4] = {low.z, high.x, low.y, high.y}"),
    "the gate's bias is left out": ("share.h", "linear_strip", "if (job.gate_bias == nullptr) return;", "return;"),
    "shares of the gate lie where those of the product do": ("linear_strip.cu", "linear_strip", "job.n_sum() - job.n_column + column, has_second", "column, has_second"),
    "a job's blocks begin one too late": ("device.h", "linear_strip", "block >= jobs.end[i]", "block > jobs.end[i]"),
    # Rows in registers.
    "zeros behind a row's end count as values": ("rows.cu", "rows", "squares += place(j) < n ?", "squares += true ?"),
    "NaN keeps the device's bits": ("rows.cu", "rows", "rounded == rounded ?", "true ?"),
    "a long row is looked up from its beginning only": ("rows.cu", "rows", "static_cast<int>(blockIdx.y) * kLookupBlock", "0"),
}
TESTS = {"linear_strip": "*linear_float_test*", "linear_int8": "*linear_int8_test*", "linear_bf16": "*linear_float_test*", "linear_f32": "*linear_float_test*", "hopper_linear_bf16": "*hopper_linear_test*", "hopper_linear_int8": "*linear_int8_test*",
         "attention": "*attention_test*", "attention_f32": "*attention_test*", "rows": "*rows_test*", "map": "*rows_test*", "window": "*window_test*", "channel_attention": "*channel_attention_test*"}  # fmt: skip


def outcome(name, ptx, folder):
    """What the tests say of a mistake: nothing where they do not see it."""
    file, kernel, old, new = MISTAKES[name]
    sources = folder / "src"
    shutil.copytree(cuda_kernels.SOURCES / "cuda/kernels", sources / "cuda/kernels")
    shutil.copytree(cuda_kernels.SOURCES / "base", sources / "base")
    place = sources / "cuda/kernels" / file
    text = place.read_text()
    assert text.count(old) >= 1, f"{name}: {file} has no {old!r}"
    place.write_text(text.replace(old, new))
    source = sources / f"cuda/kernels/{kernel}.cu"
    module = cuda_kernels.compile_ptx(source, folder, cuda_kernels.targets(source)[-1], sources, warnings=())
    others = [one for one in ptx if one.name != module.name]
    code, output = run_tests([module, *others], f"--source-file={TESTS[kernel]}", "--abort-after=1")
    shutil.rmtree(folder)
    return output if code else ""


def test_every_mistake_in_a_kernel_is_seen(ptx, tmp_path):
    names = list(MISTAKES)[:: 1 if os.environ.get("VLA_ALL_MISTAKES") else 4]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seen = dict(zip(names, pool.map(lambda name: outcome(name, ptx, tmp_path / str(names.index(name))), names)))
    for name, output in seen.items():
        said = [line for line in output.splitlines() if "ERROR" in line or "FATAL" in line]
        print(f"{name}: {said[0][:200] if said else output[-200:] if output else 'NOT SEEN'}")
    assert [name for name, output in seen.items() if not output] == []
