// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"
#include "serve/array.h"
#include "serve/options.h"

namespace vla::pickle {

/// A value of a pickle. Text, bytes and array elements stay in the message, which must outlive the value.
struct Value {
  enum class Type { none, boolean, integer, real, text, bytes, list, map, array, object, name, dtype };

  Type type = Type::none;
  std::int64_t integer = 0;  // also a boolean's value
  double real = 0;           // also an integer's or boolean's value
  std::string_view data;     // content of text or bytes; a dtype's letters, such as f4
  std::string_view name;     // `module.name` of a class or function, or of an object's class; a dtype's byte order
  std::vector<const Value*>
      items;  // a list's or tuple's items; a map's keys and values in turn; an object's map of attributes
  std::unique_ptr<const serve::Array> array;  // an array; null between the two steps that build it

  bool is_number() const { return type == Type::boolean || type == Type::integer || type == Type::real; }
  /// Returns the value at a text key; null if the key is missing or this has no keys.
  const Value* find(std::string_view key) const;
};

constexpr std::size_t kMaxSteps = 1 << 14;               // opcodes per message
constexpr std::size_t kMaxMarks = 64;                    // containers open at once
constexpr std::size_t kMaxTexts = 2 * serve::kMostText;  // bytes of all texts together: an instruction, and names

/// Reads a message of Python's pickle, protocol 2 to 5, without executing anything. Names of classes and functions are
/// compared with those that LeRobot's clients and NumPy's arrays use, and stand for data. Errors: bad_request for any
/// other name, for opcodes that do more than build data, and beyond the limits.
class Pickle {
 public:
  static Result<Pickle> read(std::span<const std::byte> message);
  const Value& root() const { return *root_; }

 private:
  friend class Reader;
  std::deque<Value> values_;
  const Value* root_ = nullptr;
};

/// Writes values of protocol 4 in the order in which a stack machine reads them.
class Writer {
 public:
  Writer() : out_("\x80\x04") {}
  Writer& op(char opcode) { return out_ += opcode, *this; }
  Writer& text(std::string_view value);
  Writer& integer(std::int64_t value);
  Writer& real(double value);
  /// A class or function.
  Writer& name(std::string_view module, std::string_view name);
  /// Ends the pickle and returns its bytes.
  std::string take() { return op('.'), std::move(out_); }

 private:
  std::string out_;
};

}  // namespace vla::pickle
