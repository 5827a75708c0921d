// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Ops of a policy whose images pass through TensorFlow and whose statistics are doubles: BitVLA.
#include <cstring>

#include "base/npy.h"
#include "processor/byte_pixels.h"
#include "processor/image_codecs.h"
#include "processor/images.h"
#include "processor/ops/columns.h"
#include "processor/ops/normalize.h"
#include "processor/ops/pipeline.h"
#include "processor/resample.h"
#include "processor/sample.h"

namespace bitvla_recipe_test {

using namespace vla;
using namespace vla::test;
using Json = nlohmann::json;

namespace {

constexpr const char* kRecipe = R"({
  "image":  [{"op": "lanczos3", "width": 4, "height": 4}, {"op": "crop_and_resize", "area": 0.9, "width": 4, "height": 4},
             {"op": "size", "width": 4, "height": 4},
             {"op": "standardize", "mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5], "arithmetic": "float32_then_bfloat16"}],
  "text":   [{"op": "lower"}, {"op": "template", "text": "<proprio_pad>do {instruction}?"},
             {"op": "views", "count": 3, "open": "", "token": "<|image_pad|>", "repeat": 5, "close": ""},
             {"op": "template", "text": "S<|eot_id|>User: {instruction}<|eot_id|>Assistant: "},
             {"op": "tokenize", "max_tokens": 64, "truncate": "right"}],
  "state":  [{"op": "normalize", "kind": "openpi_quantiles", "stats": "stats.observation.state", "eps": 1e-08},
             {"op": "clip", "low": -1.0, "high": 1.0}, {"op": "pad", "size": 2}],
  "action": [{"op": "unnormalize", "kind": "openpi_quantiles", "stats": "stats.action", "eps": 1e-08, "columns": [0]},
             {"op": "affine", "columns": [1], "scale": -2.0, "shift": 1.0}, {"op": "sign", "columns": [1]}]})";

constexpr double kLow = 0.1234567890123, kHigh = 0.9876543210987;  // float32 holds neither

void add_doubles(EditableBundle& bundle, const std::string& name, const std::vector<double>& values) {
  const std::string data(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(double));
  bundle.tensors.push_back({name, DType::f64, {static_cast<std::int64_t>(values.size())}, data});
}

EditableBundle bitvla() {
  EditableBundle bundle = sample();
  const Keys llama = tokenizer_keys("llama");
  for (const auto& [key, value] : llama.all()) bundle.set(key, value);
  bundle.set("processor.recipe", std::string(kRecipe));
  bundle.set("observation.max_text_tokens", std::int64_t{64});
  bundle.set("policy.horizon", std::int64_t{3});
  bundle.set("policy.d_state", std::int64_t{2});
  bundle.set("policy.d_action", std::int64_t{2});
  const auto tokenizer = Tokenizer::create(llama, 4096);
  const auto start = static_cast<std::int64_t>(tokenizer->encode("S<|eot_id|>User: ")->size());
  bundle.set("policy.view_starts", std::vector<std::int64_t>{start, start + 5, start + 10});
  for (const char* name : {"stats.observation.state", "stats.action"}) {
    bundle.erase(std::string(name) + ".mean");
    bundle.erase(std::string(name) + ".std");
    add_doubles(bundle, std::string(name) + ".q01", {kLow, -1.0});
    add_doubles(bundle, std::string(name) + ".q99", {kHigh, 1.0});
  }
  return bundle;
}

std::string refused(const char* pointer, const Json& value) {
  Json recipe = Json::parse(kRecipe);
  recipe[Json::json_pointer(pointer)] = value;
  EditableBundle bundle = bitvla();
  bundle.set("processor.recipe", recipe.dump());
  return refusal(create(bundle), Code::bad_bundle);
}

}  // namespace

TEST_CASE("Lanczos and corner-aligned crops have the bytes of TensorFlow, up, down and of a line") {
  const std::string file = read_text(data_path("tensorflow.npy"));
  const auto bytes = parse_npy(bytes_of(file), "tensorflow.npy");
  REQUIRE(bytes.ok());
  std::span<const std::uint8_t> rest = std::get<std::vector<std::uint8_t>>(bytes->values);
  int compared = 0;
  for (const auto& sizes : data_json("tensorflow.json")) {
    CAPTURE(sizes.dump());
    const Frame frame = frame_of(sizes[0], sizes[1]);
    const auto& rgb = std::get<std::vector<std::uint8_t>>(frame.rgb);
    const bool lanczos = sizes[4] == "lanczos3";
    const auto found = lanczos ? resample_tensorflow_lanczos3(rgb, sizes[0], sizes[1], sizes[2], sizes[3])
                               : crop_tensorflow(rgb, sizes[0], sizes[1], 0.9, sizes[2], sizes[3]);
    CHECK(std::equal(found.begin(), found.end(), rest.begin()));
    rest = rest.subspan(found.size());
    ++compared;
  }
  CHECK(rest.empty());
  CHECK(compared == 16);
}

TEST_CASE("a JPEG on the way has the pixels of TensorFlow's encoder and decoder") {
  for (const auto& [width, height] : {std::pair{40, 24}, {37, 21}}) {
    const std::string name = "jpeg_" + std::to_string(width) + "x" + std::to_string(height) + ".npy";
    const std::string file = read_text(data_path(name));
    const auto expected = parse_npy(bytes_of(file), name);
    REQUIRE(expected.ok());
    const Frame frame = frame_of(width, height);
    const auto found = codecs::through_jpeg(std::get<std::vector<std::uint8_t>>(frame.rgb), width, height, 95);
    CHECK(found == std::get<std::vector<std::uint8_t>>(expected->values));
    // As an op it works on images of any size.
    const Pipeline pipeline{width, height, {JpegRoundTrip{95}}};
    std::vector<float> planes(found.size()), wanted(found.size());
    REQUIRE(run_pipeline(frame, 0, pipeline, planes, "view").ok());
    spread_bytes(found, wanted);
    CHECK(planes == wanted);
    CHECK(pipeline_work(pipeline, width, height) == 2 * width * height);
  }
  CHECK(contains(refused("/image/0", Json{{"op", "jpeg"}, {"quality", 0}}), "processor.recipe.image[0].quality"));
}

TEST_CASE("views that follow each other without text are places of their own, and text around them moves none") {
  const Processor processor = make(bitvla());
  Observation seen = observation();
  for (auto& [name, frame] : seen.views) frame = frame_of(5, 9);
  const auto inputs = processor.encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->tokens.front() == Tokenizer::create(tokenizer_keys("llama"), 4096)->prefix().front());
  CHECK(contains(refused("/text/2/repeat", 4), "policy.view_starts"));
  CHECK(contains(refused("/text/2/count", 2), "policy.view_starts"));
}

