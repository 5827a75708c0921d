// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lower/lowering.h"

namespace vla::lower {

/// Rows of queries or keys, and the norm and rotation nodes that are fused in (or null).
struct HeadRows {
  ValueId x;
  const Node *norm = nullptr, *rope = nullptr;
  ValueId weight = kNone, table = kNone;

  Operands operands() { return {{x, Needs::unit_rows}, {weight, Needs::contiguous}, {table, Needs::contiguous}}; }
  std::string text() const { return std::string(norm != nullptr ? "norm " : "") + (rope != nullptr ? "rope " : ""); }
};

/// Packs keys and values for attention, once for all attention over them.
struct PackOp {
  HeadRows k;
  ValueId v;
  bool rounds;

  Operands operands() {
    Operands all = k.operands();
    all.push_back({v, Needs::unit_rows});
    return all;
  }
  std::string text() const { return k.text() + "pack keys and values"; }
  double flop() const { return 0; }
};

struct AttentionOp {
  const Node* node;
  HeadRows q;
  bool rounds;  // computes in the dtype of the device's products; else in float32
  ValueId mask = kNone;
  // For each segment the result of PackOp. If the target does not pack: each segment's keys, then its values.
  std::vector<ValueId> packed = {};
  std::vector<std::int64_t> n_key = {};

  Operands operands() {
    Operands all = q.operands();
    all.push_back({mask, Needs::contiguous});
    for (ValueId& id : packed) all.push_back({id, Needs::anything});
    return all;
  }
  std::string text() const {
    std::string keys;
    for (const std::int64_t n : n_key) keys += (keys.empty() ? "" : " + ") + std::to_string(n);
    return q.text() + "attention " + path_of(*node) + " over " + keys + " keys" + (mask != kNone ? ", mask" : "");
  }
  double flop() const { return flop_of(*node); }
};

}  // namespace vla::lower
