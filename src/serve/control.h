// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <nlohmann/json_fwd.hpp>
#include <string>
#include <thread>

#include "serve/server.h"

namespace vla::serve {

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
  /// The parts of the program that an order needs or changes; called on the thread of Control.
  struct Program {
    std::function<Result<LoadedPolicy>(const std::string& bundle)> load;
    std::function<void(const std::string& policy, const Engine& engine)> loaded;
    std::function<void(const std::string& policy)> unloaded;
  };
  /// Binds the path. Everything outlives it. Errors: io, usage.
  static Result<std::unique_ptr<Control>> open(const std::string& path, Server& server, Program program);
  /// Takes orders from now on.
  Status start();
  ~Control();

 private:
  Control(std::string path, Server& server, Program program)
      : path_(std::move(path)), server_(server), program_(std::move(program)) {}
  Status bind();
  void run();
  void answer(int client);
  Result<nlohmann::ordered_json> obey(const nlohmann::ordered_json& given);
  Result<nlohmann::ordered_json> load(const std::string& policy, const std::string& bundle);

  const std::string path_;
  Server& server_;
  const Program program_;
  int listener_ = -1, stopped_ = -1;  // a socket, an eventfd
  std::thread thread_;
};

/// Sends an order to the server at this path. Its answer. Errors: io, and those of the order.
Result<nlohmann::ordered_json> order(const std::string& path, const nlohmann::ordered_json& given);

}  // namespace vla::serve