TEST_CASE("statistics in float64 normalize and unnormalize in float64, and columns that are not named pass") {
  const Processor processor = make(bitvla());
  Observation seen = observation();
  for (auto& [name, frame] : seen.views) frame = frame_of(5, 9);
  seen.states = {{"state", {0.7f, 7.0f}}};
  const auto inputs = processor.encode(seen);
  REQUIRE_MESSAGE(inputs.ok(), inputs.error().message());
  CHECK(inputs->state[0] == static_cast<float>(2 * (double{0.7f} - kLow) / (kHigh - kLow + 1e-8) - 1));
  CHECK(inputs->state[1] == 1.0f);
  const std::vector<float> chunk = {0.3f, 0.75f, -1.5f, 0.5f, 0.0f, 0.25f};
  const auto actions = processor.decode(chunk, 3, 2, inputs->raw_state);
  REQUIRE_MESSAGE(actions.ok(), actions.error().message());
  const auto in_double = [](float x) {
    return static_cast<float>(0.5 * (double{x} + 1) * (kHigh - kLow + 1e-8) + kLow);
  };
  CHECK(*actions == std::vector<float>{in_double(0.3f), -1.0f, in_double(-1.5f), 0.0f, in_double(0.0f), 1.0f});
}

TEST_CASE("the sign of what is not a number is not a number") {
  std::vector<float> x = {NAN, -INFINITY, -0.0f, 1e-30f};
  map_columns(Sign{{0, 1, 2, 3}}, x);
  CHECK(std::isnan(x[0]));
  CHECK(std::vector<float>(x.begin() + 1, x.end()) == std::vector<float>{-1.0f, 0.0f, 1.0f});
}

TEST_CASE("fields of these ops that have no meaning are refused by their place") {
  CHECK(contains(refused("/image/1/area", 1.5), "processor.recipe.image[1].area"));
  CHECK(contains(refused("/action/0/columns", Json::array({2})), "processor.recipe.action[0].columns"));
  CHECK(contains(refused("/action/2/columns", Json::array({5})), "processor.recipe.action[2].columns"));
}

TEST_CASE("a weight in float64 and a statistic in bfloat16 are refused") {
  EditableBundle bundle = bitvla();
  for (auto& tensor : bundle.tensors)
    if (tensor.name == "stats.action.q01") tensor = {tensor.name, DType::bf16, {2}, std::string(4, '\0')};
  CHECK(contains(refusal(create(bundle), Code::bad_bundle), "f32 or f64"));
}

}  // namespace bitvla_recipe_test
