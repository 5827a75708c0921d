// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "processor/processor.h"
#include "processor/support.h"

/// A small bundle with every kind of processing key, and an observation for it.
namespace vla::test {

inline void add_stats(EditableBundle& bundle, const std::string& name, const std::vector<float>& values) {
  const std::string data(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(float));
  bundle.tensors.push_back({name, DType::f32, {static_cast<std::int64_t>(values.size())}, data});
}

/// Three views of which two are needed, one state of two numbers, two actions out of four columns.
inline EditableBundle sample() {
  EditableBundle bundle;
  bundle.keys = tokenizer_keys("smol");
  bundle.set("vla.bundle_version", std::int64_t{1});
  for (const auto& [key, value] : {std::pair("vla.arch", "smolvla"),
                                   {"vla.dtype", "f32"},
                                   {"vla.source.name", "x"},
                                   {"vla.source.revision", ""},
                                   {"vla.source.converter", "test"}})
    bundle.set(key, std::string(value));
  bundle.set("observation.views",
             std::vector<std::string>{"observation.images.top", "observation.images.wrist", "observation.images.side"});
  bundle.set("observation.view_aliases", std::vector<std::string>{"", "observation.images.hand", ""});
  bundle.set("observation.view_optional", std::vector<std::int64_t>{0, 0, 0});
  bundle.set("observation.min_views", std::int64_t{2});
  bundle.set("observation.states", std::vector<std::string>{"observation.state"});
  bundle.set("observation.state_dims", std::vector<std::int64_t>{2});
  bundle.set("observation.max_text_tokens", std::int64_t{8});
  bundle.set("observation.state_names", std::vector<std::string>{"x", "y"});
  bundle.set("observation.state_units", std::vector<std::string>{"m", ""});
  bundle.set("action.names", std::vector<std::string>{"shoulder", "gripper"});
  bundle.set("action.units", std::vector<std::string>{"rad", ""});
  bundle.set("action.rate_hz", 0.0);
  bundle.set("lm.n_vocab", std::int64_t{4096});
  bundle.set("policy.d_state", std::int64_t{4});
  bundle.set("policy.d_action", std::int64_t{4});
  bundle.set("processor.recipe", std::string(R"({
    "image":  [{"op": "letterbox", "width": 4, "height": 2, "filter": "bilinear", "antialias": false,
                "align": "bottom_right", "fill": 0.0},
               {"op": "affine", "scale": 2.0, "shift": -1.0}],
    "text":   [{"op": "ensure_suffix", "suffix": "\n"}, {"op": "tokenize", "max_tokens": 8, "truncate": "right"}],
    "state":  [{"op": "normalize", "kind": "mean_std", "stats": "stats.observation.state", "eps": 0.5},
               {"op": "pad", "size": 4}],
    "action": [{"op": "take", "size": 2}, {"op": "unnormalize", "kind": "mean_std", "stats": "stats.action", "eps": 0.5}]})"));
  add_stats(bundle, "stats.observation.state.mean", {1.0f, 2.0f});
  add_stats(bundle, "stats.observation.state.std", {0.5f, 1.5f});
  add_stats(bundle, "stats.action.mean", {10.0f, 20.0f});
  add_stats(bundle, "stats.action.std", {2.0f, 0.0f});
  return bundle;
}

inline Result<Processor> create(const EditableBundle& editable) {
  const std::string bytes = editable.bytes();
  const auto bundle = Bundle::parse(bytes_of(bytes), "test.gguf");
  REQUIRE_MESSAGE(bundle.ok(), bundle.error().message());
  return Processor::create(*bundle);
}

inline Processor make(const EditableBundle& bundle = sample()) {
  auto processor = create(bundle);
  REQUIRE_MESSAGE(processor.ok(), processor.error().message());
  return std::move(*processor);
}

/// All of one grey but for one number, since an image of one colour gets a note.
inline Frame grey(std::uint8_t value) {
  std::vector<std::uint8_t> rgb(24, value);
  rgb[13] ^= 0x80;
  return {4, 2, std::move(rgb)};
}

inline Observation observation() {
  return {{{"top", grey(0)}, {"wrist", grey(255)}, {"side", std::nullopt}}, {{"state", {1.5f, 6.0f}}}, "pick up"};
}

/// The refusal of the sample with one key replaced.
inline std::string refused_with(const std::string& key, Value value) {
  EditableBundle bundle = sample();
  bundle.set(key, std::move(value));
  return refusal(create(bundle), Code::bad_bundle);
}

}  // namespace vla::test
