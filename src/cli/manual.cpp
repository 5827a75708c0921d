// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Prints --help as a man page and as bash completions, from the commands themselves.
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <sstream>

#include "cli/commands.h"
#include "cli/help.h"
#include "cli/say.h"

namespace vla::cli {
namespace {

std::vector<const CLI::App*> commands_of(const CLI::App& app) {
  return app.get_subcommands([](const CLI::App*) { return true; });
}

/// Escapes a text for roff: hyphens that can be copied, no escapes, and no line that starts with a request.
std::string roff(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if ((c == '.' || c == '\'') && (out.empty() || out.back() == '\n')) out += "\\&";
    if (c == '\\')
      out += "\\e";
    else if (c == '-')
      out += "\\-";
    else
      out += c;
  }
  return out;
}

std::string roff_options(const CLI::App& command) {
  std::string text;
  for (const CLI::Option* option : command.get_options()) {
    const std::string value = option_value(*option);
    const std::string name = option->get_name(false, true);
    text += fmt::format(".TP\n.B {}{}\n{}\n", roff(name), value.empty() ? "" : " " + roff(value),
                        roff(option_text(*option)));
  }
  return text;
}

/// Keeps a footer's lines as they are.
std::string roff_lines(const std::string& text) {
  return text.empty() ? "" : fmt::format(".PP\n.nf\n{}\n.fi\n", roff(text));
}

std::string man_page(const CLI::App& app) {
  std::string text = fmt::format(".TH VLA 1 \"\" \"vla {}\" \"User Commands\"\n.SH NAME\nvla \\- {}\n", VLA_VERSION,
                                 roff(app.get_description().substr(app.get_description().find(' ') + 1)));
  text += ".SH SYNOPSIS\n.B vla\n.I COMMAND\n[\n.I OPTIONS\n]\n.SH COMMANDS\n";
  for (const CLI::App* command : commands_of(app))
    text += fmt::format(".SS vla {}\n{}.\n{}{}", roff(command->get_name()), roff(command->get_description()),
                        roff_options(*command), roff_lines(command->get_footer()));
  return text + ".SH NOTES\n" + roff_lines(app.get_footer());
}

std::string option_words(const CLI::App& command) {
  std::vector<std::string> words;
  for (const CLI::Option* option : command.get_options())
    for (const std::string& name : option->get_lnames()) words.push_back("--" + name);
  return fmt::format("{}", fmt::join(words, " "));
}

std::string bash_completion(const CLI::App& app) {
  std::string names, words, values;
  for (const CLI::App* command : commands_of(app)) {
    names += (names.empty() ? "" : " ") + command->get_name();
    words += fmt::format("    {}) words='{}' ;;\n", command->get_name(), option_words(*command));
    for (const CLI::Option* option : command->get_options())
      if (const auto choices = option_choices(*option); !choices.empty())
        values += fmt::format("    {}:--{}) values='{}' ;;\n", command->get_name(), option->get_lnames().front(),
                              fmt::join(choices, " "));
  }
  return fmt::format(R"(# bash completion of vla {}; made by: vla manual --bash-completion
_vla() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} command=${{COMP_WORDS[1]}} words= values=
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W '{}' -- "$current"))
    return
  fi
  case $command:${{COMP_WORDS[COMP_CWORD-1]}} in
{}  esac
  case $command in
{}  esac
  if [ -n "$values" ]; then
    COMPREPLY=($(compgen -W "$values" -- "$current"))
  elif [ "${{current:0:1}}" = - ]; then
    COMPREPLY=($(compgen -W "$words" -- "$current"))
  fi
}}
complete -o default -F _vla vla
)",
                     VLA_VERSION, names, values, words);
}

}  // namespace

Command add_manual(CLI::App& app) {
  auto bash = std::make_shared<bool>(false);
  CLI::App* command = app.add_subcommand("manual", "Print the help of all commands as a man page, or for bash");
  command->footer("  vla manual | man -l -\n  source <(vla manual --bash-completion)");
  command->add_flag("--bash-completion", *bash, "Print what bash completes instead");
  return [&app, bash] {
    say_lines(stdout, *bash ? bash_completion(app) : man_page(app));
    return Status();
  };
}

}  // namespace vla::cli
