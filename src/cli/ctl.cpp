// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <filesystem>
#include <nlohmann/json.hpp>

#include "cli/commands.h"
#include "cli/say.h"
#include "serve/control.h"

namespace vla::cli {
namespace {

using nlohmann::ordered_json;

struct CtlOptions {
  std::string path, what, policy;
};

/// The order to load NAME=BUNDLE, or a file, whose name without `.gguf` is the policy's.
Result<ordered_json> load_order(const std::string& text) {
  const auto [name, bundle] = serve::named_bundle(text);
  VLA_CHECK(serve::check_policy_name(name));
  std::error_code failed;
  // The server may run in another folder, so a path must be absolute; the name of a pulled bundle is no path.
  const std::string absolute = bundle.starts_with("hub:") ? bundle : std::filesystem::absolute(bundle, failed).string();
  if (failed) return Error{Code::io, bundle, "a path", failed.message()};
  return ordered_json{{"do", "load"}, {"policy", name}, {"bundle", absolute}};
}

void print(const ordered_json& reply) {
  if (const auto policies = reply.find("policies"); policies != reply.end()) {
    for (const ordered_json& policy : *policies)
      say(stdout, "{:<24} {:>10.1f} MB  {:<12} {}  {}\n", policy.value("policy", ""), policy.value("memory_mb", 0.0),
          policy.value("arch", ""), policy.value("checksum", ""), policy.value("bundle", ""));
  } else if (reply.contains("load_ms")) {
    say(stdout, "{} answers: loaded in {:.1f} s, warm after {:.1f} ms, {:.1f} MB\n", reply.value("policy", ""),
        reply.value("load_ms", 0.0) / 1e3, reply.value("warm_up_ms", 0.0), reply.value("memory_mb", 0.0));
  }
}

Status ctl(const CtlOptions& options) {
  const bool needs_policy = options.what == "load" || options.what == "unload";
  if (needs_policy == options.policy.empty())
    return Error{Code::usage, "vla ctl " + options.what, needs_policy ? "a policy" : "nothing more", options.policy,
                 "vla ctl --help has examples"};
  ordered_json given = {{"do", options.what}};
  if (options.what == "load") {
    VLA_TRY(given, load_order(options.policy));
  } else if (options.what == "unload") {
    given["policy"] = options.policy;
  }
  VLA_TRY(const ordered_json reply, serve::order(options.path, given));
  print(reply);
  return {};
}

}  // namespace

Command add_ctl(CLI::App& app) {
  auto options = std::make_shared<CtlOptions>();
  CLI::App* command = app.add_subcommand("ctl", "Load, swap and unload policies of a vla serve that runs");
  command->footer(
      "  vla serve pick=pick.gguf --control /run/user/1000/vla.sock\n"
      "  vla ctl /run/user/1000/vla.sock load place=place.gguf   # a further policy; acts name theirs\n"
      "  vla ctl /run/user/1000/vla.sock load pick=pick-v2.gguf  # takes the place of pick; no act is lost\n"
      "  vla ctl /run/user/1000/vla.sock unload place            # returns when its memory is free\n"
      "  vla ctl /run/user/1000/vla.sock drain                   # answers what waits, then the server ends");
  command->add_option("SOCKET", options->path, "The --control of the server")->type_name("")->required();
  command
      ->add_option(
          "ORDER", options->what,
          "list: the policies that answer. load: a bundle, which answers under its name once it is warm. unload: "
          "a policy, once its acts are answered. drain: take no further acts, answer those in line, and stop")
      ->type_name("")
      ->required()
      ->check(CLI::IsMember({"list", "load", "unload", "drain"}));
  command
      ->add_option("POLICY", options->policy,
                   "load: NAME=FILE, or a file that gives its own name; unload: the name that list has")
      ->type_name("");
  return [options] { return ctl(*options); };
}

}  // namespace vla::cli
