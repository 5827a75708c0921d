// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <functional>
#include <future>
#include <list>
#include <memory>
#include <nlohmann/json_fwd.hpp>
#include <string>
#include <thread>

#include "base/clock.h"
#include "serve/server.h"

namespace vla::serve {

/// A bundle in memory that has computed an act, and how long both took.
struct LoadedPolicy {
  std::shared_ptr<Engine> engine;
  double load_ms = 0, warm_up_ms = 0;
};

/// Orders to a server that runs, over a socket in the file system that only its own user can open. A client sends one
/// line of JSON, {"do": "list"}, {"do": "load", "policy": NAME, "bundle": PATH}, {"do": "unload", "policy": NAME} or
/// {"do": "drain"}, and gets one back when it is done, with "error" in it where it was refused. One order is obeyed at
/// a time; a client that takes long to give its own keeps none of the others waiting.
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
  /// Takes no orders any more. Whether the one that was being obeyed ended in this time: a bundle that is being loaded
  /// cannot be told to stop.
  bool stop(std::chrono::milliseconds patience);
  /// Waits for the order that is being obeyed.
  ~Control();

 private:
  /// One whose order has not come whole yet.
  struct Client {
    int socket;  // -1 once it is answered
    Clock::time_point until;
    std::string line = {};
  };

  Control(std::string path, Server& server, Program program)
      : path_(std::move(path)), server_(server), program_(std::move(program)) {}
  Status bind();
  void run();
  static bool has_room(const std::list<Client>& clients);
  static int ms_left(const std::list<Client>& clients, bool takes);
  void accept(std::list<Client>& clients);
  void answer(Client& client);
  Result<nlohmann::ordered_json> obey(const nlohmann::ordered_json& given);
  Result<nlohmann::ordered_json> load(const std::string& policy, const std::string& bundle);

  const std::string path_;
  Server& server_;
  const Program program_;
  int listener_ = -1, stopped_ = -1;  // a socket, an eventfd
  std::promise<void> ended_;          // of the thread
  std::future<void> thread_ended_ = ended_.get_future();
  std::thread thread_;
};

/// Sends an order to the server at this path. Its answer. Errors: io, and those of the order.
Result<nlohmann::ordered_json> order(const std::string& path, const nlohmann::ordered_json& given);

}  // namespace vla::serve
