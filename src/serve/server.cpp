// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/server.h"

#include <fmt/format.h>
#include <pthread.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <exception>
#include <new>
#include <thread>

#include "serve/codec.h"
#include "serve/endpoint.h"

namespace vla::serve {
namespace {

constexpr int kReceiveMark = 8;  // requests of one connection that may wait unread, each of up to the largest size
constexpr int kSendMark = 64;    // answers that one connection may leave unread before it loses further ones
constexpr int kLingerMs = 2000;  // for the last answers on the way out
constexpr int kHandshakeMs = 10'000;
constexpr int kHeartbeatMs = 5000, kHeartbeatTimeoutMs = 15'000;
constexpr std::size_t kQueueMessages = 8;  // acts that wait may hold so many times the largest message

v1::Limits limits_of(const ServerOptions& options, const Engine& engine) {
  v1::Limits limits;
  limits.set_max_message_bytes(options.max_message);
  limits.set_max_pixels(static_cast<std::uint64_t>(options.max_pixels));
  limits.set_max_text_bytes(static_cast<std::uint32_t>(options.max_text));
  limits.set_max_views(static_cast<std::uint32_t>(engine.processor().views().names().size()));
  limits.set_max_queue(static_cast<std::uint32_t>(options.max_queue));
  return limits;
}

Error cannot_bind(const std::string& endpoint, const zmq::error_t& error) {
  switch (error.num()) {
    case EADDRINUSE:
      return {Code::io, endpoint, "a free address", "one that another program uses", "choose another with --bind"};
    case EADDRNOTAVAIL:
    case ENODEV:
      return {Code::io, endpoint, "an address of this machine", error.what(), "tcp://127.0.0.1:5555 is one"};
    default:
      return {Code::io, endpoint, "an address that can be bound", error.what()};
  }
}

}  // namespace

Result<double> warm_up(Engine& engine) {
  const Recipe& recipe = engine.processor().recipe();
  const int width = recipe.width, height = recipe.height;
  const std::vector<std::uint8_t> grey(static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * 3, 128);
  Observation observation;
  for (const std::string& view : engine.processor().views().names())
    observation.views.emplace(view, Frame{width, height, grey});
  for (std::size_t i = 0; i < engine.processor().states().names().size(); ++i)
    observation.states.emplace(engine.processor().states().names()[i],
                               std::vector<float>(static_cast<std::size_t>(engine.processor().state_dims()[i])));
  for (int i = 0; i < recipe.max_tokens; ++i) observation.text += "go ";
  const auto start = Clock::now();
  const auto chunk = engine.act(observation, Noise(std::uint64_t{0}));
  if (!chunk && chunk.error().code != Code::bad_observation && chunk.error().code != Code::bad_action)
    return chunk.error();
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

Server::Server(const ServerOptions& options)
    : options_(options),
      exchange_({options.max_queue, kQueueMessages * options.max_message}),
      router_(context_, zmq::socket_type::router) {
  router_.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(options.max_message));
  router_.set(zmq::sockopt::rcvhwm, kReceiveMark);
  router_.set(zmq::sockopt::sndhwm, kSendMark);
  router_.set(zmq::sockopt::linger, kLingerMs);
  router_.set(zmq::sockopt::handshake_ivl, kHandshakeMs);
  router_.set(zmq::sockopt::heartbeat_ivl, kHeartbeatMs);
  router_.set(zmq::sockopt::heartbeat_timeout, kHeartbeatTimeoutMs);
  const auto has_bracket = [](const std::string& endpoint) { return endpoint.find('[') != std::string::npos; };
  router_.set(zmq::sockopt::ipv6, std::any_of(options.bind.begin(), options.bind.end(), has_bracket));
}

Result<std::unique_ptr<Server>> Server::open(const ServerOptions& options) {
  try {
    std::unique_ptr<Server> server(new Server(options));
    if (server->exchange_.fd() < 0) return Error{Code::io, "eventfd", "a free file descriptor", "none"};
    VLA_CHECK(server->guard());
    VLA_CHECK(server->bind());
    return server;
  } catch (const zmq::error_t& error) {
    return Error{Code::io, "ZeroMQ", "a socket", error.what()};
  }
}

/// Whoever can reach the server can move the robot: others than this machine's own programs need a key, or the user's
/// word.
Status Server::guard() {
  const bool has_keys = !options_.curve_secret.empty();
  if (has_keys != !options_.curve_clients.empty())
    return Error{Code::usage, "--curve-secret", "--curve-secret and --curve-clients together", "one of them"};
  for (const std::string& endpoint : options_.bind) {
    VLA_TRY(const Reach reach, reach_of(endpoint));
    if (reach == Reach::remote && !has_keys && !options_.insecure)
      return Error{Code::usage, "--bind", "keys for an address that other machines can reach", endpoint + " without",
                   "vla keygen makes keys for --curve-secret and --curve-clients; --insecure lets everybody in"};
  }
  if (!has_keys) return {};
  VLA_TRY(const std::string secret, read_secret_key(options_.curve_secret));
  VLA_TRY(std::set<std::string> clients, read_public_keys(options_.curve_clients));
  if (zmq_has("curve") == 0)
    return Error{Code::unsupported, "--curve-secret", "a ZeroMQ library with CURVE", "one without"};
  gate_ = std::make_unique<Gate>(context_, std::move(clients));
  router_.set(zmq::sockopt::curve_server, true);
  router_.set(zmq::sockopt::curve_secretkey, secret);
  router_.set(zmq::sockopt::zap_domain, "vla");
  return {};
}

Status Server::bind() {
  for (const std::string& endpoint : options_.bind) {
    VLA_CHECK(check_free(endpoint));
    try {
      router_.bind(endpoint);
    } catch (const zmq::error_t& error) {
      return cannot_bind(endpoint, error);
    }
    addresses_.push_back(router_.get(zmq::sockopt::last_endpoint));
  }
  return {};
}

void Server::stop() noexcept {
  vitals_.stopping = true;
  exchange_.wake();
}

v1::Description Server::describe(const Engine& engine) const {
  return serve::describe(engine, limits_of(options_, engine));
}

/// Graphs run on the thread that calls this, since it has loaded the engine: OpenMP keeps a team of threads for each
/// thread that computes.
Status Server::run(Engine& engine, std::span<Observer* const> observers) {
  description_ = describe(engine);
  vitals_.ready_since = Clock::now().time_since_epoch().count();
  vitals_.ready = true;
  sigset_t all, before;  // signals belong to the caller's threads
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before);
  Status talked;
  std::thread io([&] { talked = talk(observers); });
  pthread_sigmask(SIG_SETMASK, &before, nullptr);
  while (std::optional<Job> job = exchange_.next()) {
    for (Observer* observer : observers) observer->started(*job);
    exchange_.put(compute(engine, std::move(*job)));
  }
  io.join();
  gate_.reset();
  router_.close();
  context_.close();  // waits for the last answers to leave, for as long as the socket lingers
  return talked;
}

