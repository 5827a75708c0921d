// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Names of emulated kernels, so that a program holds the real ones too. Included in front of the kernels' sources, and
/// in front of the table that a machine chooses from where it is to choose the emulated ones.
#define kLinearAvx512 kEmulatedLinearAvx512
#define kAvx512Kernels kEmulatedAvx512Kernels
#define kTernaryAvx512 kEmulatedTernaryAvx512
#define kInt4Avx512 kEmulatedInt4Avx512
#define kInt8Avx512 kEmulatedInt8Avx512
#define kLinearAvx512Bf16 kEmulatedLinearAvx512Bf16
#define kAttentionAvx512Bf16 kEmulatedAttentionAvx512Bf16
#define kLinearAmx kEmulatedLinearAmx
#define kTernaryAmx kEmulatedTernaryAmx
#define kInt4Amx kEmulatedInt4Amx
#define kInt8Amx kEmulatedInt8Amx
#define kAttentionAmx kEmulatedAttentionAmx
