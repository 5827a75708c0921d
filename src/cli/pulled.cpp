// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The cache of huggingface_hub, which vla-pull fills: models--OWNER--NAME has refs/REVISION, a file with a commit, and
// snapshots/COMMIT, a folder.
#include <fmt/format.h>

#include <algorithm>
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

}  // namespace vla::cli
