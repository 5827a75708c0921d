// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "serve/front.h"
#include "serve/gr00t/codec.h"
#include "serve/options.h"
#include "zmtp/hub.h"

namespace vla::serve::gr00t {

/// The protocol of Isaac-GR00T's policy server: msgpack over ZeroMQ (docs/drop_in.md).
class Front final : public serve::Front, zmtp::Hub::Handler {
 public:
  /// Binds `options.gr00t`. Errors: usage, io.
  static Result<std::unique_ptr<Front>> open(net::Loop& loop, const ServerOptions& options);

  static Result<Names> names_of(const ServerOptions& options, const v1::Description& description);

  std::vector<std::string> addresses() const override { return {"gr00t+" + address_}; }
  Status serve(const ServedPolicy& policy) override;
  void replaced(const v1::Description& description) override { description_ = description; }
  std::string told() const override { return "gr00t=" + names_.told(); }
  void begin(Io& io) override;
  bool has_answers() const override { return hub_.has_answers(); }

 private:
  class Request;
  Front(net::Loop& loop, const ServerOptions& options, std::string api_token);
  void received(zmtp::Client& client, zmtp::Message message) override;
  void dropped(const zmtp::Client& client, const std::string& why, const std::string& detail) override;
  Result<std::string> answer_now(const std::string& endpoint) const;

  const ServerOptions options_;
  const std::string api_token_;
  zmtp::Hub hub_;
  std::string address_;
  v1::Description description_;
  Names names_;
  Dialect last_;  // release of the last act, for requests without arrays
  Io* io_ = nullptr;
};

}  // namespace vla::serve::gr00t
