// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/msgpack/value.h"

#include <fmt/format.h>

#include <algorithm>
#include <msgpack.hpp>

#include "processor/unicode.h"

namespace vla::msgpack {
namespace {

using Type = Value::Type;

Error not_a_message(std::string expected, std::string found) {
  return {Code::bad_request, "request", std::move(expected), std::move(found)};
}

bool is_key(const Value& value) { return value.type == Type::text || value.type == Type::bytes; }

/// Builds the tree. A callback returns false to refuse the message.
class Reader : public ::msgpack::null_visitor {
 public:
  Value root;
  std::optional<Error> refused;

  bool visit_nil() { return add({}); }
  bool visit_boolean(bool v) { return add({.type = Type::boolean, .boolean = v}); }
  bool visit_positive_integer(std::uint64_t v) {
    if (v > INT64_MAX) return refuse("integers of 64 bits with a sign", std::to_string(v));
    return visit_negative_integer(static_cast<std::int64_t>(v));
  }
  bool visit_negative_integer(std::int64_t v) { return add({.type = Type::integer, .integer = v}); }
  bool visit_float32(float v) { return visit_float64(v); }
  bool visit_float64(double v) { return add({.type = Type::real, .real = v}); }
  bool visit_str(const char* v, std::uint32_t size) {
    const std::string_view text(v, size);
    if ((n_text_ += size) > kMaxTexts) return refuse("fewer bytes of text", fmt::format("more than {}", kMaxTexts));
    if (unicode::valid_prefix(text) < size) return refuse("text in UTF-8", "other bytes");
    return add({.type = Type::text, .data = text});
  }
  bool visit_bin(const char* v, std::uint32_t size) { return add({.type = Type::bytes, .data = {v, size}}); }
  bool visit_ext(const char*, std::uint32_t) { return refuse("plain values", "an extension type"); }
  bool start_array(std::uint32_t n) { return open({.type = Type::list}, n); }
  bool start_map(std::uint32_t n) { return open({.type = Type::map}, std::uint64_t{2} * n); }
  bool end_array() { return close(); }
  bool end_map() { return check_keys(open_.back()->items) && close(); }

 private:
  bool refuse(const char* expected, std::string found) {
    refused = not_a_message(expected, std::move(found));
    return false;
  }
  bool add(Value value) {
    if (++n_value_ > kMaxValues) return refuse("fewer values", fmt::format("more than {}", kMaxValues));
    if (open_.empty()) {
      root = std::move(value);
    } else {
      open_.back()->items.push_back(std::move(value));
    }
    return true;
  }
  /// The message states the number of items, so memory is reserved only up to the limit.
  bool open(Value value, std::uint64_t n_item) {
    if (open_.size() == kMaxDepth) return refuse("fewer levels", fmt::format("more than {}", kMaxDepth));
    if (n_item > kMaxValues - n_value_) return refuse("fewer values", fmt::format("more than {}", kMaxValues));
    value.items.reserve(n_item);
    if (!add(std::move(value))) return false;
    open_.push_back(open_.empty() ? &root : &open_.back()->items.back());
    return true;
  }
  bool close() {
    open_.pop_back();
    return true;
  }
  bool check_keys(const std::vector<Value>& items) {
    std::vector<std::string_view> keys;
    for (std::size_t i = 0; i < items.size(); i += 2) {
      if (!is_key(items[i])) return refuse("keys that are text or bytes", "another type");
      keys.push_back(items[i].data);
    }
    std::sort(keys.begin(), keys.end());
    if (std::adjacent_find(keys.begin(), keys.end()) != keys.end()) return refuse("each key once", "one twice");
    return true;
  }

  std::vector<Value*> open_;  // open lists and maps, outermost first; each is the last item of the one before
  std::size_t n_value_ = 0, n_text_ = 0;
};

}  // namespace

const Value* Value::find(std::string_view key) const {
  if (type != Type::map) return nullptr;
  for (std::size_t i = 0; i < items.size(); i += 2)
    if (items[i].data == key) return &items[i + 1];
  return nullptr;
}

Result<Value> read(std::span<const std::byte> message) {
  Reader reader;
  std::size_t at = 0;
  const bool is_whole =
      ::msgpack::parse(reinterpret_cast<const char*>(message.data()), message.size(), at, reader) && !reader.refused;
  if (reader.refused) return *reader.refused;
  if (!is_whole) return not_a_message("one msgpack value", "other bytes, or fewer");
  if (at != message.size())
    return not_a_message("one msgpack value", fmt::format("{} bytes after it", message.size() - at));
  return std::move(reader.root);
}

}  // namespace vla::msgpack