Status Server::talk(std::span<Observer* const> observers) noexcept {
  Status status;
  try {
    Io(router_, gate_.get(), exchange_, vitals_, description_, observers).run();
  } catch (const std::exception& exception) {
    status = Error{Code::internal, "I/O thread", "", exception.what()};
  }
  vitals_.ready = false;
  exchange_.close();
  return status;
}

Answer Server::compute(Engine& engine, Job job) const {
  Answer answer;
  answer.started = Clock::now();
  v1::Response response = response_to(job.request_id);
  try {  // what a library throws is this request's misfortune, not the server's
    auto chunk = act(engine, job, answer.stages);
    if (chunk) {
      chunk->set_queue_ms(std::chrono::duration<double, std::milli>(answer.started - job.at).count());
      *response.mutable_chunk() = std::move(*chunk);
    } else {
      answer.error = chunk.error();
    }
  } catch (const std::bad_alloc&) {
    answer.error = Error{Code::out_of_memory, "act", "", "the system has no memory left"};
  } catch (const std::exception& exception) {
    answer.error = Error{Code::internal, "act", "", exception.what(), "please report this"};
  }
  if (answer.error) *response.mutable_error() = encode_error(*answer.error);
  answer.response = to_message(response);
  answer.finished = Clock::now();
  answer.job = std::move(job);
  return answer;
}

Result<v1::ActionChunk> Server::act(Engine& engine, const Job& job, Timing& stages) const {
  const ActLimits limits{options_.max_pixels, options_.max_text, description_.limits().max_views(),
                         engine.solver_horizon(), engine.d_action_padded()};
  StageClock clock;
  VLA_TRY(const ActRequest request, decode_act(job.body(), limits));
  clock.lap(stages, "decode");
  VLA_TRY(ActionChunk chunk, engine.act(request.observation, request.noise));
  stages.insert(stages.end(), chunk.timing.begin(), chunk.timing.end());
  chunk.timing = stages;
  return encode_chunk(request, std::move(chunk), description_);
}

}  // namespace vla::serve
