// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace vla::serve {

struct ServerOptions {
  std::vector<std::string> bind = {"tcp://127.0.0.1:5555"};
  bool insecure = false;                    // an address that others can reach may be bound without keys
  std::string curve_secret, curve_clients;  // files; both or neither
  std::size_t max_message = 32 << 20;       // bytes
  std::int64_t max_pixels = 1 << 24;        // of the images of an act
  std::size_t max_text = 4096;              // bytes
  std::size_t max_queue = 64;               // acts
  std::size_t max_connections = 256;        // of each protocol
  bool strict_state = false;                // refuse states beyond the bundle's bound
};

constexpr std::size_t kReceiptMessages = 4;  // requests that are being received hold so many times the largest message

}  // namespace vla::serve
