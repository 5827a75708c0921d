// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/file.h"
#include "bundle/gguf_writer.h"
#include "fuzz/act_target.h"
#include "fuzz/recipe_target.h"

/// The bytes are the recipe of a bundle that is otherwise that of the regressions.
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const auto file = vla::read_file(VLA_SOURCE_DIR "/tests/fuzz/regressions/bundle/smallest", 1 << 20);
  if (!file) std::abort();
  static const auto base = vla::Bundle::parse(*file, "smallest");  // unlike open() it has the tensors in memory
  if (!base) std::abort();
  vla::Keys keys = base->keys();
  keys.set("processor.recipe", std::string(reinterpret_cast<const char*>(data), size));
  const std::string bytes = vla::fuzz::sealed(vla::write_gguf(keys, base->tensors()));
  const auto bundle = vla::Bundle::parse(std::as_bytes(std::span(bytes)), "fuzz.gguf");
  if (!bundle) std::abort();
  const auto processor = vla::Processor::create(*bundle);
  if (processor) vla::fuzz::check_recipe(*bundle, vla::fuzz::plain_observation(*processor));
  return 0;
}
