// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "serve/lerobot/pickle.h"

namespace vla::test {

/// How an array is pickled.
struct PickledArray {
  std::string letters = "u1";  // its dtype without the order
  std::string order = "|";
  std::vector<std::int64_t> shape = {};
  std::string data = {};
  bool is_fortran = false;
  bool by_buffer = false;  // as protocol 5 does
};

/// Puts the array on the stack of a pickle, as NumPy writes it.
inline void pickle_array(pickle::Writer& out, const PickledArray& array) {
  const auto bytes = [&](const std::string& data) {
    const auto size = static_cast<std::uint32_t>(data.size());
    out.op('B');
    for (int shift = 0; shift < 32; shift += 8) out.op(static_cast<char>(size >> shift));
    for (const char byte : data) out.op(byte);
  };
  const auto flag = [&](bool value) { out.op(value ? '\x88' : '\x89'); };
  const auto shape = [&] {
    out.op('(');
    for (const std::int64_t size : array.shape) out.integer(size);
    out.op('t');
  };
  const auto dtype = [&] {
    out.name("numpy", "dtype").text(array.letters);
    flag(false), flag(true);
    out.op('\x87').op('R').op('(').integer(3).text(array.order).op('N').op('N').op('N');
    out.integer(-1).integer(-1).integer(0).op('t').op('b');
  };
  if (array.by_buffer) {
    out.name("numpy._core.numeric", "_frombuffer").op('(');
    bytes(array.data), dtype(), shape();
    out.text(array.is_fortran ? "F" : "C").op('t').op('R');
    return;
  }
  out.name("numpy.core.multiarray", "_reconstruct").name("numpy", "ndarray").integer(0).op('\x85');
  bytes("b");
  out.op('\x87').op('R').op('(').integer(1);
  shape(), dtype(), flag(array.is_fortran), bytes(array.data);
  out.op('t').op('b');
}

/// LeRobot's TimedObservation of one camera, `image`, and three motors.
inline std::string pickled_observation(const PickledArray& image) {
  pickle::Writer out;
  out.name("lerobot.async_inference.helpers", "TimedObservation").op(')').op('\x81').op('}').op('(');
  out.text("timestamp")
      .real(1)
      .text("timestep")
      .integer(3)
      .text("must_go")
      .op('\x88')
      .text("observation")
      .op('}')
      .op('(');
  out.text("arm.0").real(1).text("arm.1").real(2).text("hand").real(3).text("task").text("go").text("image");
  pickle_array(out, image);
  return out.op('u').op('u').op('b').take();
}

}  // namespace vla::test
