// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "support/golden_case.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>

#include "base/file.h"
#include "base/npy.h"
#include "support/editable_bundle.h"
#include "support/ggml_threads.h"

namespace vla::test {

GoldenCase GoldenCase::read(const std::string& path) {
  GoldenCase golden;
  golden.path = path;
  const auto json = nlohmann::json::parse(read_text(path + "/observation.json"));
  golden.observation.text = json.at("text").get<std::string>();
  const auto& state = json.at("state");  // numbers, or several features by name
  if (state.is_object())
    golden.observation.states = state.get<std::map<std::string, std::vector<float>>>();
  else
    golden.observation.states["state"] = state.get<std::vector<float>>();
  for (const auto& [name, file] : json.at("images").items()) {
    std::optional<Frame> frame;
    if (!file.is_null()) {
      const auto bytes = read_file(path + "/" + file.get<std::string>(), 1 << 24);
      REQUIRE(bytes.ok());
      auto decoded = decode_image(*bytes, name);
      REQUIRE_MESSAGE(decoded.ok(), (decoded ? "" : decoded.error().message()));
      frame = std::move(*decoded);
    }
    golden.observation.views[name] = std::move(frame);
  }
  const std::string noise = read_text(path + "/noise.npy");
  golden.noise = std::get<std::vector<float>>(parse_npy(std::as_bytes(std::span(noise)), "noise")->values);
  return golden;
}

std::vector<Tap> GoldenCase::expected() const {
  auto taps = read_taps(path + "/expected.gguf");
  REQUIRE_MESSAGE(taps.ok(), (taps ? "" : taps.error().message()));
  return std::move(*taps);
}

std::vector<std::string> golden_paths() {
  std::vector<std::string> paths;
  for (const auto& arch : std::filesystem::directory_iterator(golden_path()))
    if (arch.is_directory())
      for (const auto& name : std::filesystem::directory_iterator(arch.path()))
        if (std::filesystem::exists(name.path() / "observation.json")) paths.push_back(name.path().string());
  std::sort(paths.begin(), paths.end());
  return paths;
}

std::unique_ptr<Engine> load_engine(const std::string& bundle, const std::string& taps, const std::string& kernels,
                                    const std::vector<Tap>& inject) {
  const int n_thread = threads_for(kernels, 2);
  auto engine = Engine::load(bundle, {.n_thread = n_thread, .kernels = kernels, .tap_pattern = taps, .inject = inject});
  REQUIRE_MESSAGE(engine.ok(), (engine ? "" : engine.error().message()));
  return std::move(*engine);
}

const Tap& find_tap(const std::vector<Tap>& taps, const std::string& path) {
  const auto found = std::find_if(taps.begin(), taps.end(), [&](const Tap& tap) { return tap.path == path; });
  REQUIRE_MESSAGE(found != taps.end(), "no tap " << path);
  return *found;
}

}  // namespace vla::test
