// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "lower/lowering.h"

/// Words for the operations that every target has: what they compute, as a printed program says it.
namespace vla::lower {

std::string words_of(const Prepared& rows);
std::string words_of(const LinearOp& op);
std::string words_of(const AttentionOp& op);
std::string words_of(const RowOp& op);
std::string words_of(const CopyOp& op);
std::string words_of(const LookupOp& op);
std::string words_of(const PatchesOp& op);
std::string words_of(const WindowOp& op);
std::string words_of(const ChannelOp& op);

}  // namespace vla::lower
