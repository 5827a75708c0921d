// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Many clients against a running server, every answer checked against its request:
//   load_tool ADDRESS CLIENTS REQUESTS [SIDE] [PID]
// Each client keeps one act of raw frames of SIDE x SIDE (256) in flight and numbers it; seeds differ, and what a seed
// gives is asked for alone first. Printed: lost and crossed answers, host overhead (round trip minus queue and engine
// time), acts per client, and with PID the resident memory of the server after the first tenth and at the end.
#include <fmt/format.h>

#include <algorithm>
#include <fstream>
#include <map>
#include <zmq.hpp>

#include "serve/observer.h"
#include "serve/vla.pb.h"

using namespace vla;
using serve::Clock;

namespace {

constexpr std::uint64_t kSeeds = 8;

double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

double resident_mb(const std::string& pid) {
  std::ifstream status("/proc/" + pid + "/status");
  for (std::string line; std::getline(status, line);)
    if (line.starts_with("VmRSS:")) return std::stod(line.substr(6)) / 1024;
  return 0;
}

double quantile(std::vector<double> values, double q) {
  if (values.empty()) return 0;
  std::sort(values.begin(), values.end());
  return values[static_cast<std::size_t>(q * static_cast<double>(values.size() - 1))];
}

struct Client {
  zmq::socket_t socket;
  std::uint64_t request_id = 0, seed = 0;
  Clock::time_point sent;
  int n_answered = 0;

  Client(zmq::context_t& context, const std::string& address) : socket(context, zmq::socket_type::dealer) {
    socket.set(zmq::sockopt::linger, 0);
    socket.connect(address);
  }
  void send(v1::Request& request, std::uint64_t id) {
    request_id = id;
    seed = id % kSeeds;
    request.set_request_id(id);
    request.mutable_act()->set_seed(seed);
    const std::string bytes = request.SerializeAsString();
    sent = Clock::now();
    socket.send(zmq::buffer(bytes));
  }
  v1::Response receive() {
    zmq::message_t message;
    v1::Response response;
    if (!socket.recv(message) || !response.ParseFromArray(message.data(), static_cast<int>(message.size())))
      fmt::print("an answer that does not parse\n");
    return response;
  }
};

/// An act that the policy takes, whatever it is.
v1::Request act_for(const v1::Description& description, std::uint32_t side) {
  v1::Request request;
  request.set_protocol_version(1);
  for (const v1::ViewSpec& spec : description.views()) {
    v1::View& view = *request.mutable_act()->add_views();
    view.set_name(spec.name());
    view.mutable_rgb()->set_width(side);
    view.mutable_rgb()->set_height(side);
    view.mutable_rgb()->set_rows(std::string(std::size_t{3} * side * side, '\x60'));
  }
  for (const v1::StateSpec& spec : description.states()) {
    v1::State& state = *request.mutable_act()->add_states();
    state.set_name(spec.name());
    for (int i = 0; i < spec.dimensions_size(); ++i) state.add_values(0.1f);
  }
  request.mutable_act()->set_text("open the drawer");
  return request;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 4) return fmt::print("load_tool ADDRESS CLIENTS REQUESTS [SIDE] [PID]\n"), 2;
  const std::string address = argv[1], pid = argc > 5 ? argv[5] : "";
  const int n_client = std::stoi(argv[2]), n_request = std::stoi(argv[3]);
  zmq::context_t context;
  Client first(context, address);
  v1::Request request;
  request.set_protocol_version(1);
  request.mutable_describe();
  first.socket.send(zmq::buffer(request.SerializeAsString()));
  request = act_for(first.receive().description(), static_cast<std::uint32_t>(argc > 4 ? std::stoi(argv[4]) : 256));
  std::map<std::uint64_t, std::string> expected;  // seed -> actions
  const auto actions = [](const v1::ActionChunk& chunk) {
    return std::string(reinterpret_cast<const char*>(chunk.actions().data()),
                       sizeof(float) * static_cast<std::size_t>(chunk.actions_size()));
  };
  for (std::uint64_t seed = 0; seed < kSeeds; ++seed) {
    first.send(request, seed);
    expected[seed] = actions(first.receive().chunk());
  }

  std::vector<Client> clients;
  std::vector<zmq::pollitem_t> items;
  std::uint64_t id = 1000;
  for (int i = 0; i < n_client; ++i) clients.emplace_back(context, address);
  for (Client& client : clients) items.push_back({client.socket.handle(), 0, ZMQ_POLLIN, 0});
  const auto start = Clock::now();
  for (Client& client : clients) client.send(request, ++id);
  int n_answered = 0, n_crossed = 0, n_error = 0;
  double resident = 0;
  std::vector<double> overhead;
  while (n_answered < n_request && zmq::poll(items, std::chrono::seconds(60)) > 0) {
    for (std::size_t i = 0; i < clients.size(); ++i) {
      if ((items[i].revents & ZMQ_POLLIN) == 0) continue;
      Client& client = clients[i];
      const v1::Response response = client.receive();
      const double round_trip = ms_since(client.sent);
      const v1::ActionChunk& chunk = response.chunk();
      if (response.request_id() != client.request_id || chunk.seed() != client.seed ||
          (response.has_chunk() && actions(chunk) != expected[client.seed]))
        ++n_crossed;
      if (!response.has_chunk()) ++n_error;
      overhead.push_back(round_trip - chunk.queue_ms() - chunk.engine_ms());
      ++client.n_answered;
      if (++n_answered == n_request / 10) resident = resident_mb(pid);
      client.send(request, ++id);
    }
  }
  const auto [least, most] = std::minmax_element(
      clients.begin(), clients.end(), [](const Client& a, const Client& b) { return a.n_answered < b.n_answered; });
  fmt::print("answers {} of {}, crossed {}, errors {}, {:.1f} per second\n", n_answered, n_request, n_crossed, n_error,
             1e3 * n_answered / ms_since(start));
  fmt::print("overhead ms: p50 {:.3f}, p99 {:.3f}\n", quantile(overhead, 0.5), quantile(overhead, 0.99));
  fmt::print("acts per client: {} to {}\n", least->n_answered, most->n_answered);
  if (!pid.empty()) fmt::print("resident MB: {:.1f} after a tenth, {:.1f} at the end\n", resident, resident_mb(pid));
  return n_answered == n_request && n_crossed == 0 && n_error == 0 ? 0 : 1;
}
