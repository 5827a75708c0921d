// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "zmtp/curve.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sodium.h>
#include <sys/stat.h>
#include <unistd.h>
#include <zmq.h>

#include <array>
#include <cerrno>
#include <cstring>
#include <sstream>
#include <vector>

#include "base/file.h"

namespace vla::zmtp {
namespace {

constexpr std::size_t kKeySize = 40;  // characters of Z85 for 32 bytes
constexpr std::size_t kMaxFile = 1 << 20;

bool is_key(const std::string& text) {
  std::array<std::uint8_t, 32> bytes;
  return text.size() == kKeySize && zmq_z85_decode(bytes.data(), text.c_str()) != nullptr;
}

Result<std::string> read_text(const std::string& file) {
  VLA_TRY(const std::vector<std::byte> bytes, read_file(file, kMaxFile));
  return std::string(reinterpret_cast<const char*>(bytes.data()), bytes.size());
}

/// Never overwrites a key that may be in use.
Status write_key(const std::string& file, const char* key, unsigned mode) {
  const std::string line = std::string(key) + "\n";
  if (const Status written = write_new_file(file, std::as_bytes(std::span(line)), mode); !written)
    return Error{Code::io, file, "a new file", written.error().found, "name another prefix, or remove the old keys"};
  return {};
}

}  // namespace

Status write_key_pair(const std::string& prefix) {
  std::array<char, kKeySize + 1> public_key, secret_key;
  if (zmq_curve_keypair(public_key.data(), secret_key.data()) != 0)
    return Error{Code::unsupported, "keygen", "a ZeroMQ library with CURVE", "one without"};
  struct stat there;
  if (::stat((prefix + ".public").c_str(), &there) == 0)
    return Error{Code::io, prefix + ".public", "a new file", "File exists",
                 "name another prefix, or remove the old keys"};
  VLA_CHECK(write_key(prefix + ".secret", secret_key.data(), 0600));
  const Status written = write_key(prefix + ".public", public_key.data(), 0644);
  if (!written) ::unlink((prefix + ".secret").c_str());  // removes the secret key: half a pair is useless
  return written;
}

Result<std::string> read_secret_key(const std::string& file) {
  VLA_TRY(std::string text, read_text(file));
  while (!text.empty() && std::strchr(" \t\r\n", text.back()) != nullptr) text.pop_back();
  if (!is_key(text))
    return Error{Code::usage, file, "one CURVE key of 40 characters", "something else", "vla keygen writes one"};
  struct stat info;
  if (::stat(file.c_str(), &info) == 0 && (info.st_mode & 077) != 0)
    return Error{Code::usage, file, "a secret that only its owner may read",
                 fmt::format("mode {:o}", info.st_mode & 0777), "chmod 600 " + file};
  return text;
}

Result<std::set<std::string>> read_public_keys(const std::string& file) {
  VLA_TRY(const std::string text, read_text(file));
  std::set<std::string> keys;
  std::istringstream lines(text);
  std::string line, key;
  for (int number = 1; std::getline(lines, line); ++number) {
    std::istringstream words(line);
    if (!(words >> key) || key == "#") continue;
    if (!is_key(key))
      return Error{Code::usage, fmt::format("{}:{}", file, number), "a CURVE key of 40 characters", "something else",
                   "vla keygen writes one into PREFIX.public"};
    keys.insert(key);
  }
  if (keys.empty()) return Error{Code::usage, file, "at least one public key of a client", "none"};
  return keys;
}

Result<std::string> public_key_of(const std::string& secret) {
  std::array<char, kKeySize + 1> key;
  if (zmq_curve_public(key.data(), secret.c_str()) != 0)
    return Error{Code::usage, "secret key", "a CURVE key", "something else"};
  return std::string(key.data());
}

Result<CurveKeys> read_keys(const std::string& secret_file, const std::string& clients_file) {
  if (sodium_init() < 0) return Error{Code::unsupported, "--curve-secret", "random numbers of the system", "none"};
  VLA_TRY(const std::string secret, read_secret_key(secret_file));
  VLA_TRY(const std::set<std::string> clients, read_public_keys(clients_file));
  CurveKeys keys;
  zmq_z85_decode(keys.secret.data(), secret.c_str());
  crypto_scalarmult_base(keys.own_public.data(), keys.secret.data());
  for (const std::string& client : clients) {
    std::string bytes(32, '\0');
    zmq_z85_decode(reinterpret_cast<std::uint8_t*>(bytes.data()), client.c_str());
    keys.clients.insert(std::move(bytes));
  }
  return keys;
}

}  // namespace vla::zmtp
