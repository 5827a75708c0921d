// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "support/gguf_writer.h"

#include <doctest/doctest.h>
#include <fmt/format.h>
#include <unistd.h>
#include <xxhash.h>

#include <filesystem>
#include <fstream>

namespace vla::test {
namespace {

template <class T>
void put(std::string& out, T value) {
  out.append(reinterpret_cast<const char*>(&value), sizeof(T));
}

void put_text(std::string& out, const std::string& text) {
  put<std::uint64_t>(out, text.size());
  out += text;
}

struct PutValue {
  std::string& out;

  void operator()(bool value) { put<std::uint32_t>(out, 7), put<std::uint8_t>(out, value); }
  void operator()(std::int64_t value) { put<std::uint32_t>(out, 11), put(out, value); }
  void operator()(double value) { put<std::uint32_t>(out, 12), put(out, value); }
  void operator()(const std::string& value) { put<std::uint32_t>(out, 8), put_text(out, value); }
  template <class T>
  void list(std::uint32_t type, const std::vector<T>& values) {
    put<std::uint32_t>(out, 9), put<std::uint32_t>(out, type), put<std::uint64_t>(out, values.size());
  }
  void operator()(const std::vector<std::int64_t>& values) {
    list(11, values);
    for (std::int64_t value : values) put(out, value);
  }
  void operator()(const std::vector<double>& values) {
    list(12, values);
    for (double value : values) put(out, value);
  }
  void operator()(const std::vector<std::string>& values) {
    list(8, values);
    for (const std::string& value : values) put_text(out, value);
  }
};

std::uint32_t ggml_type_of(DType type) {
  constexpr std::uint32_t kTypes[] = {0, 1, 30, 26};
  return kTypes[static_cast<int>(type)];
}

void pad(std::string& out) { out.append((32 - out.size() % 32) % 32, '\0'); }

}  // namespace

EditableBundle EditableBundle::read(const std::string& path) {
  const auto bundle = Bundle::open(path);
  REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
  EditableBundle copy;
  copy.keys = bundle->keys();
  for (const TensorInfo& tensor : bundle->tensors())
    copy.tensors.push_back({tensor.name,
                            tensor.type,
                            tensor.shape,
                            {reinterpret_cast<const char*>(tensor.data.data()), tensor.data.size()}});
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
  std::string out = "GGUF";
  Keys complete = keys;
  complete.set("vla.checksum", Value(std::string("xxh3:0000000000000000")));
  put<std::uint32_t>(out, 3), put<std::uint64_t>(out, tensors.size()), put<std::uint64_t>(out, complete.all().size());
  for (const auto& [key, value] : complete.all()) put_text(out, key), std::visit(PutValue{out}, value);
  std::uint64_t offset = 0;
  for (const Piece& piece : tensors) {
    put_text(out, piece.name);
    put<std::uint32_t>(out, static_cast<std::uint32_t>(piece.shape.size()));
    for (std::int64_t dim : piece.shape) put(out, dim);
    put(out, ggml_type_of(piece.type)), put(out, offset);
    offset += (piece.data.size() + 31) / 32 * 32;
  }
  pad(out);
  for (const Piece& piece : tensors) out += piece.data, pad(out);
  const std::size_t digits = out.find("xxh3:0000000000000000", out.find("vla.checksum")) + 5;
  out.replace(digits, 16, fmt::format("{:016x}", XXH3_64bits(out.data(), out.size())));
  return out;
}

std::string EditableBundle::write(const std::string& file_name) const { return write_file(file_name, bytes()); }

std::string source_path(const std::string& path) { return std::string(VLA_SOURCE_DIR) + "/" + path; }

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
