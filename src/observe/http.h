// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "base/result.h"

namespace vla::serve {

struct HttpReply {
  int status = 200;
  std::string type = "text/plain; charset=utf-8";
  std::string body;
};

/// The answer to GET of a path, or to POST; `query` is what follows its question mark. A body is not read.
using HttpHandler = std::function<HttpReply(const std::string& path, const std::string& query)>;

/// HTTP for those who watch the server. One thread serves all connections and waits for none of them. A connection has
/// a time to ask and take its answer, and the oldest one makes room where there are too many, so that a slow or broken
/// client blocks no other.
class Http {
 public:
  /// Listens at once, at HOST:PORT, HOST an IPv4 address, an IPv6 address in brackets, or `*`. An address that others
  /// can reach needs `insecure`: HTTP has no keys. The handlers are called on the thread of Http; without one for POST
  /// that is refused. `option`: where errors are. Errors: usage, io, out_of_memory.
  static Result<std::unique_ptr<Http>> open(const std::string& address, const char* option, bool insecure,
                                            HttpHandler get, HttpHandler post = {});
  ~Http();

  /// The bound address, the port filled in.
  const std::string& address() const;

 private:
  class Server;
  explicit Http(std::unique_ptr<Server> server);
  std::unique_ptr<Server> server_;
};

}  // namespace vla::serve
