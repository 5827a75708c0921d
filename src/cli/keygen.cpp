// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>

#include "cli/commands.h"
#include "cli/say.h"
#include "zmtp/curve.h"

namespace vla::cli {

Command add_keygen(CLI::App& app) {
  auto prefix = std::make_shared<std::string>();
  CLI::App* command = app.add_subcommand("keygen", "Make a key pair for encrypted connections to vla serve");
  command->footer(
      "  vla keygen server      # server.secret stays on the server; clients need server.public\n"
      "  vla keygen robot7      # robot7.secret stays on the robot; robot7.public goes into the server's "
      "--curve-clients");
  command->add_option("PREFIX", *prefix, "Writes PREFIX.secret and PREFIX.public; neither may exist")
      ->type_name("")
      ->required();
  return [prefix]() -> Status {
    VLA_CHECK(zmtp::write_key_pair(*prefix));
    say(stdout, "{0}.secret\n{0}.public\n", *prefix);
    return {};
  };
}

}  // namespace vla::cli
