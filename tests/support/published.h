// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

/// Bundles of published sizes in any encoding, without weights.
#include <sys/mman.h>
#include <unistd.h>

#include <cstring>
#include <set>
#include <utility>
#include <variant>

#include "bench/random_bundle.h"
#include "bundle/gguf_writer.h"
#include "graph/rounding.h"
#include "policies/policy.h"

namespace vla::test {

/// A bundle whose large matrices are codes, which mean zero. It is kept in memory and gone with the object.
class CodedBundle {
 public:
  /// Encodes the matrices that `vla quantize` would. Errors: those of reading `floats`, io.
  static Result<CodedBundle> make(const Bundle& floats, const PolicyEntry& entry, Rounding codes) {
    ParamList list(floats.keys(), &floats);
    const std::unique_ptr<Policy> policy = entry.make(list);
    VLA_CHECK(list.report(entry.name, {}));
    CodedBundle made(codes);
    for (const Param& param : list.params()) made.add(param);
    if (!made.write(floats.keys())) return Error{Code::io, "codes", "room in memory", std::strerror(errno)};
    return made;
  }

  CodedBundle(CodedBundle&& other) noexcept : codes_(other.codes_), file_(std::exchange(other.file_, -1)) {}
  CodedBundle& operator=(CodedBundle&&) = delete;
  ~CodedBundle() {
    if (file_ >= 0) ::close(file_);
  }
  std::string path() const { return "/proc/self/fd/" + std::to_string(file_); }

 private:
  explicit CodedBundle(Rounding codes) : codes_(codes), file_(::memfd_create("codes", MFD_CLOEXEC)) {}

  void add_tensor(const std::string& name, DType type, std::vector<std::int64_t> shape, std::size_t size) {
    static constexpr std::byte kNothing = {};
    tensors_.push_back({name, type, std::move(shape), {&kNothing, size}});
  }
  void add(const Param& param) {
    const Encoding encoding = resident_encoding(param, codes_);
    if (encoding == param.encoding)
      return add_tensor(param.name, param.source->type, param.source->shape, param.source->data.size());
    std::vector<std::int64_t> shape = param.shape;
    shape[0] = static_cast<std::int64_t>(dtype_size(encoding.type, shape[0]));
    if (encoding.type == DType::int4) int4_.insert(param.name);
    add_tensor(param.name, DType::i8, std::move(shape), encoding.size(param.count()));
    const std::int64_t n = encoding.n_scale(param.count());
    add_tensor(scales_name(param.name, encoding), DType::f32, {n}, dtype_size(DType::f32, n));
  }

  /// Zeros are no int4 codes, so those take memory.
  static void put_blocks(BundleFile& out, std::size_t size) {
    Int4Block zero = {0, {}};
    zero.codes.fill(Int4Block::kZero << 4 | Int4Block::kZero);
    const std::vector<Int4Block> zeros(1 << 14, zero);
    const auto bytes = std::as_bytes(std::span(zeros));
    for (std::size_t at = 0; at < size; at += bytes.size()) out.put(bytes.first(std::min(bytes.size(), size - at)));
  }
  bool write(Keys keys) {
    keys.set("vla.checksum", std::string(kNoChecksum));
    keys.set("vla.dtype", std::string(codes_ == Rounding::int4 ? "int4" : "int8"));
    BundleFile out(file_, keys, tensors_);
    for (const TensorInfo& tensor : tensors_) {
      if (int4_.contains(tensor.name))
        put_blocks(out, tensor.data.size());
      else
        out.put_zeros(tensor.data.size());
      out.end_tensor();
    }
    return file_ >= 0 && out.seal();
  }

  Rounding codes_;
  int file_;
  std::vector<TensorInfo> tensors_;  // only the sizes of their data are used
  std::set<std::string> int4_;
};

/// A bundle of an architecture's published size, of floats or codes.
class PublishedBundle {
 public:
  /// `stored`: "bf16", "f32", "int8" or "int4". Errors: those of RandomBundle and CodedBundle.
  static Result<PublishedBundle> make(const PolicyEntry& entry, const std::string& stored) {
    bench::RandomSizes sizes = {.dtype = stored == "f32" ? DType::f32 : DType::bf16, .is_filled = false};
    const Keys keys = entry.published();
    if (keys.has("policy.n_view")) {
      VLA_TRY(sizes.n_view, keys.integer("policy.n_view", {1, 16}));
    }
    VLA_TRY(bench::RandomBundle floats, bench::RandomBundle::make(entry.name, keys, sizes));
    if (stored == "bf16" || stored == "f32") return PublishedBundle(std::move(floats));
    VLA_TRY(const Bundle read, Bundle::open(floats.path()));
    VLA_TRY(CodedBundle codes, CodedBundle::make(read, entry, stored == "int8" ? Rounding::int8 : Rounding::int4));
    return PublishedBundle(std::move(codes));
  }
  /// A path by which this process can open it.
  std::string path() const {
    return std::visit([](const auto& file) { return file.path(); }, file_);
  }

 private:
  using File = std::variant<bench::RandomBundle, CodedBundle>;
  explicit PublishedBundle(File file) : file_(std::move(file)) {}
  File file_;
};

}  // namespace vla::test
