// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

#include "net/loop.h"
#include "serve/front.h"
#include "serve/names.h"
#include "serve/options.h"

namespace vla::serve {

/// A protocol and its front end.
struct Protocol {
  const char* name;
  std::string ServerOptions::*address;  // its address; not served if empty; null: always served
  std::size_t n_descriptor;             // descriptors that a connection takes in this process
  Result<std::unique_ptr<Front>> (*open)(net::Loop& loop, const ServerOptions& options);
  Result<Names> (*names_of)(const ServerOptions& options, const v1::Description& description);

  bool is_wanted(const ServerOptions& options) const { return address == nullptr || !(options.*address).empty(); }
};
template <class FrontEnd>
Result<std::unique_ptr<Front>> open_front(net::Loop& loop, const ServerOptions& options) {
  VLA_TRY(std::unique_ptr<Front> front, FrontEnd::open(loop, options));
  return front;
}

/// The protocols that a server may speak: native, openpi, gr00t, lerobot.
std::span<const Protocol> all_protocols();
/// Their names.
std::vector<std::string> protocols();

/// The names that a protocol's clients use for a policy's views and states, with these options. Errors: usage, also if
/// the protocol cannot carry the policy's inputs.
Result<Names> names_of(const std::string& protocol, const ServerOptions& options, const v1::Description& description);

}  // namespace vla::serve
