// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The table of src/serve/protocols.cpp with the native protocol alone, for test_threads.
#include "serve/native/codec.h"
#include "serve/native/front.h"
#include "serve/protocols.h"

namespace vla::serve {

std::span<const Protocol> all_protocols() {
  static const Protocol kNative = {"native", nullptr, 1, open_front<NativeFront>,
                                   [](const ServerOptions& options, const v1::Description& description) {
                                     return native_names({options.preset, options.map, options.absent}, description);
                                   }};
  return {&kNative, 1};
}

}  // namespace vla::serve
