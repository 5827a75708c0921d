// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The cache of huggingface_hub, which vla-pull fills: models--OWNER--NAME has refs/REVISION, a file with a commit, and
// snapshots/COMMIT, a folder.
#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <regex>

#include "base/printable.h"
#include "cli/commands.h"

namespace vla::cli {
namespace {

namespace fs = std::filesystem;

std::string variable(const char* name) {
  const char* value = std::getenv(name);
  return value != nullptr ? value : "";
}

fs::path cache() {
  if (const std::string folder = variable("HF_HUB_CACHE"); !folder.empty()) return folder;
  if (const std::string folder = variable("HF_HOME"); !folder.empty()) return fs::path(folder) / "hub";
  const std::string folder = variable("XDG_CACHE_HOME");
  return (folder.empty() ? fs::path(variable("HOME")) / ".cache" : fs::path(folder)) / "huggingface/hub";
}

/// The first line of a small file, or nothing.
std::string first_line(const fs::path& path) {
  std::error_code failed;
  std::string line;
  if (fs::is_regular_file(path, failed)) {
    std::ifstream in(path);
    std::getline(in, line);
  }
  return line.size() <= 64 ? line : "";
}

}  // namespace

std::string find_pulled(std::string& bundle) {
  if (!bundle.starts_with("hub:")) return "";
  static const std::regex kForm(R"(hub:(\w[\w.-]*)/(\w[\w.-]*)@(\w[\w.-]*(?:/\w[\w.-]*)*))");
  std::smatch found;
  if (!std::regex_match(bundle, found, kForm)) return "expected hub:OWNER/NAME@REVISION, found " + printable(bundle);
  const fs::path folder = cache() / fmt::format("models--{}--{}", found[1].str(), found[2].str());
  const std::string commit = first_line(folder / "refs" / found[3].str());
  const fs::path snapshot = folder / "snapshots" / (commit.empty() ? found[3].str() : commit);
  std::vector<std::string> files;
  std::error_code failed;
  for (const auto& entry : fs::directory_iterator(snapshot, failed))
    if (entry.path().extension() == ".gguf") files.push_back(entry.path().string());
  if (files.empty())
    return fmt::format("no bundle in {}: vla-pull {}", printable(snapshot.string()), printable(bundle));
  std::sort(files.begin(), files.end());
  if (files.size() > 1)
    return fmt::format("{} bundles in {}: give the file", files.size(), printable(snapshot.string()));
  bundle = files.front();
  return "";
}

Status check_policy_name(const std::string& name) {
  const auto is_plain = [](unsigned char c) { return std::isalnum(c) != 0 || c == '.' || c == '_' || c == '-'; };
  if (!name.empty() && name.size() <= 64 && std::all_of(name.begin(), name.end(), is_plain)) return {};
  return Error{Code::usage, "policy", "a name of 1 to 64 letters, digits, '.', '_' and '-'", printable(name),
               "NAME=FILE gives a bundle another name"};
}

std::pair<std::string, std::string> named_bundle(const std::string& text) {
  const std::size_t equals = text.find('=');
  if (equals != std::string::npos && check_policy_name(text.substr(0, equals)))
    return {text.substr(0, equals), text.substr(equals + 1)};
  std::string name = text.substr(text.rfind('/') + 1);
  if (name.ends_with(".gguf")) name.resize(name.size() - 5);
  return {name, text};
}

}  // namespace vla::cli
