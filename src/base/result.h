// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <utility>
#include <variant>

namespace vla {

/// Error classes, one per exit code and per code on the wire (src/wire/vla.proto), with equal numbers. `code_name`
/// gives the spelling that users see. The last seven are errors that a server returns.
enum class Code {
  internal,
  usage,
  bad_bundle,
  bad_observation,
  bad_action,
  unsupported,
  out_of_memory,
  device,
  io,
  mismatch,
  bad_request,
  incompatible,
  too_large,
  busy,
  superseded,
  late,
  shutting_down
};

/// The exit code of the process: 0 is success, each class has its own number.
constexpr int exit_code(Code code) { return 1 + static_cast<int>(code); }

constexpr const char* code_name(Code code) {
  constexpr const char* kNames[] = {
      "internal",   "usage", "bad_bundle",   "bad_observation", "bad_action",   "unsupported", "out_of_memory",
      "device",     "io",    "mismatch",     "bad_request",     "incompatible", "too_large",   "busy",
      "superseded", "late",  "shutting_down"};
  return kNames[static_cast<int>(code)];
}

/// A problem: where it is, what was expected, what was found, and what to do next.
struct Error {
  Code code = Code::internal;
  std::string where;     // file, key, tensor path or feature name
  std::string expected;  // may be empty where `found` says everything
  std::string found;     // `nothing` if an empty text was found
  std::string hint;      // what to do next, if that is known

  Error() = default;
  Error(Code c, std::string place, std::string wanted, std::string finding, std::string next = {})
      : code(c),
        where(std::move(place)),
        expected(std::move(wanted)),
        found(finding.empty() && !expected.empty() ? "nothing" : std::move(finding)),
        hint(std::move(next)) {}

  /// `where: expected E, found F; hint`
  std::string message() const {
    std::string text = where + ": ";
    if (!expected.empty()) text += "expected " + expected + ", found ";
    text += found;
    if (!hint.empty()) text += "; " + hint;
    return text;
  }
};

/// A value or an Error. Our own code does not throw; library exceptions are caught where the library is called.
template <class T>
class [[nodiscard]] Result {
 public:
  Result(T value) : data_(std::move(value)) {}
  Result(Error error) : data_(std::move(error)) {}

  bool ok() const { return data_.index() == 0; }
  explicit operator bool() const { return ok(); }
  T& value() { return std::get<0>(data_); }
  const T& value() const { return std::get<0>(data_); }
  T& operator*() { return value(); }
  const T& operator*() const { return value(); }
  T* operator->() { return &value(); }
  const T* operator->() const { return &value(); }
  const Error& error() const { return std::get<1>(data_); }

 private:
  std::variant<T, Error> data_;
};

template <>
class [[nodiscard]] Result<void> {
 public:
  Result() = default;
  Result(Error error) : error_(std::move(error)) {}

  bool ok() const { return !error_; }
  explicit operator bool() const { return ok(); }
  const Error& error() const { return *error_; }

 private:
  std::optional<Error> error_;
};

using Status = Result<void>;

}  // namespace vla

#define VLA_CONCAT_INNER(a, b) a##b
#define VLA_CONCAT(a, b) VLA_CONCAT_INNER(a, b)

/// `VLA_TRY(Inputs in, encode(obs));` declares `in`, or returns the error from the enclosing function.
#define VLA_TRY(declaration, expression)             \
  auto VLA_CONCAT(result_, __LINE__) = (expression); \
  if (!VLA_CONCAT(result_, __LINE__)) {              \
    return VLA_CONCAT(result_, __LINE__).error();    \
  }                                                  \
  declaration = std::move(VLA_CONCAT(result_, __LINE__).value())

/// `VLA_CHECK(run());` returns the error of a Status from the enclosing function.
#define VLA_CHECK(expression)                                          \
  do {                                                                 \
    if (auto status_ = (expression); !status_) return status_.error(); \
  } while (false)
