// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/gguf_reader.h"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <iterator>
#include <limits>
#include <set>
#include <string_view>

#include "base/printable.h"

namespace vla {
namespace {

enum GgufType : std::uint32_t { u8, i8, u16, i16, u32, i32, f32, boolean, string, array, u64, i64, f64 };

constexpr std::uint64_t kMaxDims = 4;
// The longest key or tensor name that the format allows, in bytes.
constexpr std::uint64_t kMaxNameLength = 65535;
constexpr std::size_t kMaxShown = 4096;  // longest text that is displayed, in bytes; as long as a path may be

using Show = std::function<Status(std::size_t n)>;

/// A cursor over the bytes. Every read checks how many are left.
class Cursor {
 public:
  Cursor(std::span<const std::byte> bytes, const std::string& name, const Show& show)
      : bytes_(bytes), name_(name), show_(show) {}

  template <class T>
  Result<T> scalar(const std::string& what) {
    VLA_CHECK(need(sizeof(T), what));
    T value;
    std::memcpy(&value, bytes_.data() + position_, sizeof(T));
    position_ += sizeof(T);
    return value;
  }

  Result<std::string> text(std::uint64_t limit, const std::string& what) {
    VLA_TRY(const std::uint64_t length, scalar<std::uint64_t>(what));
    if (length > limit) return bad(what, fmt::format("at most {} bytes", limit), fmt::format("{} bytes", length));
    VLA_CHECK(need(length, what));
    std::string value(reinterpret_cast<const char*>(bytes_.data() + position_), length);
    position_ += length;
    return value;
  }

  Status need(std::uint64_t count, const std::string& what) const {
    if (count <= left()) return show_ ? show_(position_ + count) : Status();
    return bad(what, fmt::format("{} more bytes at offset {}", count, position_), fmt::format("{}", left()),
               "the file is truncated: copy or convert it again");
  }

  Error bad(const std::string& what, std::string expected, std::string found, std::string hint = {}) const {
    return {Code::bad_bundle, fmt::format("{}: {}", name_, what), std::move(expected), std::move(found),
            std::move(hint)};
  }

  std::uint64_t left() const { return bytes_.size() - position_; }
  std::uint64_t position() const { return position_; }

