// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Source: CPython, Lib/pickle.py (opcodes); NumPy, numpy/_core/src/multiarray/methods.c (how arrays are rebuilt).
#include "serve/lerobot/pickle.h"

#include <fmt/format.h>

#include <array>
#include <bit>
#include <cstring>
#include <set>

#include "base/printable.h"
#include "processor/unicode.h"

namespace vla::pickle {

using Type = Value::Type;

namespace {

static_assert(std::endian::native == std::endian::little);

Error bad(std::string expected, std::string found) {
  return {Code::bad_request, "pickle", std::move(expected), std::move(found)};
}

/// The names that stand for data. NumPy's functions and LeRobot's classes appear under old and new modules.
const std::set<std::string, std::less<>>& known_names() {
  static const std::set<std::string, std::less<>> names = [] {
    std::set<std::string, std::less<>> all = {"numpy.ndarray", "numpy.dtype"};
    for (const char* module : {"numpy.core.", "numpy._core."})
      for (const char* function : {"multiarray._reconstruct", "multiarray.scalar", "numeric._frombuffer"})
        all.insert(std::string(module) + function);
    for (const char* module : {"lerobot.async_inference.helpers.", "lerobot.scripts.server.helpers."})
      for (const char* name : {"RemotePolicyConfig", "TimedObservation"}) all.insert(std::string(module) + name);
    return all;
  }();
  return names;
}

Error not_c_order() {
  Error error = bad("arrays in C order", "Fortran order");
  error.hint = "send numpy.ascontiguousarray of it";
  return error;
}

/// Makes an array of a dtype, a shape and elements.
Result<serve::Array> make_array(const Value& dtype, const Value& shape, std::string_view elements) {
  const std::string type = std::string(dtype.name.empty() ? "|" : dtype.name) + std::string(dtype.data);
  VLA_TRY(const serve::ElementType element, serve::ElementType::read(type, "pickle"));
  std::vector<std::int64_t> sizes;
  for (const Value* size : shape.items) {
    if (size->type != Type::integer) return bad("a shape of integers", "another value");
    sizes.push_back(size->integer);
  }
  return serve::Array::make(element, std::move(sizes), elements, "pickle");
}

}  // namespace

const Value* Value::find(std::string_view key) const {
  if (type == Type::object) return items.empty() ? nullptr : items[0]->find(key);
  if (type != Type::map) return nullptr;
  for (std::size_t i = 0; i + 1 < items.size(); i += 2)
    if (items[i]->type == Type::text && items[i]->data == key) return items[i + 1];
  return nullptr;
}

/// A pickle's stack machine that builds data instead of calling functions.
class Reader {
 public:
  explicit Reader(std::string_view bytes) : left_(bytes) {}

  Result<Pickle> read() {
    for (std::size_t n = 0; n < kMaxSteps; ++n) {
      if (left_.empty()) return bad("a whole message", "one that is cut off");
      const auto opcode = static_cast<unsigned char>(left_[0]);
      left_.remove_prefix(1);
      if (opcode == '.') return finish();
      VLA_CHECK(step(opcode));
    }
    return bad(fmt::format("at most {} opcodes", kMaxSteps), "more");
  }

 private:
  Result<Pickle> finish() {
    if (!left_.empty()) return bad("the end", fmt::format("{} bytes behind it", left_.size()));
    if (stack_.size() != 1 || !marks_.empty()) return bad("one value", fmt::format("{}", stack_.size()));
    for (const Value& value : out_.values_)
      if (value.type == Type::array && !value.array) return bad("whole arrays", "one without elements");
    out_.root_ = stack_[0];
    return std::move(out_);
  }

