// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/native/call.h"

#include "serve/native/codec.h"

namespace vla::serve {

Result<ActRequest> NativeCall::decode(const ServedPolicy& policy) {
  const std::span<const std::byte> act = envelope_.body(bytes_.span());
  VLA_TRY(const std::string embodiment, named_embodiment(act));
  VLA_TRY(const Robot* robot, policy.engine->robot(embodiment));
  ActLimits limits = act_limits(options_, *robot);
  limits.max_views = policy.description.limits().max_views();  // the maximum over all robots, from the description
  return decode_act(act, limits, robot->processor().views(), robot->processor().states());
}

std::string NativeCall::encode(Reply reply, const ServedPolicy& policy) {
  v1::Response response = response_to(envelope_.request_id);
  const v1::Description& description = description_of(policy.description, reply.request.observation.embodiment);
  *response.mutable_chunk() = encode_chunk(std::move(reply), description);
  return response.SerializeAsString();
}

std::string NativeCall::encode(const Error& error) { return refusal(envelope_.request_id, error); }

}  // namespace vla::serve
