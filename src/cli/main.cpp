// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// One binary, one file per subcommand. This file parses, prints errors and chooses the exit code.
#include <fcntl.h>
#include <fmt/format.h>
#include <fmt/ranges.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <exception>
#include <new>
#include <system_error>

#include "cli/commands.h"
#include "cli/help.h"
#include "cli/say.h"

namespace {

constexpr const char* kFooter = R"(Start here:
  vla run policy.gguf --image top=top.png --image wrist=wrist.jpg --state 0.1,0.2,0.3 --text "pick up the red cube"
  vla inspect policy.gguf

Bundles are made with vla-convert (docs/converting.md).
Exit codes: 0 done, 1 internal, 2 usage, 3 bad_bundle, 4 bad_observation, 5 bad_action, 6 unsupported, 7 out_of_memory,
8 device, 9 io, 10 mismatch, 11 bad_request (of vla replay, a damaged recording too); 12 and up are answers of a server
(docs/protocol.md).)";

/// Prints an error. Its own further lines begin with two spaces; other line ends come from quoted text and are escaped.
int fail(const vla::Error& error) {
  std::string message = error.message();
  for (std::size_t at = 0; (at = message.find('\n', at)) != std::string::npos; ++at)
    if (message.compare(at + 1, 2, "  ") != 0) message.replace(at, 1, "\\x0a");
  vla::cli::say_lines(stderr, fmt::format("error: {}: {}\n", vla::code_name(error.code), message));
  return vla::exit_code(error.code);
}

/// Reports a wrong call in CLI11's words, in one line and with the help that explains it. CLI11 often reports a
/// misspelled option as a missing one; the unknown word shows what to correct, so it comes first.
int fail_usage(const CLI::App& app, const CLI::ParseError& parse_error) {
  const auto chosen = app.get_subcommands();
  const std::string command = chosen.empty() ? "vla" : "vla " + chosen.front()->get_name();
  const std::vector<std::string> unknown = app.remaining(true);
  std::string what =
      unknown.empty() ? parse_error.what() : fmt::format("{} does not know {}", command, fmt::join(unknown, " "));
  std::replace(what.begin(), what.end(), '\n', ' ');
  const CLI::App& asked = chosen.empty() ? app : *chosen.front();
  const std::string meant = unknown.empty() ? "" : vla::cli::suggestion(asked, unknown.front());
  return fail({vla::Code::usage, "arguments", "", what, meant + "see " + command + " --help"});
}

/// Flushes standard output. A script must not mistake output that a full disk or a closed pipe cut off for a whole
/// answer.
int finish() {
  if (std::fflush(stdout) == 0 && std::ferror(stdout) == 0) return 0;
  return fail({vla::Code::io, "standard output", "a place that can be written", std::strerror(errno)});
}

/// Occupies each standard stream that the caller has closed, and keeps it unusable. Otherwise the next file that is
/// opened, such as a recording, would take its place and receive the output.
void keep_standard_streams() {
  for (const int stream : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO})
    if (::fcntl(stream, F_GETFD) < 0) ::open("/dev/null", stream == STDIN_FILENO ? O_WRONLY : O_RDONLY);
}

int run(int argc, char** argv) {
  CLI::App app("vla: Vision-Language-Action policies, from camera frames and a sentence to robot actions.", "vla");
  app.footer(kFooter);
  app.require_subcommand(1);
  app.set_version_flag("--version", VLA_VERSION);

  vla::cli::Command command;
  const auto choose = [&](const char* name, const vla::cli::Command& chosen) {
    app.get_subcommand(name)->callback([&command, chosen] { command = chosen; });
  };
  choose("run", vla::cli::add_run(app));
  choose("inspect", vla::cli::add_inspect(app));
  choose("compare", vla::cli::add_compare(app));
  choose("doctor", vla::cli::add_doctor(app));
  choose("bench", vla::cli::add_bench(app));
  choose("quantize", vla::cli::add_quantize(app));
  choose("manual", vla::cli::add_manual(app));
#ifdef VLA_SERVER
  choose("serve", vla::cli::add_serve(app));
  choose("check", vla::cli::add_check(app));
  choose("keygen", vla::cli::add_keygen(app));
  choose("ctl", vla::cli::add_ctl(app));
  choose("replay", vla::cli::add_replay(app));
#endif

  vla::cli::format_help(app);
  std::vector<std::string> given = vla::cli::arguments(argc, argv);
  std::reverse(given.begin(), given.end());  // CLI11 expects the reverse order
  try {
    app.parse(std::move(given));
  } catch (const CLI::ParseError& parse_error) {
    if (parse_error.get_exit_code() != 0) return fail_usage(app, parse_error);
    app.exit(parse_error);  // help or version was asked for
    return finish();
  }
  const vla::Status status = command();
  return status ? finish() : fail(status.error());
}

}  // namespace

int main(int argc, char** argv) {
  keep_standard_streams();
  std::signal(SIGXFSZ, SIG_IGN);  // a file over the user's limit is an error like a full disk
  try {                           // catches exceptions of libraries
    return run(argc, argv);
  } catch (const std::bad_alloc&) {
    return fail(
        {vla::Code::out_of_memory, "vla", "", "the system has no memory left", "use a smaller model or free memory"});
  } catch (const std::system_error& exception) {
    if (std::ferror(stdout) == 0) return fail({vla::Code::internal, "vla", "", exception.what(), "please report this"});
    return fail({vla::Code::io, "standard output", "a place that can be written", exception.what()});
  } catch (const std::exception& exception) {
    return fail({vla::Code::internal, "vla", "", exception.what(), "please report this"});
  }
}
