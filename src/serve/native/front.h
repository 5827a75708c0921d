// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>

#include "serve/front.h"
#include "serve/options.h"
#include "zmtp/hub.h"

namespace vla::serve {

/// The protocol of docs/protocol.md: Protobuf over ZeroMQ.
class NativeFront final : public Front, zmtp::Hub::Handler {
 public:
  /// Binds the addresses. Errors: those of Server::open.
  static Result<std::unique_ptr<NativeFront>> open(net::Loop& loop, const ServerOptions& options);

  std::vector<std::string> addresses() const override { return addresses_; }
  Status serve(const ServedPolicy&) override { return {}; }
  void begin(Io& io) override;
  bool has_answers() const override { return hub_.has_answers(); }

 private:
  class Request;
  NativeFront(net::Loop& loop, const ServerOptions& options, std::optional<zmtp::CurveKeys> keys);
  Status bind();
  void received(zmtp::Client& client, zmtp::Message message) override;
  void dropped(const zmtp::Client& client, const std::string& why, const std::string& detail) override;
  void handle(zmtp::Client& client, Job job, const wire::Envelope& envelope, const Status& valid);
  Result<v1::Response> answer_now(zmtp::Client& client, const Job& job, const wire::Envelope& envelope) const;
  void send_out_of_memory(std::uint64_t connection, std::uint64_t request_id, const zmtp::Envelope& before) noexcept;

  const ServerOptions options_;
  const std::optional<zmtp::CurveKeys> keys_;
  zmtp::Hub hub_;
  std::vector<std::string> addresses_;
  Io* io_ = nullptr;
};

}  // namespace vla::serve
