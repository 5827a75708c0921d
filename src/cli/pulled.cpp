// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The cache of huggingface_hub, which vla-pull fills: models--OWNER--NAME has refs/REVISION, a file with a commit, and
// snapshots/COMMIT, a folder.
#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <optional>
#include <string_view>

#include "base/printable.h"
#include "cli/commands.h"

namespace vla::cli {
namespace {

namespace fs = std::filesystem;

constexpr std::size_t kMaxName = 512;  // bytes of OWNER/NAME@REVISION; longer than any on the hub

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

/// Whether a text is letters, digits, '_' and, but for the first, '.' and '-'.
bool is_name(std::string_view text) {
  const auto is_word = [](unsigned char c) { return std::isalnum(c) != 0 || c == '_'; };
  const auto may_follow = [&](unsigned char c) { return is_word(c) || c == '.' || c == '-'; };
  return !text.empty() && is_word(static_cast<unsigned char>(text[0])) &&
         std::all_of(text.begin(), text.end(), may_follow);
}

struct Repository {
  std::string owner, name, revision;
};

/// OWNER/NAME@REVISION, whose revision may have slashes between names; nothing for any other text.
std::optional<Repository> read_repository(const std::string& text) {
  const std::size_t slash = text.find('/'), at = text.find('@');
  if (text.size() > kMaxName || slash == std::string::npos || at == std::string::npos || at < slash) return {};
  Repository found = {text.substr(0, slash), text.substr(slash + 1, at - slash - 1), text.substr(at + 1)};
  bool is_sound = is_name(found.owner) && is_name(found.name);
  for (std::size_t from = 0; is_sound && from <= found.revision.size();) {
    const std::size_t end = std::min(found.revision.find('/', from), found.revision.size());
    is_sound = is_name(std::string_view(found.revision).substr(from, end - from));
    from = end + 1;
  }
  return is_sound ? std::optional(std::move(found)) : std::nullopt;
}

}  // namespace

std::string find_pulled(std::string& bundle) {
  if (!bundle.starts_with("hub:")) return "";
  const std::optional<Repository> found = read_repository(bundle.substr(std::strlen("hub:")));
  if (!found) return "expected hub:OWNER/NAME@REVISION, found " + printable(bundle.substr(0, kMaxName));
  const fs::path folder = cache() / fmt::format("models--{}--{}", found->owner, found->name);
  const std::string commit = first_line(folder / "refs" / found->revision);
  const fs::path snapshot = folder / "snapshots" / (commit.empty() ? found->revision : commit);
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
