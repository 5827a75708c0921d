// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/protocols.h"

#include <algorithm>

#include "serve/door/front.h"
#include "serve/gr00t/front.h"
#include "serve/lerobot/codec.h"
#include "serve/native/codec.h"
#include "serve/native/front.h"
#include "serve/openpi/front.h"

namespace vla::serve {
namespace {

Result<Names> native_names_of(const ServerOptions& options, const v1::Description& description) {
  return native_names({options.preset, options.map, options.absent}, description);
}

Result<Names> lerobot_names_of(const ServerOptions& options, const v1::Description& description) {
  return lerobot::lerobot_names({{}, options.map, options.absent}, description);
}

const DoorFront::Door kLeRobot{"vla-door-lerobot",      "--lerobot",     "lerobot", "grpc://",
                               &ServerOptions::lerobot, lerobot_names_of};

const Protocol kProtocols[] = {
    {"native", nullptr, 1, open_front<NativeFront>, native_names_of},
    {"openpi", &ServerOptions::openpi, 1, open_front<openpi::Front>, openpi::Front::names_of},
    {"gr00t", &ServerOptions::gr00t, 1, open_front<gr00t::Front>, gr00t::Front::names_of},
    {"lerobot", &ServerOptions::lerobot, 0,
     [](net::Loop& loop, const ServerOptions& options) { return DoorFront::open(loop, options, kLeRobot); },
     lerobot_names_of},
};

}  // namespace

std::span<const Protocol> all_protocols() { return kProtocols; }

std::vector<std::string> protocols() {
  std::vector<std::string> names;
  for (const Protocol& protocol : kProtocols) names.emplace_back(protocol.name);
  return names;
}

Result<Names> names_of(const std::string& protocol, const ServerOptions& options, const v1::Description& description) {
  const auto found = std::ranges::find(kProtocols, protocol, &Protocol::name);
  if (found == std::end(kProtocols)) return Error{Code::usage, "protocol", "a protocol of this server", protocol};
  return found->names_of(options, description);
}

}  // namespace vla::serve
