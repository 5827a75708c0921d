// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/gguf_writer.h"

#include <fmt/format.h>
#include <unistd.h>
#include <xxhash.h>

#include <cerrno>

#include "base/file.h"

namespace vla {
namespace {

template <class T>
void put(std::string& out, T value) {
  out.append(reinterpret_cast<const char*>(&value), sizeof(T));
}

void put_text(std::string& out, const std::string& text) {
  put<std::uint64_t>(out, text.size());
  out += text;
}

void pad(std::string& out) { out.append((kGgufAlignment - out.size() % kGgufAlignment) % kGgufAlignment, '\0'); }

/// Writes the format's number for the value's type, then the value.
struct PutValue {
  std::string& out;

  void operator()(bool value) { type(7), put<std::uint8_t>(out, value); }
  void operator()(std::int64_t value) { type(11), put(out, value); }
  void operator()(double value) { type(12), put(out, value); }
  void operator()(const std::string& value) { type(8), put_text(out, value); }
  void operator()(const std::vector<std::int64_t>& values) { list(11, values); }
  void operator()(const std::vector<double>& values) { list(12, values); }
  void operator()(const std::vector<std::string>& values) { list(8, values); }

 private:
  void type(std::uint32_t number) { put(out, number); }
  template <class T>
  void list(std::uint32_t element, const std::vector<T>& values) {
    type(9), put(out, element), put<std::uint64_t>(out, values.size());
    for (const T& value : values) {
      if constexpr (std::is_same_v<T, std::string>)
        put_text(out, value);
      else
        put(out, value);
    }
  }
};

std::uint32_t ggml_type_of(DType type) {
  constexpr std::uint32_t kTypes[] = {0, 1, 30, 26, 24, 28};  // numbers of ggml's enum ggml_type, in the order of DType
  return kTypes[static_cast<int>(type)];
}

}  // namespace

std::string write_gguf_head(const Keys& keys, std::span<const TensorInfo> tensors) {
  std::string out = "GGUF";
  put<std::uint32_t>(out, 3), put<std::uint64_t>(out, tensors.size()), put<std::uint64_t>(out, keys.all().size());
  for (const auto& [key, value] : keys.all()) put_text(out, key), std::visit(PutValue{out}, value);
  std::uint64_t offset = 0;
  for (const TensorInfo& tensor : tensors) {
    put_text(out, tensor.name);
    put<std::uint32_t>(out, static_cast<std::uint32_t>(tensor.shape.size()));
    for (std::int64_t dim : tensor.shape) put(out, dim);
    put(out, ggml_type_of(tensor.type)), put(out, offset);
    offset += (tensor.data.size() + kGgufAlignment - 1) / kGgufAlignment * kGgufAlignment;
  }
  pad(out);
  return out;
}

std::string write_gguf(const Keys& keys, std::span<const TensorInfo> tensors) {
  std::string out = write_gguf_head(keys, tensors);
  for (const TensorInfo& tensor : tensors) {
    out.append(reinterpret_cast<const char*>(tensor.data.data()), tensor.data.size());
    pad(out);
  }
  return out;
}

BundleFile::BundleFile(int file, const Keys& keys, std::span<const TensorInfo> tensors)
    : file_(file),
      state_(XXH3_createState(), [](XXH3_state_s* state) { return static_cast<int>(XXH3_freeState(state)); }) {
  XXH3_64bits_reset(state_.get());
  const std::string head = write_gguf_head(keys, tensors);
  digits_ = head.find(kNoChecksum) + kNoChecksum.find('0');
  put(std::as_bytes(std::span(head)));
}

BundleFile::~BundleFile() = default;

void BundleFile::put(std::span<const std::byte> bytes) {
  XXH3_64bits_update(state_.get(), bytes.data(), bytes.size());
  size_ += bytes.size();
  if (!failed_ && !write_all(file_, bytes)) failed_ = true, errno_ = errno;
}

Status BundleFile::copy(const Bundle& bundle, const TensorInfo& tensor, const std::function<void(std::size_t)>& see) {
  constexpr std::size_t kPart = std::size_t{1} << 22;
  for (std::size_t at = 0; at < tensor.data.size(); at += kPart) {
    VLA_TRY(const auto part, bundle.read(tensor.data.subspan(at, std::min(kPart, tensor.data.size() - at)), buffer_));
    put(part);
    see(part.size());
  }
  end_tensor();
  return {};
}

void BundleFile::put_zeros(std::size_t size) {
  static constexpr std::byte kZeros[1 << 16] = {};
  for (std::size_t left = size; left > 0;) {
    const std::size_t n = std::min(left, sizeof(kZeros));
    XXH3_64bits_update(state_.get(), kZeros, n);
    left -= n;
  }
  size_ += size;
  const auto end = static_cast<off_t>(size_);
  if (!failed_ && (::ftruncate(file_, end) != 0 || ::lseek(file_, end, SEEK_SET) != end))
    failed_ = true, errno_ = errno;
}

void BundleFile::end_tensor() {
  constexpr std::byte kZeros[kGgufAlignment] = {};
  put(std::span(kZeros).first((kGgufAlignment - size_ % kGgufAlignment) % kGgufAlignment));
}

bool BundleFile::seal() {
  const std::string digits = fmt::format("{:016x}", XXH3_64bits_digest(state_.get()));
  if (failed_) return errno = errno_, false;
  return ::pwrite(file_, digits.data(), digits.size(), static_cast<off_t>(digits_)) ==
         static_cast<ssize_t>(digits.size());
}

}  // namespace vla
