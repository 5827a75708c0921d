// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "base/result.h"

namespace vla::observe {

struct HttpReply {
  int status = 200;
  std::string type = "text/plain; charset=utf-8";
  std::string body;
};

/// Answers GET or POST of a path; `query` is the part after the question mark. Bodies are not read.
using HttpHandler = std::function<HttpReply(const std::string& path, const std::string& query)>;

/// The HTTP server for monitoring. One thread serves all connections and blocks on none. A connection must ask and read
/// its answer within a time limit, and the oldest one is closed if there are too many, so a slow or broken client
/// delays no other.
class Http {
 public:
  /// Listens at HOST:PORT. HOST is an IPv4 address, an IPv6 address in brackets, or `*`. An address that other hosts
  /// can reach needs `insecure`, since HTTP has no keys. Handlers run on the thread of Http; without a handler POST is
  /// refused. `option`: the place in errors. Errors: usage, io, out_of_memory.
  static Result<std::unique_ptr<Http>> open(const std::string& address, const char* option, bool insecure,
                                            HttpHandler get, HttpHandler post = {});
  ~Http();

  /// The bound address with its port.
  const std::string& address() const;

 private:
  class Server;
  explicit Http(std::unique_ptr<Server> server);
  std::unique_ptr<Server> server_;
};

}  // namespace vla::observe
