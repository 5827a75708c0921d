// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

struct ggml_tensor;

namespace vla {

/// What a computation asks of a machine. `flop` counts matrix and attention products alone, two for each multiply-add:
/// everything else takes time without being the work that a peak is measured in. `bytes` counts every operand and
/// result once per node, in its stored dtype, so that a fused node asks for less.
struct Work {
  double flop = 0, bytes = 0;

  Work& operator+=(const Work& other) {
    flop += other.flop;
    bytes += other.bytes;
    return *this;
  }
};

/// The work of one of ggml's own nodes, from its operation and shapes. Of a custom node only the bytes are known: a
/// kernel that multiplies says what it does with Graph::note_work.
Work work_of(const ggml_tensor* node);

}  // namespace vla
