// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>

#include "serve/front.h"
#include "serve/msgpack/array.h"
#include "serve/names.h"

namespace vla::serve::gr00t {

/// Which release a client speaks, and thus how it reads the answer.
struct Dialect {
  msgpack::Framing framing = msgpack::Framing::numpy;
  bool is_n1_5 = false;     // `data` itself is the observation, and the answer is a map, not a list of two
  bool is_flat = false;     // keys such as `video.camera`, also in the answer
  bool is_batched = false;  // actions have a batch dimension of one
};

/// One observation of a request: its maps flattened to keys such as `video.front`, and the text at `text`.
/// `read_observation` fails with bad_observation if the request has no observation, or more than one observation or
/// time step.
struct Observed {
  Dialect dialect;
  msgpack::Value flat;  // points into the request's bytes and `keys`
  std::deque<std::string> keys;
  Extension extension;
};
Result<Observed> read_observation(const msgpack::Value* data);

/// Encodes the answer to an act. Action columns named `arm.0`, `arm.1`, ... become one array `arm`.
std::string encode_reply(Reply reply, const Dialect& dialect, const Names& names, const v1::Description& description);

/// Answers get_modality_config. Clients ask before they send an array, so the release is unknown, and the answer has
/// the marks of both N1.6 and N1.7.
std::string encode_modalities(const Dialect& dialect, const Names& names, const v1::Description& description);

std::string encode_error(const Error& error);
std::string encode_ping();
std::string encode_nothing();  // the answer to `kill`
std::string encode_reset();

}  // namespace vla::serve::gr00t
