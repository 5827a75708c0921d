// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// For reference loops and registers of emulated instructions, which touch no memory that a kernel may get wrong:
/// sanitizers do not watch them, whose checks take ten times as long. They call builtins and each other, since
/// functions that are watched are not inlined in them.
#define VLA_UNWATCHED __attribute__((no_sanitize("address", "undefined")))