 private:
  std::span<const std::byte> bytes_;
  const std::string& name_;
  const Show& show_;
  std::uint64_t position_ = 0;
};

template <class T>
Result<std::int64_t> read_integer(Cursor& cursor, const std::string& what) {
  VLA_TRY(const T value, cursor.scalar<T>(what));
  if constexpr (std::is_same_v<T, std::uint64_t>) {
    if (value > static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max()))
      return cursor.bad(what, "an integer below 2^63", std::to_string(value));
  }
  return static_cast<std::int64_t>(value);
}

Result<std::int64_t> read_integer(Cursor& cursor, std::uint32_t type, const std::string& what) {
  switch (type) {
    case u8:
      return read_integer<std::uint8_t>(cursor, what);
    case i8:
      return read_integer<std::int8_t>(cursor, what);
    case u16:
      return read_integer<std::uint16_t>(cursor, what);
    case i16:
      return read_integer<std::int16_t>(cursor, what);
    case u32:
      return read_integer<std::uint32_t>(cursor, what);
    case i32:
      return read_integer<std::int32_t>(cursor, what);
    case u64:
      return read_integer<std::uint64_t>(cursor, what);
    default:
      return read_integer<std::int64_t>(cursor, what);
  }
}

Result<double> read_float(Cursor& cursor, std::uint32_t type, const std::string& what) {
  if (type == f64) return cursor.scalar<double>(what);
  VLA_TRY(const float value, cursor.scalar<float>(what));
  return static_cast<double>(value);
}

Result<bool> read_boolean(Cursor& cursor, const std::string& what) {
  VLA_TRY(const std::uint8_t value, cursor.scalar<std::uint8_t>(what));
  if (value > 1) return cursor.bad(what, "a boolean, 0 or 1", std::to_string(value));
  return value == 1;
}

bool is_integer(std::uint32_t type) { return type <= i32 || type == u64 || type == i64; }
bool is_float(std::uint32_t type) { return type == f32 || type == f64; }

/// The smallest size of one element in the file. It bounds an array's length before memory is reserved.
std::uint64_t least_size(std::uint32_t type) {
  constexpr std::uint64_t kSizes[] = {1, 1, 2, 2, 4, 4, 4, 1, 8, 0, 8, 8, 8};
  return kSizes[type];
}

template <class T, class Read>
Result<Value> read_list(std::uint64_t count, Read read) {
  std::vector<T> list;
  list.reserve(count);
  for (std::uint64_t i = 0; i < count; ++i) {
    VLA_TRY(T element, read());
    list.push_back(std::move(element));
  }
  return Value(std::move(list));
}

Result<Value> read_array(Cursor& cursor, const std::string& what) {
  VLA_TRY(const std::uint32_t type, cursor.scalar<std::uint32_t>(what));
  VLA_TRY(const std::uint64_t count, cursor.scalar<std::uint64_t>(what));
  if (!is_integer(type) && !is_float(type) && type != string)
    return cursor.bad(what, "a list of integers, floats or strings", fmt::format("GGUF element type {}", type));
  if (count > cursor.left() / least_size(type))
    return cursor.bad(what, fmt::format("a list that fits into the {} bytes left", cursor.left()),
                      fmt::format("{} elements", count), "the file is truncated or damaged: copy or convert it again");
  if (is_integer(type)) return read_list<std::int64_t>(count, [&] { return read_integer(cursor, type, what); });
  if (is_float(type)) return read_list<double>(count, [&] { return read_float(cursor, type, what); });
  return read_list<std::string>(count, [&] { return cursor.text(cursor.left(), what); });
}

template <class T>
Result<Value> widen(Result<T> result) {
  if (!result) return result.error();
  return Value(std::move(*result));
}

Result<Value> read_value(Cursor& cursor, const std::string& what) {
  VLA_TRY(const std::uint32_t type, cursor.scalar<std::uint32_t>(what));
  if (is_integer(type)) return widen(read_integer(cursor, type, what));
  if (is_float(type)) return widen(read_float(cursor, type, what));
  if (type == boolean) return widen(read_boolean(cursor, what));
  if (type == string) return widen(cursor.text(cursor.left(), what));
  if (type == array) return read_array(cursor, what);
  return cursor.bad(what, "a GGUF value type from 0 to 12", std::to_string(type));
}

/// Refuses text that could control a terminal, start a new line or fill a log, because it is displayed and sent to
/// clients.
Status check_shown(const Cursor& cursor, const std::string& what, const std::string& text) {
  if (text.size() > kMaxShown)
    return cursor.bad(printable(what.substr(0, kMaxShown)), fmt::format("text of at most {} bytes", kMaxShown),
                      fmt::format("{} bytes", text.size()));
  return is_printable(text) ? Status()
                            : cursor.bad(printable(what), "text without control characters", printable(text));
}

/// Whether the texts of a key are for the machine only: a vocabulary, or JSON. The key may belong to one robot.
bool is_for_machine(std::string_view key) {
  if (key.starts_with("embodiment.")) key.remove_prefix(std::min(key.size(), key.find('.', 11) + 1));
  return key.starts_with("tokenizer.") || key.starts_with("processor.");
}

/// Checks the texts that may be displayed: the source, tags, and names of features, columns and units.
Status check_shown(const Cursor& cursor, const std::string& key, const Value& value) {
  if (is_for_machine(key)) return {};
  if (const auto* text = std::get_if<std::string>(&value)) return check_shown(cursor, key, *text);
  if (const auto* list = std::get_if<std::vector<std::string>>(&value))
    for (const std::string& text : *list) VLA_CHECK(check_shown(cursor, key, text));
  return {};
}

Result<Keys> read_keys(Cursor& cursor, std::uint64_t count) {
  Keys keys;
  for (std::uint64_t i = 0; i < count; ++i) {
    VLA_TRY(std::string key, cursor.text(kMaxNameLength, fmt::format("key {} of {}", i + 1, count)));
    VLA_CHECK(check_shown(cursor, fmt::format("key {} of {}", i + 1, count), key));
    if (keys.has(key)) return cursor.bad(key, "one value", "the key a second time");
    VLA_TRY(Value value, read_value(cursor, key));
    VLA_CHECK(check_shown(cursor, key, value));
    keys.set(std::move(key), std::move(value));
  }
  return keys;
}

Result<DType> read_dtype(Cursor& cursor, const std::string& what) {
  VLA_TRY(const std::uint32_t type, cursor.scalar<std::uint32_t>(what));
  switch (type) {  // numbers of ggml's enum ggml_type
    case 0:
      return DType::f32;
    case 1:
      return DType::f16;
    case 24:
      return DType::i8;
    case 26:
      return DType::i32;
    case 28:
      return DType::f64;
    case 30:
      return DType::bf16;
    default:
      return cursor.bad(what, "type f32, f16, bf16, i32, i8 or f64", fmt::format("ggml type {}", type));
  }
}

struct PlacedTensor {
  TensorInfo info;
  std::uint64_t offset = 0;
  std::uint64_t size = 0;
};

Result<PlacedTensor> read_tensor(Cursor& cursor, std::uint64_t file_size, const std::string& which) {
  PlacedTensor tensor;
  VLA_TRY(tensor.info.name, cursor.text(kMaxNameLength, which));
  VLA_CHECK(check_shown(cursor, which, tensor.info.name));
  const std::string what = "tensor " + tensor.info.name;
  VLA_TRY(const std::uint32_t n_dims, cursor.scalar<std::uint32_t>(what));
  if (n_dims < 1 || n_dims > kMaxDims) return cursor.bad(what, "1 to 4 dimensions", std::to_string(n_dims));
  std::uint64_t count = 1;
  for (std::uint32_t d = 0; d < n_dims; ++d) {
    VLA_TRY(const std::uint64_t dim, cursor.scalar<std::uint64_t>(what));
    if (dim == 0 || dim > file_size / count)  // an element takes a byte or more, so this bounds the product too
      return cursor.bad(what, "dimensions that fit into the file", fmt::format("dimension {} is {}", d, dim));
    count *= dim;
    tensor.info.shape.push_back(static_cast<std::int64_t>(dim));
  }
  VLA_TRY(tensor.info.type, read_dtype(cursor, what));
  VLA_TRY(tensor.offset, cursor.scalar<std::uint64_t>(what));
  tensor.size = dtype_size(tensor.info.type, static_cast<std::int64_t>(count));
  return tensor;
}

Result<std::uint64_t> read_alignment(const Cursor& cursor, const Keys& keys) {
  constexpr const char* kKey = "general.alignment";
  if (!keys.has(kKey)) return std::uint64_t{32};  // the format's own default
  VLA_TRY(const int alignment, keys.integer(kKey, {8, 65536}));
  if ((alignment & (alignment - 1)) != 0)
    return cursor.bad(kKey, "a power of two from 8 to 65536", std::to_string(alignment));
  return static_cast<std::uint64_t>(alignment);
}

std::uint64_t round_up(std::uint64_t value, std::uint64_t alignment) {
  return (value + alignment - 1) / alignment * alignment;
}

/// Checks that tensors follow each other without gaps, in the listed order, to the end of the file.
Status place(std::span<const std::byte> bytes, const Cursor& cursor, std::uint64_t alignment,
             std::vector<PlacedTensor>& tensors) {
  const std::uint64_t start = round_up(cursor.position(), alignment);
  std::uint64_t expected = 0;
  for (PlacedTensor& tensor : tensors) {
    const std::string what = "tensor " + tensor.info.name;
    if (tensor.offset != expected)
      return cursor.bad(what, fmt::format("offset {}", expected), std::to_string(tensor.offset));
    if (start > bytes.size() || tensor.offset > bytes.size() - start ||
        tensor.size > bytes.size() - start - tensor.offset)
      return cursor.bad(what, fmt::format("{} bytes of data", tensor.size), "the end of the file",
                        "the file is truncated: copy or convert it again");
    tensor.info.data = bytes.subspan(start + tensor.offset, tensor.size);
    expected = round_up(tensor.offset + tensor.size, alignment);
  }
  const std::uint64_t end = tensors.empty() ? cursor.position() : start + expected;
  if (bytes.size() > std::max(end, start))
    return cursor.bad("end", fmt::format("a file of {} bytes", end), std::to_string(bytes.size()));
  return {};
}

}  // namespace

