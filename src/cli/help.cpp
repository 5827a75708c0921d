// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cli/help.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <regex>
#include <sstream>

#include "base/edit_distance.h"

namespace vla::cli {
namespace {

constexpr std::size_t kNames = 34, kWidth = 120;  // columns

std::string wrap(const std::string& text, std::size_t width) {
  std::istringstream words(text);
  std::string word, wrapped, line;
  while (words >> word) {
    if (!line.empty() && line.size() + 1 + word.size() > width) wrapped += line + "\n", line.clear();
    line += (line.empty() ? "" : " ") + word;
  }
  return wrapped + line;
}

/// CLI11 prints `INT:INT in [0 - 512]`, `TEXT:{text,json}` or `TEXT:FILE`: the kind, then the accepted values.
struct Accepted {
  std::string kind, range, choices;

  explicit Accepted(const std::string& type) {
    static const std::regex kRange(R"((?:\w+):\w+ in \[(\S+) - (\S+)\])"), kChoices(R"(\w+:\{(.*)\})");
    std::smatch found;
    if (std::regex_match(type, found, kRange))
      kind = "N", range = fmt::format("{} to {}", found[1].str(), found[2].str());
    else if (std::regex_match(type, found, kChoices))
      kind = std::regex_replace(found[1].str(), std::regex(","), "|");
    else
      kind = std::regex_replace(type, std::regex("^TEXT:"), "");
  }
};

class HelpFormatter final : public CLI::Formatter {
 public:
  HelpFormatter() { column_width(kNames); }

 private:
  std::string make_option_opts(const CLI::Option* option) const override {
    const std::string value = option_value(*option);
    return value.empty() || option->get_positional() ? "" : " " + value;
  }
  std::string make_option_desc(const CLI::Option* option) const override {
    return wrap(option_text(*option), kWidth - kNames);
  }
};

std::vector<std::string> known_words(const CLI::App& app) {
  std::vector<std::string> words;
  for (const CLI::Option* option : app.get_options())
    for (const std::string& name : option->get_lnames()) words.push_back("--" + name);
  for (const CLI::App* command : app.get_subcommands([](const CLI::App*) { return true; }))
    words.push_back(command->get_name());
  return words;
}

}  // namespace

std::string option_value(const CLI::Option& option) {
  if (!option.get_option_text().empty()) return option.get_option_text();
  if (option.get_type_size() == 0) return "";
  const bool many = option.get_expected_max() == CLI::detail::expected_max_vector_size;
  return Accepted(option.get_type_name()).kind + (many ? " ..." : "");
}

std::string option_text(const CLI::Option& option) {
  std::vector<std::string> facts;
  const std::string range = Accepted(option.get_type_name()).range, given = option.get_default_str();
  if (option.get_required()) facts.push_back("required");
  if (!range.empty()) facts.push_back(range);
  if (option.get_type_size() != 0 && !given.empty())
    facts.push_back("default " + std::regex_replace(given, std::regex(R"(^\[(.*)\]$)"), "$1"));
  for (const CLI::Option* other : option.get_excludes()) facts.push_back("not with " + other->get_name());
  for (const CLI::Option* other : option.get_needs()) facts.push_back("only with " + other->get_name());
  const std::string text = option.get_description();
  return facts.empty() ? text : fmt::format("{} ({})", text, fmt::join(facts, "; "));
}

std::vector<std::string> option_choices(const CLI::Option& option) {
  std::istringstream kind(option.get_type_size() == 0 ? "" : Accepted(option.get_type_name()).kind);
  std::vector<std::string> choices;
  for (std::string word; std::getline(kind, word, '|');) choices.push_back(word);
  return choices.size() > 1 ? choices : std::vector<std::string>();
}

void format_help(CLI::App& app) {
  const auto formatter = std::make_shared<HelpFormatter>();
  app.formatter(formatter);
  for (CLI::App* command : app.get_subcommands([](CLI::App*) { return true; })) command->formatter(formatter);
}

std::vector<std::string> arguments(int argc, char** argv) {
  std::vector<std::string> given(argv + std::min(argc, 1), argv + argc);
  if (!given.empty() && given.front() == "help") {
    given.erase(given.begin());
    given.push_back("--help");
  }
  return given;
}

std::string suggestion(const CLI::App& app, const std::string& unknown) {
  const std::string given = unknown.substr(0, unknown.find('=')).substr(0, 64);
  std::string best;
  std::size_t least = std::max<std::size_t>(2, given.size() / 4) + 1;
  for (const std::string& word : known_words(app))
    if (const std::size_t d = edit_distance(given, word); d < least) least = d, best = word;
  return best.empty() ? "" : fmt::format("did you mean {}? ", best);
}

}  // namespace vla::cli