  Status step(unsigned char opcode) {
    switch (opcode) {
      case 0x80: {  // PROTO
        VLA_TRY(const std::uint64_t version, number(1));
        return version >= 2 && version <= 5 ? Status{} : bad("protocol 2 to 5", std::to_string(version));
      }
      case 0x95:  // FRAME
        return take(8).ok() ? Status{} : cut_off();
      case 'N':
        return push({});
      case 0x88:
      case 0x89:
        return push_integer(Type::boolean, opcode == 0x88);
      case 'J': {
        VLA_TRY(const std::uint64_t bits, number(4));
        return push_integer(Type::integer, static_cast<std::int32_t>(bits));
      }
      case 'K':
      case 'M': {
        VLA_TRY(const std::uint64_t bits, number(opcode == 'K' ? 1 : 2));
        return push_integer(Type::integer, static_cast<std::int64_t>(bits));
      }
      case 0x8a:
        return push_long();
      case 'G':
        return push_real();
      case 0x8c:
      case 'X':
      case 0x8d:
        return push_bytes(Type::text, opcode == 'X' ? 4 : opcode == 0x8c ? 1 : 8);
      case 'C':
      case 'B':
      case 0x8e:
      case 0x96:
        return push_bytes(Type::bytes, opcode == 'C' ? 1 : opcode == 'B' ? 4 : 8);
      case ']':
      case ')':
        return push({.type = Type::list});
      case '}':
        return push({.type = Type::map});
      case '(':
        if (marks_.size() == kMaxMarks) return bad(fmt::format("at most {} levels", kMaxMarks), "more");
        marks_.push_back(stack_.size());
        return {};
      case 't':
      case 'l':
      case 'd':
        return push_marked(opcode == 'd' ? Type::map : Type::list);
      case 0x85:
      case 0x86:
      case 0x87:
        return push_tuple(opcode - 0x84u);
      case 'a':
      case 's':
        return extend(opcode == 's' ? 2 : 1, opcode == 's' ? Type::map : Type::list);
      case 'e':
      case 'u': {
        VLA_TRY(const std::size_t n, marked());
        return extend(n, opcode == 'u' ? Type::map : Type::list);
      }
      case 0x94:
        return stack_.empty() ? nothing() : (memo_.push_back(stack_.back()), Status{});
      case 'q':
      case 'r':
        return put(opcode == 'q' ? 1 : 4);
      case 'h':
      case 'j':
        return get(opcode == 'h' ? 1 : 4);
      case 'c':
      case 0x93:
        return opcode == 'c' ? push_global() : push_stack_global();
      case 0x81:
        return make_object();
      case 'R':
        return reduce();
      case 'b':
        return build();
      default:
        return bad("opcodes that make data", fmt::format("0x{:02x}", opcode));
    }
  }

  static Status cut_off() { return bad("a whole message", "one that is cut off"); }
  static Status nothing() { return bad("a value on the stack", "none"); }

  struct Taken {
    std::string_view bytes;
    bool is_sound = false;
    bool ok() const { return is_sound; }
  };
  Taken take(std::uint64_t n) {
    if (n > left_.size()) return {};
    const std::string_view bytes = left_.substr(0, n);
    left_.remove_prefix(n);
    return {bytes, true};
  }
  /// Reads a little-endian number of n bytes.
  Result<std::uint64_t> number(std::size_t n) {
    const Taken taken = take(n);
    if (!taken.ok()) return bad("a whole message", "one that is cut off");
    std::uint64_t bits = 0;
    std::memcpy(&bits, taken.bytes.data(), n);
    return bits;
  }

  Status push(Value value) {
    out_.values_.push_back(std::move(value));
    stack_.push_back(&out_.values_.back());
    return {};
  }
  Status push_integer(Type type, std::int64_t value) {
    return push({.type = type, .integer = value, .real = static_cast<double>(value)});
  }
  Status push_long() {
    VLA_TRY(const std::uint64_t n, number(1));
    if (n > 8) return bad("integers of 64 bits", "a larger one");
    VLA_TRY(std::uint64_t bits, number(n));
    if (n > 0 && n < 8 && (bits >> (8 * n - 1) & 1) != 0) bits |= ~std::uint64_t{0} << (8 * n);
    return push_integer(Type::integer, static_cast<std::int64_t>(bits));
  }
  Status push_real() {
    VLA_TRY(const std::uint64_t bits, number(8));
    return push({.type = Type::real, .real = std::bit_cast<double>(__builtin_bswap64(bits))});
  }
  Status push_bytes(Type type, std::size_t n_size) {
    VLA_TRY(const std::uint64_t size, number(n_size));
    const Taken taken = take(size);
    if (!taken.ok()) return cut_off();
    if (type == Type::text && (n_text_ += size) > kMaxTexts)
      return bad(fmt::format("at most {} bytes of text", kMaxTexts), "more");
    if (type == Type::text && unicode::valid_prefix(taken.bytes) < size) return bad("text in UTF-8", "other bytes");
    return push({.type = type, .data = taken.bytes});
  }