Result<GgufContent> read_gguf(std::span<const std::byte> bytes, const std::string& name, const Show& show) {
  Cursor cursor(bytes, name, show);
  VLA_TRY(const std::uint32_t magic, cursor.scalar<std::uint32_t>("header"));
  if (magic != 0x46554747)
    return cursor.bad("header", "a GGUF file", "other first bytes", "make a bundle with vla-convert");
  VLA_TRY(const std::uint32_t version, cursor.scalar<std::uint32_t>("header"));
  if (version != 3) return cursor.bad("header", "GGUF version 3", fmt::format("version {}", version));
  VLA_TRY(const std::uint64_t n_tensor, cursor.scalar<std::uint64_t>("header"));
  VLA_TRY(const std::uint64_t n_key, cursor.scalar<std::uint64_t>("header"));

  GgufContent content;
  VLA_TRY(content.keys, read_keys(cursor, n_key));
  VLA_TRY(const std::uint64_t alignment, read_alignment(cursor, content.keys));
  std::vector<PlacedTensor> tensors;
  std::set<std::string> names;
  for (std::uint64_t i = 0; i < n_tensor; ++i) {
    VLA_TRY(PlacedTensor tensor, read_tensor(cursor, bytes.size(), fmt::format("tensor {} of {}", i + 1, n_tensor)));
    if (!names.insert(tensor.info.name).second)
      return cursor.bad("tensor " + tensor.info.name, "one tensor", "the name a second time");
    tensors.push_back(std::move(tensor));
  }
  VLA_CHECK(place(bytes, cursor, alignment, tensors));
  for (PlacedTensor& tensor : tensors) content.tensors.push_back(std::move(tensor.info));
  return content;
}

}  // namespace vla
