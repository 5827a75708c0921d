// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "serve/front.h"
#include "serve/names.h"
#include "serve/openpi/sockets.h"
#include "serve/options.h"

namespace vla::serve::openpi {

/// The protocol of openpi's policy server: msgpack over WebSocket (docs/drop_in.md).
class Front final : public serve::Front, Sockets::Handler {
 public:
  /// Binds `options.openpi`. Errors: usage, io.
  static Result<std::unique_ptr<Front>> open(net::Loop& loop, const ServerOptions& options);

  static Result<Names> names_of(const ServerOptions& options, const v1::Description& description);

  std::vector<std::string> addresses() const override { return {"ws://" + address_}; }
  Status serve(const ServedPolicy& policy) override;
  void replaced(const v1::Description& description) override;
  std::string told() const override { return "openpi=" + names_.told(); }
  void begin(Io& io) override;
  bool has_answers() const override { return sockets_.has_answers(); }

 private:
  class Request;
  Front(net::Loop& loop, const ServerOptions& options, std::string api_key);
  std::string greeting() const override { return metadata_; }
  void received(Peer& peer, std::string message, bool is_text) override;
  void dropped(const Peer& peer, const std::string& why, const std::string& detail) override;

  const ServerOptions options_;
  Sockets sockets_;
  std::string address_, metadata_;
  Names names_;
  Io* io_ = nullptr;
};

}  // namespace vla::serve::openpi