  /// Pops the last mark and returns how many values lie above it.
  Result<std::size_t> marked() {
    if (marks_.empty() || marks_.back() > stack_.size()) return bad("a mark", "none");
    const std::size_t n = stack_.size() - marks_.back();
    marks_.pop_back();
    return n;
  }
  Status push_marked(Type type) {
    VLA_TRY(const std::size_t n, marked());
    return push_container(type, n);
  }
  Status push_tuple(std::size_t n) { return n_free() < n ? nothing() : push_container(Type::list, n); }
  /// Returns how many values lie above the last mark.
  std::size_t n_free() const { return stack_.size() - (marks_.empty() ? 0 : marks_.back()); }
  Status push_container(Type type, std::size_t n) {
    VLA_CHECK(push({.type = type}));
    Value* const made = stack_.back();
    stack_.pop_back();
    VLA_CHECK(move_top(n, *made));
    stack_.push_back(made);
    return {};
  }
  /// Makes the topmost n values items of the container below them.
  Status move_top(std::size_t n, Value& to) {
    if (to.type == Type::map && n % 2 != 0) return bad("a value for each key", "a key alone");
    to.items.insert(to.items.end(), stack_.end() - static_cast<std::ptrdiff_t>(n), stack_.end());
    stack_.resize(stack_.size() - n);
    return {};
  }
  Status extend(std::size_t n, Type type) {
    if (n_free() < n + 1) return nothing();
    Value& container = *stack_[stack_.size() - n - 1];
    if (container.type != type) return bad(type == Type::map ? "a dict" : "a list", "another value");
    return move_top(n, container);
  }

  Status put(std::size_t n_size) {
    VLA_TRY(const std::uint64_t index, number(n_size));
    if (stack_.empty()) return nothing();
    if (index > memo_.size()) return bad("a memo in order", fmt::format("entry {}", index));
    if (index == memo_.size()) memo_.push_back(nullptr);
    memo_[index] = stack_.back();
    return {};
  }
  Status get(std::size_t n_size) {
    VLA_TRY(const std::uint64_t index, number(n_size));
    if (index >= memo_.size()) return bad("an entry of the memo", fmt::format("entry {}", index));
    stack_.push_back(memo_[index]);
    return {};
  }

  Status push_name(std::string_view module, std::string_view name) {
    const std::string whole = std::string(module.substr(0, 200)) + "." + std::string(name.substr(0, 200));
    const auto known = known_names().find(whole);
    if (known == known_names().end())
      return Error{Code::bad_request, "pickle", "data, and the names that LeRobot's client and NumPy's arrays use",
                   "the name " + printable(whole), "nothing of the message was executed"};
    return push({.type = Type::name, .name = *known});
  }
  Status push_global() {
    std::array<std::string_view, 2> parts;
    for (std::string_view& part : parts) {
      const std::size_t end = left_.find('\n');
      if (end == std::string_view::npos) return cut_off();
      part = left_.substr(0, end);
      left_.remove_prefix(end + 1);
    }
    return push_name(parts[0], parts[1]);
  }
  Status push_stack_global() {
    if (n_free() < 2) return nothing();
    const Value &module = *stack_[stack_.size() - 2], &name = *stack_.back();
    if (module.type != Type::text || name.type != Type::text) return bad("a name that is text", "another value");
    stack_.resize(stack_.size() - 2);
    return push_name(module.data, name.data);
  }

  /// Pushes an object of a class, constructed without arguments.
  Status make_object() {
    if (n_free() < 2) return nothing();
    const Value &made_of = *stack_[stack_.size() - 2], &arguments = *stack_.back();
    if (made_of.type != Type::name || !made_of.name.starts_with("lerobot.") || arguments.type != Type::list ||
        !arguments.items.empty())
      return bad("an object of LeRobot's classes without arguments", "another");
    stack_.resize(stack_.size() - 2);
    return push({.type = Type::object, .name = made_of.name});
  }

