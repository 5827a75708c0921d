// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/workload.h"

#include <fmt/format.h>
#include <png.h>

#include <cmath>

#include "processor/ops/op.h"

namespace vla::bench {
namespace {

/// An image that compresses like a camera's: smooth shapes with sensor noise.
std::vector<std::uint8_t> draw_frame(int width, int height, std::uint32_t seed) {
  std::vector<std::uint8_t> rgb;
  rgb.reserve(static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 3);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c) {
        seed = seed * 1664525u + 1013904223u;
        const double shape = std::sin(7.0 * x / width + c) * std::cos(5.0 * y / height - c);
        rgb.push_back(static_cast<std::uint8_t>(124 + 110 * shape + static_cast<double>(seed >> 29)));
      }
  return rgb;
}

Result<std::vector<std::byte>> write_png(const std::vector<std::uint8_t>& rgb, int width, int height) {
  png_image image = {};
  image.version = PNG_IMAGE_VERSION;
  image.width = static_cast<png_uint_32>(width);
  image.height = static_cast<png_uint_32>(height);
  image.format = PNG_FORMAT_RGB;
  std::vector<std::byte> file(PNG_IMAGE_PNG_SIZE_MAX(image));
  png_alloc_size_t size = file.size();
  if (png_image_write_to_memory(&image, file.data(), &size, 0, rgb.data(), 0, nullptr) == 0)
    return Error{Code::internal, "frame", "a PNG file", image.message, "please report this"};
  file.resize(size);
  return file;
}

Result<int> count_tokens(const Processor& processor, const Observation& observation) {
  Inputs inputs;
  VLA_CHECK(processor.encode_state(observation, inputs));  // a prompt may include the state
  VLA_CHECK(processor.encode_text(observation, inputs));
  return static_cast<int>(inputs.tokens.size()) - processor.n_view_tokens();
}

/// Tokens left for the instruction after those of the views.
int most_text(const Processor& processor) { return processor.recipe().max_tokens - processor.n_view_tokens(); }

/// A text of exactly `n_token` tokens: one word repeated. Several words are tried, since tokenizers split them
/// differently.
Result<std::string> find_text(const Processor& processor, Observation observation, int n_token) {
  if (n_token == 0 && most_text(processor) == 0) return std::string();
  const int most = most_text(processor);
  if (n_token > most)
    return Error{Code::usage, "--tokens", fmt::format("at most {}, which the bundle allows", most),
                 std::to_string(n_token)};
  for (const char* word : {"the ", "a", "1", "!?"}) {
    std::string& text = observation.text.emplace();
    for (int i = 0; i < n_token; ++i) {
      text += word;
      const auto count = count_tokens(processor, observation);
      if (!count || *count > n_token) break;  // not every vocabulary has this word
      if (*count == n_token) return text;
    }
  }
  return Error{Code::usage, "--tokens", "a number of tokens that some text has", std::to_string(n_token),
               "try one more or one less"};
}

}  // namespace

Result<Workload> Workload::make(const Processor& processor, const WorkloadSizes& sizes) {
  const std::vector<std::string>& views = processor.views().names();
  Workload workload;
  const int n_view = sizes.n_view.value_or(static_cast<int>(views.size()));
  if (n_view < processor.min_views() || n_view > static_cast<int>(views.size()))
    return Error{Code::usage, "--views",
                 fmt::format("{} to {}, which the bundle allows", processor.min_views(), views.size()),
                 std::to_string(n_view)};
  const Recipe& recipe = processor.recipe();
  for (int i = 0; i < static_cast<int>(views.size()); ++i) {
    const std::string& view = views[static_cast<std::size_t>(i)];
    workload.observation_.views[view] = std::nullopt;
    if (i >= n_view) continue;
    const CameraSize camera = recipe.fit->camera_size(i).value_or(CameraSize{recipe.width, recipe.height});
    const int width = sizes.width > 0 ? sizes.width : camera.width;
    const int height = sizes.height > 0 ? sizes.height : camera.height;
    if (i == 0) workload.width_ = width, workload.height_ = height;
    const auto rgb = draw_frame(width, height, static_cast<std::uint32_t>(i));
    VLA_TRY(std::vector<std::byte> png, write_png(rgb, width, height));
    workload.frames_.push_back({view, std::move(png)});
  }
  const std::vector<std::string>& states = processor.states().names();
  for (std::size_t i = 0; i < states.size(); ++i)
    workload.observation_.states[states[i]].assign(static_cast<std::size_t>(processor.state_dims()[i]), 0.0f);
  workload.n_text_ = sizes.n_text.value_or(most_text(processor));
  VLA_TRY(workload.observation_.text, find_text(processor, workload.observation_, workload.n_text_));
  return workload;
}

Status Workload::decode() {
  for (const File& file : frames_) {
    VLA_TRY(observation_.views[file.view], decode_image(file.png, file.view));
  }
  return {};
}

}  // namespace vla::bench
