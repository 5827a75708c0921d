// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/msgpack/writer.h"

#include <cstring>
#include <msgpack.hpp>

#include "base/npy.h"

namespace vla::msgpack {
namespace {

using Packer = ::msgpack::packer<Writer>;

std::uint32_t u32(std::size_t n) { return static_cast<std::uint32_t>(n); }

}  // namespace

Writer& Writer::map(std::size_t n) { return Packer(*this).pack_map(u32(n)), *this; }
Writer& Writer::list(std::size_t n) { return Packer(*this).pack_array(u32(n)), *this; }
Writer& Writer::text(std::string_view v) {
  return Packer(*this).pack_str(u32(v.size())).pack_str_body(v.data(), u32(v.size())), *this;
}
Writer& Writer::bytes(std::string_view v) {
  return Packer(*this).pack_bin(u32(v.size())).pack_bin_body(v.data(), u32(v.size())), *this;
}
/// Writes the bytes itself: the library writes floats without a fraction as integers.
Writer& Writer::real(double v) {
  std::uint64_t bits;
  std::memcpy(&bits, &v, sizeof bits);
  out_ += '\xcb';
  for (int shift = 56; shift >= 0; shift -= 8) out_ += static_cast<char>(bits >> shift);
  return *this;
}
Writer& Writer::integer(std::int64_t v) { return Packer(*this).pack_int64(v), *this; }
Writer& Writer::boolean(bool v) { return v ? Packer(*this).pack_true() : Packer(*this).pack_false(), *this; }
Writer& Writer::nil() { return Packer(*this).pack_nil(), *this; }

Writer& Writer::array(Framing framing, std::span<const std::size_t> shape, std::span<const float> values) {
  const std::string_view data(reinterpret_cast<const char*>(values.data()), values.size_bytes());
  const auto put_shape = [&] {
    list(shape.size());
    for (const std::size_t size : shape) integer(static_cast<std::int64_t>(size));
  };
  switch (framing) {
    case Framing::openpi:
      map(4).bytes("__ndarray__").boolean(true).bytes("data").bytes(data).bytes("dtype").text("<f4").bytes("shape");
      return put_shape(), *this;
    case Framing::numpy:
      map(5).bytes("nd").boolean(true).bytes("type").text("<f4").bytes("kind").bytes("").bytes("shape");
      return put_shape(), bytes("data").bytes(data);
    case Framing::npy:
      break;
  }
  return map(2).text("__ndarray_class__").boolean(true).text("as_npy").bytes(npy_header(shape) + std::string(data));
}

}  // namespace vla::msgpack
