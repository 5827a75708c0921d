// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>

#include "serve/front.h"
#include "serve/msgpack/array.h"
#include "serve/names.h"

namespace vla::serve::gr00t {

/// How a client of one of the releases sends an act, and so how it reads the answer.
struct Dialect {
  msgpack::Framing framing = msgpack::Framing::numpy;
  bool is_n1_5 = false;     // `data` is the observation itself, and the answer a map without a batch's list
  bool is_flat = false;     // keys are `video.camera` and so on, also those of the answer
  bool is_batched = false;  // actions have a dimension of one for the batch
};

/// The part of a request that is one observation, its maps flattened to keys such as `video.front`, and its text at
/// `text`. Errors: bad_observation for what is no observation, for more than one, or for more than one time step.
struct Observed {
  Dialect dialect;
  msgpack::Value flat;  // over the request's bytes and `keys`
  std::deque<std::string> keys;
  Extension extension;
};
Result<Observed> read_observation(const msgpack::Value* data);

/// The answer to an act. Columns of actions with names such as `arm.0`, `arm.1` are one array, `arm`.
std::string encode_reply(Reply reply, const Dialect& dialect, const Names& names, const v1::Description& description);

/// The answer to get_modality_config. Clients ask before they have sent an array, so that N1.6 and N1.7, which know it
/// by other marks, get both.
std::string encode_modalities(const Dialect& dialect, const Names& names, const v1::Description& description);

std::string encode_error(const Error& error);
std::string encode_ping();
std::string encode_nothing();  // to `kill`
std::string encode_reset();

}  // namespace vla::serve::gr00t
