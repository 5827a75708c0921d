// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/seen_sizes.h"

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "base/file.h"

namespace vla::serve {
namespace {

using nlohmann::ordered_json;

std::string name_of(const Engine& engine) {
  return std::filesystem::path(engine.robot().bundle().path()).filename().string();
}

/// Reads an entry. Throws nlohmann's exception if it is invalid.
std::pair<std::string, ActShape> entry_of(const ordered_json& json) {
  ActShape act;
  InputShape& in = act.inputs;
  json.at("embodiment").get_to(act.embodiment);
  for (const auto& [key, value] : {std::pair{"width", &in.width},
                                   {"height", &in.height},
                                   {"views", &in.n_view},
                                   {"tokens", &in.n_text},
                                   {"state", &in.d_state}})
    json.at(key).get_to(*value);
  json.at("which_views").get_to(in.views), json.at("continues").get_to(in.steered);
  if (json.contains("sentences"))
    json.at("sentences").get_to(in.text.sentences), json.at("seen_tokens").get_to(in.text.n_seen);
  return {json.at("bundle").get<std::string>(), act};
}

ordered_json json_of(const std::string& bundle, const ActShape& act) {
  const InputShape& in = act.inputs;
  ordered_json json = {{"bundle", bundle},    {"embodiment", act.embodiment}, {"width", in.width},
                       {"height", in.height}, {"views", in.n_view},           {"tokens", in.n_text},
                       {"state", in.d_state}, {"which_views", in.views},      {"continues", in.steered}};
  if (!in.text.sentences.empty()) json["sentences"] = in.text.sentences, json["seen_tokens"] = in.text.n_seen;
  return json;
}

}  // namespace

Result<std::unique_ptr<SeenSizes>> SeenSizes::open(std::string path, std::function<void(const Error&)> tell) {
  std::unique_ptr<SeenSizes> sizes(new SeenSizes(std::move(path), std::move(tell)));
  VLA_CHECK(sizes->read());
  return sizes;
}

Status SeenSizes::read() {
  std::error_code failed;
  if (!std::filesystem::exists(path_, failed) && !failed) return {};
  VLA_TRY(const std::vector<std::byte> bytes, read_file(path_, std::size_t{1} << 20));
  try {
    const auto* text = reinterpret_cast<const char*>(bytes.data());
    for (const ordered_json& one : ordered_json::parse(text, text + bytes.size())) all_.push_back(entry_of(one));
  } catch (const ordered_json::exception& problem) {
    return Error{Code::usage, path_, "sizes of acts, as vla serve --warm-up writes them", problem.what(),
                 "remove the file or name another one"};
  }
  if (all_.size() > kMost) all_.erase(all_.begin(), all_.end() - kMost);
  return {};
}

std::vector<ActShape> SeenSizes::of(const Engine& engine) const {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::vector<ActShape> sizes;
  for (const auto& [bundle, act] : all_)
    if (bundle == name_of(engine)) sizes.push_back(act);
  return sizes;
}

void SeenSizes::add(const Engine& engine) {
  const std::optional<ActShape> act = engine.last_shape();
  if (!act) return;
  const std::lock_guard<std::mutex> lock(mutex_);
  const Entry entry(name_of(engine), *act);
  if (std::find(all_.begin(), all_.end(), entry) != all_.end()) return;
  if (all_.size() == kMost) all_.erase(all_.begin());
  all_.push_back(entry);
  const Status written = write_file(path_, text());
  if (!written && tell_) std::exchange(tell_, nullptr)(written.error());
}

/// Writes one entry per line.
std::string SeenSizes::text() const {
  std::string lines;
  for (const auto& [bundle, act] : all_) lines += (lines.empty() ? "[" : ",\n ") + json_of(bundle, act).dump();
  return lines + "]\n";
}

}  // namespace vla::serve
