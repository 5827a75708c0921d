// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace vla::serve {

constexpr std::size_t kMostText = 1 << 20;  // bytes of an instruction, and so of --max-text

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
  std::string limits, on_limit;             // a file of what chunks may be; then "note" or "refuse"
  std::string default_policy;               // of acts that name none; empty: the only one

  // Of the protocols that other clients speak (docs/drop_in.md); an empty address: not served.
  std::string openpi, gr00t, lerobot;  // ADDRESS:PORT
  std::string preset;                  // of openpi's clients
  std::vector<std::string> absent;     // views that the policy was loaded without
  std::string first_frames;            // a folder for what the policy sees of the first act's frames
  std::vector<std::string> map;        // lines for both; those of GR00T begin with a modality and a dot
  bool vllm_omni = false;              // openpi's clients speak the dialect of vLLM-Omni
  std::string api_token;               // a file
  bool gr00t_n1_5 = false;             // the client is of that release, also before its first act
  bool gr00t_kill = false;             // clients may stop the server
};

constexpr std::size_t kReceiptMessages = 4;  // requests that are being received hold so many times the largest message

}  // namespace vla::serve
