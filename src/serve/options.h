// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace vla::serve {

constexpr std::size_t kMostText = 1 << 20;  // maximum bytes of an instruction, and of --max-text

struct ServerOptions {
  std::vector<std::string> bind = {"tcp://127.0.0.1:5555"};
  bool insecure = false;                    // an address that others can reach may be bound without keys
  std::string curve_secret, curve_clients;  // files; both or neither
  std::size_t max_message = 32 << 20;       // bytes
  std::int64_t max_pixels = 1 << 24;        // all images of an act together
  std::size_t max_text = 4096;              // bytes
  std::size_t max_queue = 64;               // acts
  std::size_t max_connections = 256;        // for each protocol
  bool strict_state = false;                // refuse states beyond the bundle's bound
  std::string limits, on_limit;             // a file of limits for chunks; "note" or "refuse"
  std::string default_policy;               // the policy for acts that name none; empty: the only one

  // Options of the protocols that other clients speak (docs/drop_in.md). A protocol with an empty address is not
  // served.
  std::string openpi, gr00t, lerobot;  // ADDRESS:PORT
  std::string preset;                  // preset of names for openpi's clients
  std::vector<std::string> absent;     // views that the policy was loaded without
  std::string first_frames;            // folder for the first act's frames as the policy sees them
  std::vector<std::string> map;        // lines for all protocols; GR00T's begin with `video.` or `state.`
  bool vllm_omni = false;              // openpi's clients speak the dialect of vLLM-Omni
  std::string api_token;               // file with the secret that clients send
  bool gr00t_n1_5 = false;             // assume release N1.5 until the first act shows the release
  bool gr00t_kill = false;             // clients may stop the server
};

constexpr std::size_t kReceiptMessages = 4;  // incomplete requests together hold at most this many largest messages

}  // namespace vla::serve
