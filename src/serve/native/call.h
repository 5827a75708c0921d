// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "serve/front.h"
#include "serve/options.h"

namespace vla::serve {

/// A request that is a serialized v1::Request, from any front end.
class NativeCall : public Call {
 public:
  NativeCall(const ServerOptions& options, net::Bytes bytes, const wire::Envelope& envelope)
      : options_(options), bytes_(std::move(bytes)), envelope_(envelope) {}

  Result<ActRequest> decode(const ServedPolicy& policy) override;
  std::string encode(Reply reply, const ServedPolicy& policy) override;
  std::string encode(const Error& error) override;
  const net::Bytes* native() const override { return &bytes_; }

 protected:
  std::uint64_t request_id() const { return envelope_.request_id; }
  void free() { bytes_ = {}; }

 private:
  const ServerOptions& options_;
  net::Bytes bytes_;
  const wire::Envelope envelope_;
};

}  // namespace vla::serve
