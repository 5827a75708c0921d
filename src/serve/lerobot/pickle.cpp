// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Source: CPython, Lib/pickle.py (opcodes); NumPy, numpy/_core/src/multiarray/methods.c (how arrays are rebuilt).
#include "serve/lerobot/pickle.h"

#include <fmt/format.h>

#include <array>
#include <bit>
#include <charconv>
#include <cstring>

#include "base/printable.h"
#include "processor/unicode.h"

namespace vla::pickle {

using Type = Value::Type;

namespace {

static_assert(std::endian::native == std::endian::little);

constexpr std::size_t kMaxRank = 8;

Error bad(std::string expected, std::string found) {
  return {Code::bad_request, "pickle", std::move(expected), std::move(found)};
}

/// The names that stand for data. Both places of NumPy's functions, and of LeRobot's classes, are in use.
constexpr std::array kFunctions = {"multiarray._reconstruct", "multiarray.scalar", "numeric._frombuffer"};
constexpr std::array kLeRobot = {"RemotePolicyConfig", "TimedObservation"};

bool is_known(const std::string& name) {
  if (name == "numpy.ndarray" || name == "numpy.dtype") return true;
  for (const char* function : kFunctions)
    if (name == std::string("numpy.core.") + function || name == std::string("numpy._core.") + function) return true;
  for (const char* of : kLeRobot)
    if (name == std::string("lerobot.async_inference.helpers.") + of ||
        name == std::string("lerobot.scripts.server.helpers.") + of)
      return true;
  return false;
}

/// f4, u1, i8 and so on.
bool read_dtype(std::string_view text, msgpack::Array& array) {
  if (text.starts_with('<') || text.starts_with('|') || text.starts_with('>')) {
    array.is_big_endian = text[0] == '>';
    text.remove_prefix(1);
  }
  if (text.size() != 2 || std::string_view("biuf").find(text[0]) == std::string_view::npos) return false;
  array.kind = text[0];
  array.item = static_cast<std::size_t>(text[1] - '0');
  const bool is_size = array.item == 1 || array.item == 2 || array.item == 4 || array.item == 8;
  return is_size && (array.kind != 'f' || array.item > 1) && (array.kind != 'b' || array.item == 1);
}

/// Whether the elements are as many as shape and dtype say.
bool fits(const msgpack::Array& array) {
  std::size_t size = array.item;
  for (const std::int64_t n : array.shape) {
    if (n < 0 || __builtin_mul_overflow(size, static_cast<std::size_t>(n), &size)) return false;
  }
  return array.shape.size() <= kMaxRank && size == array.data.size();
}

template <class T>
double element(std::string_view data) {
  T value;
  std::memcpy(&value, data.data(), sizeof(T));
  return static_cast<double>(value);
}

double number_of(const msgpack::Array& array) {
  switch (array.item) {
    case 1:
      return array.kind == 'i' ? element<std::int8_t>(array.data) : element<std::uint8_t>(array.data);
    case 2:
      return array.kind == 'i' ? element<std::int16_t>(array.data) : element<std::uint16_t>(array.data);
    case 4:
      if (array.kind == 'f') return element<float>(array.data);
      return array.kind == 'i' ? element<std::int32_t>(array.data) : element<std::uint32_t>(array.data);
    default:
      if (array.kind == 'f') return element<double>(array.data);
      return array.kind == 'i' ? element<std::int64_t>(array.data) : element<std::uint64_t>(array.data);
  }
}

}  // namespace

const Value* Value::find(std::string_view key) const {
  if (type == Type::object) return items.empty() ? nullptr : items[0]->find(key);
  if (type != Type::map) return nullptr;
  for (std::size_t i = 0; i + 1 < items.size(); i += 2)
    if (items[i]->type == Type::text && items[i]->data == key) return items[i + 1];
  return nullptr;
}

/// The stack machine, with data in place of calls.
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
      if (!value.is_whole) return bad("whole arrays", "one without elements");
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
  /// A little-endian number of n bytes.
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
    if (type == Type::text && unicode::valid_prefix(taken.bytes) < size) return bad("text in UTF-8", "other bytes");
    return push({.type = type, .data = taken.bytes});
  }

  /// How many values lie above the last mark, which goes.
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
  /// Values above the last mark.
  std::size_t n_free() const { return stack_.size() - (marks_.empty() ? 0 : marks_.back()); }
  Status push_container(Type type, std::size_t n) {
    VLA_CHECK(push({.type = type}));
    Value* const made = stack_.back();
    stack_.pop_back();
    VLA_CHECK(move_top(n, *made));
    stack_.push_back(made);
    return {};
  }
  /// The n topmost values become items.
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
    std::string whole = std::string(module.substr(0, 200)) + "." + std::string(name.substr(0, 200));
    if (!is_known(whole))
      return Error{Code::bad_request, "pickle", "data, and the names that LeRobot's client and NumPy's arrays use",
                   "the name " + printable(whole), "nothing of the message was executed"};
    return push({.type = Type::name, .name = std::move(whole)});
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

  /// An object of a class, made without arguments.
  Status make_object() {
    if (n_free() < 2) return nothing();
    const Value &made_of = *stack_[stack_.size() - 2], &arguments = *stack_.back();
    if (made_of.type != Type::name || !made_of.name.starts_with("lerobot.") || arguments.type != Type::list ||
        !arguments.items.empty())
      return bad("an object of LeRobot's classes without arguments", "another");
    std::string name = made_of.name;
    stack_.resize(stack_.size() - 2);
    return push({.type = Type::object, .name = std::move(name)});
  }

  /// Pushes what a call of NumPy's functions would make.
  Status reduce() {
    if (n_free() < 2) return nothing();
    const Value &function = *stack_[stack_.size() - 2], &arguments = *stack_.back();
    if (function.type != Type::name || arguments.type != Type::list) return bad("a call of NumPy's", "another");
    stack_.resize(stack_.size() - 2);
    const std::vector<const Value*>& given = arguments.items;
    const auto has = [&](std::size_t i, Type type) { return i < given.size() && given[i]->type == type; };
    if (function.name == "numpy.dtype" && has(0, Type::text)) {
      Value made{.type = Type::dtype, .is_whole = false};
      if (!read_dtype(given[0]->data, made.array)) return bad_dtype(given[0]->data);
      return push(std::move(made));
    }
    if (function.name.ends_with("._reconstruct") && has(0, Type::name) && given[0]->name == "numpy.ndarray")
      return push({.type = Type::array, .is_whole = false});
    if (function.name.ends_with(".scalar") && has(0, Type::dtype) && has(1, Type::bytes)) {
      msgpack::Array array = given[0]->array;
      array.data = given[1]->data;
      const bool is_half = array.kind == 'f' && array.item == 2;
      if (!fits(array) || array.is_big_endian || is_half) return bad("a number of its dtype, f4 or f8", "another");
      const double value = number_of(array);
      if (array.kind == 'f') return push({.type = Type::real, .real = value});
      std::int64_t bits = 0;
      std::memcpy(&bits, array.data.data(), array.item);
      if (array.kind == 'i' && array.item < 8) bits = static_cast<std::int64_t>(value);
      return push({.type = array.kind == 'b' ? Type::boolean : Type::integer, .integer = bits, .real = value});
    }
    if (function.name.ends_with("._frombuffer") && has(0, Type::bytes) && has(1, Type::dtype) && has(3, Type::text)) {
      if (given[3]->data != "C") return bad("arrays in C order", "another");
      VLA_CHECK(push({.type = Type::array}));
      return fill(*stack_.back(), *given[1], *given[2], *given[0]);
    }
    return bad("a call of NumPy's functions for arrays", printable(function.name) + " with other arguments");
  }

  static Status bad_dtype(std::string_view text) {
    return bad("a dtype of numbers", printable(std::string(text.substr(0, 40))));
  }
  static Status fill(Value& array, const Value& dtype, const Value& shape, const Value& elements) {
    if (!dtype.is_whole && dtype.array.item > 1) return bad("a dtype with its byte order", "none");
    array.array = dtype.array;
    for (const Value* n : shape.items) {
      if (n->type != Type::integer || array.array.shape.size() == kMaxRank) return bad("a shape", "another value");
      array.array.shape.push_back(n->integer);
    }
    array.array.data = elements.data;
    if (shape.type != Type::list || !fits(array.array))
      return bad("as many elements as the shape says", "another number");
    array.is_whole = true;
    return {};
  }

  /// The second step of an object, an array or a dtype.
  Status build() {
    if (n_free() < 2) return nothing();
    Value &made = *stack_[stack_.size() - 2], &state = *stack_.back();
    stack_.pop_back();
    if (made.type == Type::object && state.type == Type::map && made.items.empty()) {
      made.items = {&state};
      return {};
    }
    const std::vector<const Value*>& given = state.items;
    if (made.type == Type::dtype && !made.is_whole && state.type == Type::list && given.size() >= 5 &&
        given[1]->type == Type::text) {
      for (std::size_t i = 2; i < 5; ++i)
        if (given[i]->type != Type::none) return bad("a dtype of numbers", "one with fields");
      const std::string_view order = given[1]->data;
      if (order != "<" && order != ">" && order != "|") return bad("a byte order", "another text");
      made.array.is_big_endian = order == ">";
      made.is_whole = true;
      return {};
    }
    if (made.type == Type::array && !made.is_whole && state.type == Type::list && given.size() == 5 &&
        given[1]->type == Type::list && given[2]->type == Type::dtype && given[4]->type == Type::bytes) {
      if (given[3]->type != Type::boolean || given[3]->integer != 0) return bad("arrays in C order", "another");
      return fill(made, *given[2], *given[1], *given[4]);
    }
    return bad("the state of an object or an array", "another");
  }

  std::string_view left_;
  Pickle out_;
  std::vector<Value*> stack_, memo_;
  std::vector<std::size_t> marks_;
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
