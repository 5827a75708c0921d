// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <thread>

#include "cli/observability.h"
#include "serve/server.h"

namespace vla::cli {

/// A bundle in memory that has computed an act, and how long both took.
struct LoadedPolicy {
  std::shared_ptr<Engine> engine;
  double load_ms = 0, warm_up_ms = 0;
};

/// Orders to a server that runs, over a socket in the file system that only its own user can open. A client sends one
/// line of JSON, {"do": "list"}, {"do": "load", "policy": NAME, "bundle": PATH}, {"do": "unload", "policy": NAME} or
/// {"do": "drain"}, and gets one back when it is done, with "error" in it where it was refused. One order at a time.
class Control {
 public:
  using Load = std::function<Result<LoadedPolicy>(const std::string& bundle)>;
  /// Binds the path. Everything outlives it. Errors: io, usage.
  static Result<std::unique_ptr<Control>> open(const std::string& path, serve::Server& server,
                                               Observability& observability, Load load);
  /// Takes orders from now on.
  Status start();
  ~Control();

 private:
  Control(std::string path, serve::Server& server, Observability& observability, Load load)
      : path_(std::move(path)), server_(server), observability_(observability), load_(std::move(load)) {}
  Status bind();
  void run();
  void answer(int client);
  std::string obey(const std::string& line);

  const std::string path_;
  serve::Server& server_;
  Observability& observability_;
  const Load load_;
  int listener_ = -1, stopped_ = -1;  // a socket, an eventfd
  std::thread thread_;
};

/// Sends an order to the server at this path. Its answer. Errors: io, and those of the order.
Result<std::string> order(const std::string& path, const std::string& line);

}  // namespace vla::cli
