// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <chrono>
#include <condition_variable>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>
#include <zmq.hpp>

#include "serve/server.h"
#include "support/editable_bundle.h"
#include "support/golden_case.h"

namespace vla::test {

inline const std::string kGolden = golden_path("smolvla/two_views");

/// The act that a golden case is, with its frames as raw rows and its noise.
inline v1::Request act_request(const GoldenCase& golden, std::uint64_t request_id) {
  v1::Request request;
  request.set_protocol_version(1);
  request.set_request_id(request_id);
  v1::Act& act = *request.mutable_act();
  for (const auto& [name, frame] : golden.observation.views) {
    v1::View& view = *act.add_views();
    view.set_name(name);
    if (!frame) {
      view.mutable_absent();
      continue;
    }
    const auto& rows = std::get<std::vector<std::uint8_t>>(frame->rgb);
    view.mutable_rgb()->set_width(static_cast<std::uint32_t>(frame->width));
    view.mutable_rgb()->set_height(static_cast<std::uint32_t>(frame->height));
    view.mutable_rgb()->set_rows(rows.data(), rows.size());
  }
  for (const auto& [name, values] : golden.observation.states) {
    v1::State& state = *act.add_states();
    state.set_name(name);
    state.mutable_values()->Add(values.begin(), values.end());
  }
  act.set_text(*golden.observation.text);
  act.set_seed(1);
  return request;
}

inline const GoldenCase& golden() {
  static const GoldenCase read = GoldenCase::read(kGolden);
  return read;
}

inline v1::Request request_of(std::uint64_t request_id) {
  v1::Request request;
  request.set_protocol_version(1);
  request.set_request_id(request_id);
  return request;
}

/// A client without manners: it sends what it is told to.
class Peer {
 public:
  explicit Peer(const std::string& address, zmq::socket_type type = zmq::socket_type::dealer) : socket(context, type) {
    socket.set(zmq::sockopt::linger, 0);
    socket.set(zmq::sockopt::sndtimeo, 20'000);
    socket.connect(address);
  }
  void send(const std::string& bytes) { REQUIRE(socket.send(zmq::buffer(bytes)).has_value()); }
  void send(const v1::Request& request) { send(request.SerializeAsString()); }
  /// The next answer, or none within the time.
  std::optional<v1::Response> receive(int timeout_ms = 20'000) {
    socket.set(zmq::sockopt::rcvtimeo, timeout_ms);
    zmq::message_t message;
    if (!socket.recv(message)) return std::nullopt;
    REQUIRE(!message.more());
    v1::Response response;
    REQUIRE(response.ParseFromArray(message.data(), static_cast<int>(message.size())));
    return response;
  }
  /// The next answer; fails the test where none comes.
  v1::Response answer() {
    auto response = receive();
    REQUIRE(response.has_value());
    return *response;
  }
  v1::Response ask(const std::string& bytes) {
    send(bytes);
    return answer();
  }
  v1::Response ask(const v1::Request& request) { return ask(request.SerializeAsString()); }

  zmq::context_t context;
  zmq::socket_t socket;
};

inline std::string code_of(const v1::Response& response) {
  return response.has_error() ? v1::Error::Code_Name(response.error().code()) : "";
}

inline void check_serves(Peer& peer) {
  const v1::Response response = peer.ask(act_request(golden(), 4242));
  CHECK(response.request_id() == 4242);
  CHECK(response.chunk().horizon() > 0);
}

/// Holds the engine thread before each act until it is let go on, so that what waits is known.
class Brake : public observe::Observer {
 public:
  void started(const observe::Received&) override {
    std::unique_lock lock(mutex_);
    ++n_started_;
    changed_.notify_all();
    changed_.wait(lock, [this] { return n_let_go_ >= n_started_; });
  }
  /// Waits until the n-th act is about to be computed.
  void await(int n) {
    std::unique_lock lock(mutex_);
    REQUIRE(changed_.wait_for(lock, std::chrono::seconds(20), [&] { return n_started_ >= n; }));
  }
  void let_go(int n = 1) {
    const std::lock_guard lock(mutex_);
    n_let_go_ += n;
    changed_.notify_all();
  }
  /// From now on holds nothing.
  void release() { let_go(1 << 30); }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  int n_started_ = 0, n_let_go_ = 0;
};

/// A server on a free port, with a thread of its own, which a brake may hold.
class Running {
 public:
  explicit Running(serve::ServerOptions options = {}, std::vector<observe::Observer*> observers = {},
                   Brake* brake = nullptr, serve::SeenSizes* sizes = nullptr,
                   const std::string& bundle = kGolden + "/bundle.gguf")
      : engine(load_engine(bundle)), observers_(std::move(observers)), brake_(brake) {
    if (brake_ != nullptr) observers_.push_back(brake_);
    if (options.bind == serve::ServerOptions().bind) options.bind = {"tcp://127.0.0.1:0"};
    auto opened = serve::Server::open(options);
    REQUIRE_MESSAGE(opened.ok(), (opened ? "" : opened.error().message()));
    server = std::move(*opened);
    const Status loaded = server->add("policy", engine);
    REQUIRE_MESSAGE(loaded.ok(), (loaded ? "" : loaded.error().message()));
    server->keep_sizes(sizes);
    REQUIRE(server->begin());
    thread_ = std::thread([this] { status_ = server->run(observers_); });
  }
  ~Running() {
    if (brake_ != nullptr) brake_->release();  // a test that failed has not let go
    server->stop();
    CHECK(join().ok());
  }
  std::string address() const { return server->addresses().front(); }
  Status join() {
    if (thread_.joinable()) thread_.join();
    return status_;
  }

  std::shared_ptr<Engine> engine;
  std::unique_ptr<serve::Server> server;

 private:
  std::vector<observe::Observer*> observers_;
  Brake* brake_;
  std::thread thread_;
  Status status_;
};

}  // namespace vla::test
