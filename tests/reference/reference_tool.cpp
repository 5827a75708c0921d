// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The processor's pure functions behind a pipe, for the comparison scripts of this folder.
//   reference_tool tokenize KEYS.json      stdin: u32 length, text, ...         stdout: u32 count, i32 ids, ...
//   reference_tool image WIDTH HEIGHT [center | pillow | FILTER]
//                                          stdin: u32 length, image file, ...   stdout: u32 count, f32 pixels, ...
//   reference_tool actions KEYS.json HORIZON D_ACTION
//                                          stdin: u32 bytes, i32 ids, ...      stdout: u32 count, f32 chunk, ...
// FILTER is one of the recipe's op "resize". KEYS.json holds the tokenizer.* keys of a bundle as one JSON object, or
// those that ActionTokens reads. An input that is refused gives count 0 and a line on stderr.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iterator>

#include "processor/action_tokens.h"
#include "processor/image.h"
#include "processor/ops/letterbox.h"
#include "processor/ops/planes.h"
#include "processor/ops/resize.h"
#include "processor/tokenizer.h"
#include "support/tokenizer_keys.h"

namespace {

bool read_item(std::string& item) {
  std::uint32_t size = 0;
  if (std::fread(&size, sizeof size, 1, stdin) != 1) return false;
  item.resize(size);
  return std::fread(item.data(), 1, size, stdin) == size;
}

template <class T>
void write_items(const std::vector<T>& items) {
  const auto count = static_cast<std::uint32_t>(items.size());
  std::fwrite(&count, sizeof count, 1, stdout);
  std::fwrite(items.data(), sizeof(T), items.size(), stdout);
  std::fflush(stdout);
}

int tokenize(const char* path) {
  std::ifstream file(path);
  const auto keys = vla::test::keys_of(nlohmann::json::parse(file, nullptr, false));
  auto tokenizer = vla::Tokenizer::create(keys, 1 << 20);
  if (!tokenizer) return std::fprintf(stderr, "%s\n", tokenizer.error().message().c_str()), 1;
  std::string text;
  while (read_item(text)) {
    auto ids = tokenizer->encode(text);
    if (!ids) std::fprintf(stderr, "%s\n", ids.error().message().c_str());
    write_items(ids ? *ids : std::vector<std::int32_t>{});
  }
  return 0;
}

int actions(const char* path, int horizon, int d_action) {
  std::ifstream file(path);
  const auto tokens = vla::ActionTokens::read(vla::test::keys_of(nlohmann::json::parse(file, nullptr, false)));
  if (!tokens || !*tokens)
    return std::fprintf(stderr, "%s\n", tokens ? "no keys" : tokens.error().message().c_str()), 1;
  std::string item;
  while (read_item(item)) {
    std::vector<std::int32_t> ids(item.size() / sizeof(std::int32_t));
    std::memcpy(ids.data(), item.data(), ids.size() * sizeof(std::int32_t));
    auto chunk = (*tokens)->decode(ids, horizon, d_action);
    if (!chunk) std::fprintf(stderr, "%s\n", chunk.error().message().c_str());
    write_items(chunk ? *chunk : std::vector<float>{});
  }
  return 0;
}

vla::Status fit(const vla::Frame& frame, int width, int height, const std::string& how, std::span<float> out) {
  if (const auto* filter = vla::find_resize_filter("resize", how))
    return vla::resize(frame, {width, height, filter}, out, "stdin");
  vla::Letterbox box;
  box.width = width;
  box.height = height;
  if (!how.empty()) box.align = vla::Letterbox::Align::center;
  box.antialias = how == "pillow";
  const vla::Status status = vla::letterbox(frame, box, out, "stdin");
  vla::affine(out, 2.0f, -1.0f);
  return status;
}

int image(int width, int height, const std::string& how) {
  std::string file;
  while (read_item(file)) {
    auto frame = vla::decode_image(std::as_bytes(std::span(file)), "stdin", {});
    std::vector<float> pixels(static_cast<std::size_t>(3) * width * height);
    vla::Status status = frame ? fit(*frame, width, height, how, pixels) : frame.error();
    if (!status) std::fprintf(stderr, "%s\n", status.error().message().c_str());
    if (!status) pixels.clear();
    write_items(pixels);
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc == 3 && std::strcmp(argv[1], "tokenize") == 0) return tokenize(argv[2]);
  if (argc == 5 && std::strcmp(argv[1], "actions") == 0)
    return actions(argv[2], std::atoi(argv[3]), std::atoi(argv[4]));
  if ((argc == 4 || argc == 5) && std::strcmp(argv[1], "image") == 0)
    return image(std::atoi(argv[2]), std::atoi(argv[3]), argc == 5 ? argv[4] : "");
  std::fputs(
      "usage: reference_tool tokenize KEYS.json | image WIDTH HEIGHT [center | pillow | FILTER] | actions KEYS.json "
      "HORIZON D_ACTION\n",
      stderr);
  return 2;
}
