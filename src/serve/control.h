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

/// Takes orders to a running server over a Unix socket that only the server's user can open. A client sends one line of
/// JSON, {"do": "list"}, {"do": "load", "policy": NAME, "bundle": PATH}, {"do": "unload", "policy": NAME} or {"do":
/// "drain"}. It gets one line back when the order is done; the line contains "error" if the order was refused. Orders
/// run one at a time. A client that sends its order slowly does not delay other clients.
class Control {
 public:
  /// The parts of the program that an order needs or changes; called on the thread of Control.
  struct Program {
    std::function<Result<LoadedPolicy>(const std::string& bundle)> load;
    std::function<void(const std::string& policy, const Engine& engine)> loaded;
    std::function<void(const std::string& policy)> unloaded;
  };
  /// Binds the path. `server` and everything that `program` refers to must outlive the result. Errors: io, usage.
  static Result<std::unique_ptr<Control>> open(const std::string& path, Server& server, Program program);
  /// Starts to accept orders.
  Status start();
  /// Stops accepting orders. Returns whether the order in progress ended within `patience`: loading a bundle cannot be
  /// interrupted.
  bool stop(std::chrono::milliseconds patience);
  /// Waits for the order in progress.
  ~Control();

 private:
  /// A client whose order has not arrived completely.
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
  std::promise<void> ended_;          // set when the thread ends
  std::future<void> thread_ended_ = ended_.get_future();
  std::thread thread_;
};

/// Sends an order to the server at this path and returns its answer. Errors: io, and those of the order.
Result<nlohmann::ordered_json> order(const std::string& path, const nlohmann::ordered_json& given);

}  // namespace vla::serve
