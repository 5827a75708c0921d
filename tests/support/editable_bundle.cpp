// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "support/editable_bundle.h"

#include <doctest/doctest.h>
#include <fmt/format.h>
#include <unistd.h>
#include <xxhash.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>

#include "bundle/gguf_writer.h"

namespace vla::test {

EditableBundle EditableBundle::read(const std::string& path) {
  const auto bundle = Bundle::open(path);
  REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
  EditableBundle copy;
  copy.keys = bundle->keys();
  ReadBuffer buffer;
  for (const TensorInfo& tensor : bundle->tensors()) {
    const auto data = bundle->read(tensor.data, buffer);
    REQUIRE(data.ok());
    copy.tensors.push_back(
        {tensor.name, tensor.type, tensor.shape, {reinterpret_cast<const char*>(data->data()), data->size()}});
  }
  return copy;
}

EditableBundle::Piece& EditableBundle::tensor(const std::string& name) {
  for (Piece& piece : tensors)
    if (piece.name == name) return piece;
  FAIL("no tensor " << name);
  return tensors.front();
}

void EditableBundle::erase(const std::string& name) {
  REQUIRE(std::erase_if(tensors, [&](const Piece& piece) { return piece.name == name; }) == 1);
}

void EditableBundle::remove_key(const std::string& key) {
  auto values = keys.all();
  REQUIRE(values.erase(key) == 1);
  keys = Keys(std::move(values));
}

std::string EditableBundle::bytes() const {
  Keys complete = keys;
  complete.set("vla.checksum", Value(std::string("xxh3:0000000000000000")));
  std::vector<TensorInfo> infos;
  for (const Piece& piece : tensors)
    infos.push_back({piece.name, piece.type, piece.shape, std::as_bytes(std::span(piece.data))});
  std::string out = write_gguf(complete, infos);
  const std::size_t digits = out.find("xxh3:0000000000000000", out.find("vla.checksum")) + 5;
  out.replace(digits, 16, fmt::format("{:016x}", XXH3_64bits(out.data(), out.size())));
  return out;
}

std::string EditableBundle::write(const std::string& file_name) const { return write_file(file_name, bytes()); }

std::string source_path(const std::string& path) { return std::string(VLA_SOURCE_DIR) + "/" + path; }

std::string golden_path(const std::string& name) {
  static const bool made = std::system((source_path("scripts/goldens.sh")).c_str()) == 0;
  const std::string path = source_path("build/goldens/") + name;
  if (!made) {  // the script has said why, if it is there; threads of the test are not waited for
    fmt::print(stderr, "error: {}: expected golden cases, which scripts/goldens.sh makes; it failed\n", path);
    std::_Exit(1);
  }
  return path;
}

std::vector<std::string> golden_bundles() {
  std::map<std::string, std::pair<std::uintmax_t, std::string>> smallest;  // by folder
  for (const auto& arch : std::filesystem::directory_iterator(golden_path())) {
    if (!arch.is_directory()) continue;
    for (const auto& name : std::filesystem::directory_iterator(arch.path())) {
      const auto bundle = name.path() / "bundle.gguf";
      if (!std::filesystem::exists(bundle)) continue;
      const std::pair found(std::filesystem::file_size(bundle), bundle.string());
      const auto [kept, is_new] = smallest.emplace(arch.path(), found);
      if (!is_new) kept->second = std::min(kept->second, found);
    }
  }
  std::vector<std::string> paths;
  for (const auto& [folder, bundle] : smallest) paths.push_back(bundle.second);
  return paths;
}

std::vector<std::string> some_of(const std::vector<std::string>& all) {
#ifdef __SANITIZE_ADDRESS__
  static std::size_t n_call = 0;
  std::vector<std::string> some;
  for (std::size_t i = n_call++ % 3; i < all.size(); i += 3) some.push_back(all[i]);
  return some;
#else
  return all;
#endif
}

std::string scratch_path(const std::string& file_name) {
  const auto folder = std::filesystem::temp_directory_path() / fmt::format("vla-test-{}", ::getpid());
  std::filesystem::create_directories(folder);
  return (folder / file_name).string();
}

std::string write_file(const std::string& file_name, const std::string& bytes) {
  const std::string path = scratch_path(file_name);
  std::ofstream(path, std::ios::binary) << bytes;
  return path;
}

std::string read_text(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  REQUIRE_MESSAGE(file.good(), path);
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace vla::test