  /// Pushes the result of one of NumPy's functions.
  Status reduce() {
    if (n_free() < 2) return nothing();
    const Value &function = *stack_[stack_.size() - 2], &arguments = *stack_.back();
    if (function.type != Type::name || arguments.type != Type::list) return bad("a call of NumPy's", "another");
    stack_.resize(stack_.size() - 2);
    const std::vector<const Value*>& given = arguments.items;
    const auto has = [&](std::size_t i, Type type) { return i < given.size() && given[i]->type == type; };
    if (function.name == "numpy.dtype" && has(0, Type::text))
      return push({.type = Type::dtype, .data = given[0]->data});
    if (function.name.ends_with("._reconstruct") && has(0, Type::name) && given[0]->name == "numpy.ndarray")
      return push({.type = Type::array});
    if (function.name.ends_with(".scalar") && has(0, Type::dtype) && has(1, Type::bytes))
      return push_scalar(*given[0], given[1]->data);
    if (function.name.ends_with("._frombuffer") && has(0, Type::bytes) && has(1, Type::dtype) && has(2, Type::list) &&
        has(3, Type::text)) {
      if (given[3]->data != "C") return not_c_order();
      VLA_TRY(serve::Array array, make_array(*given[1], *given[2], given[0]->data));
      return push({.type = Type::array, .array = std::make_unique<const serve::Array>(std::move(array))});
    }
    return bad("a call of NumPy's functions for arrays", std::string(function.name) + " with other arguments");
  }

  Status push_scalar(const Value& dtype, std::string_view bytes) {
    VLA_TRY(const serve::Array array, make_array(dtype, {}, bytes));
    if (array.type().is_text()) return bad("a number", "text of NumPy");
    return array.visit([&]<class T>(const serve::Elements<T>& elements) -> Status {
      const T value = elements[0];
      if constexpr (std::is_floating_point_v<T> || std::is_same_v<T, serve::Half>)
        return push({.type = Type::real, .real = static_cast<double>(value)});
      if constexpr (std::is_same_v<T, std::uint64_t>)
        if (value > INT64_MAX) return bad("integers of 64 bits with a sign", std::to_string(value));
      return push_integer(std::is_same_v<T, bool> ? Type::boolean : Type::integer, static_cast<std::int64_t>(value));
    });
  }

  /// Sets the state of an object, an array or a dtype: the second step of its construction.
  Status build() {
    if (n_free() < 2) return nothing();
    Value &made = *stack_[stack_.size() - 2], &state = *stack_.back();
    stack_.pop_back();
    if (made.type == Type::object && state.type == Type::map && made.items.empty()) {
      made.items = {&state};
      return {};
    }
    const std::vector<const Value*>& given = state.items;
    if (made.type == Type::dtype && made.name.empty() && state.type == Type::list && given.size() >= 5 &&
        given[1]->type == Type::text) {
      for (std::size_t i = 2; i < 5; ++i)
        if (given[i]->type != Type::none) return bad("a dtype of numbers", "one with fields");
      if (given[1]->data.empty()) return bad("a byte order", "none");
      made.name = given[1]->data;
      return {};
    }
    if (made.type == Type::array && !made.array && state.type == Type::list && given.size() == 5 &&
        given[1]->type == Type::list && given[2]->type == Type::dtype && given[4]->type == Type::bytes) {
      if (given[3]->type != Type::boolean || given[3]->integer != 0) return not_c_order();
      VLA_TRY(serve::Array array, make_array(*given[2], *given[1], given[4]->data));
      made.array = std::make_unique<const serve::Array>(std::move(array));
      return {};
    }
    return bad("the state of an object or an array", "another");
  }

  std::string_view left_;
  Pickle out_;
  std::vector<Value*> stack_, memo_;
  std::vector<std::size_t> marks_;
  std::size_t n_text_ = 0;  // bytes
};

Result<Pickle> Pickle::read(std::span<const std::byte> message) {
  return Reader({reinterpret_cast<const char*>(message.data()), message.size()}).read();
}

namespace {

std::string bytes_of(std::uint64_t value, std::size_t n) {
  std::string out(n, '\0');
  std::memcpy(out.data(), &value, n);
  return out;
}

}  // namespace

Writer& Writer::text(std::string_view value) {
  out_ += 'X' + bytes_of(value.size(), 4);
  out_ += value;
  return *this;
}

Writer& Writer::integer(std::int64_t value) {
  out_ += "\x8a\x08" + bytes_of(static_cast<std::uint64_t>(value), 8);
  return *this;
}

Writer& Writer::real(double value) {
  out_ += 'G' + bytes_of(__builtin_bswap64(std::bit_cast<std::uint64_t>(value)), 8);
  return *this;
}

Writer& Writer::name(std::string_view module, std::string_view name) {
  text(module).text(name);
  return op('\x93');
}

}  // namespace vla::pickle
