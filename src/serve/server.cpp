// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/server.h"

#include <fmt/format.h>

#include <algorithm>
#include <boost/asio/io_context.hpp>
#include <boost/asio/post.hpp>
#include <exception>
#include <future>
#include <new>
#include <stdexcept>
#include <thread>

#include "base/out_of_memory.h"
#include "base/thread.h"
#include "net/descriptors.h"
#include "serve/double_buffer.h"
#include "serve/first_frames.h"
#include "serve/protocols.h"

namespace vla::serve {
namespace {

constexpr std::size_t kQueueMessages = 8;  // waiting acts may together hold this many times the largest message
/// File descriptors that connections leave free: for monitoring, the log, the recording and the listening sockets.
constexpr std::size_t kKeptDescriptors = 16;

/// Limits the connections to the available file descriptors, so that monitoring can reach a server whose connections
/// are all in use. Errors: io.
Result<ServerOptions> within_descriptors(ServerOptions options) {
  std::size_t n_each = 0;
  for (const Protocol& protocol : all_protocols()) n_each += protocol.is_wanted(options) ? protocol.n_descriptor : 0;
  const std::size_t spare = net::spare_descriptors();
  if (spare < kKeptDescriptors + n_each)
    return Error{Code::io, "ulimit -n",
                 fmt::format("{} file descriptors that can be opened", kKeptDescriptors + n_each),
                 std::to_string(spare), "raise the limit for this process"};
  options.max_connections = std::min(options.max_connections, (spare - kKeptDescriptors) / n_each);
  return options;
}

v1::Limits limits_told(const ServerOptions& options, const Engine& engine) {
  v1::Limits limits;
  limits.set_max_message_bytes(options.max_message);
  limits.set_max_pixels(static_cast<std::uint64_t>(options.max_pixels));
  limits.set_max_text_bytes(static_cast<std::uint32_t>(options.max_text));
  std::size_t most = 0;
  for (const Robot* robot : engine.robots()) most = std::max(most, robot->processor().views().names().size());
  limits.set_max_views(static_cast<std::uint32_t>(most));
  limits.set_max_queue(static_cast<std::uint32_t>(options.max_queue));
  return limits;
}

}  // namespace

Exchange::Jobs::Limits Server::limits_of(const ServerOptions& options) {
  return {options.max_queue, kQueueMessages * options.max_message};
}

Result<std::unique_ptr<Server>> Server::open(const ServerOptions& asked, Now now) try {
  VLA_TRY(const ServerOptions options, within_descriptors(asked));
  std::unique_ptr<Server> server(new Server(options, now));
  VLA_TRY(server->limits_, read_limits(options));
  if (server->exchange_.fd() < 0) return Error{Code::io, "eventfd", "a free file descriptor", "none"};
  for (const Protocol& protocol : all_protocols()) {
    if (!protocol.is_wanted(options)) continue;
    VLA_TRY(auto front, protocol.open(server->loop_, options));
    server->fronts_.push_back(std::move(front));
  }
  return server;
} catch (const std::runtime_error& no_descriptor) {  // thrown by Asio
  return Error{Code::io, "sockets", "what they need of the system", no_descriptor.what()};
}

std::vector<std::string> Server::addresses() const {
  std::vector<std::string> all;
  for (const auto& front : fronts_)
    for (std::string& address : front->addresses()) all.push_back(std::move(address));
  return all;
}

void Server::stop() noexcept {
  state_.stopping = true;
  exchange_.wake();
}

void Server::drain() noexcept {
  state_.draining = true;
  exchange_.wake();
}

v1::Description Server::describe(const std::string& name, const Engine& engine) const {
  v1::Description description = serve::describe(engine, limits_told(options_, engine));
  description.set_policy(name);
  return description;
}

Result<std::shared_ptr<ServedPolicy>> Server::served(const std::string& name, std::shared_ptr<Engine> engine) const {
  auto policy = std::make_shared<ServedPolicy>();
  policy->name = name;
  policy->description = describe(name, *engine);
  for (const Robot* robot : engine->robots()) {
    if (!limits_) break;
    const v1::Description& told = description_of(policy->description, robot->bundle().embodiment());
    VLA_TRY(ChunkLimits limits, ChunkLimits::of(*limits_, options_, told, policy->description.bundle().name()));
    policy->limits.emplace(robot, std::move(limits));
  }
  policy->engine = std::move(engine);
  return policy;
}

Status Server::add(const std::string& name, std::shared_ptr<Engine> engine) {
  VLA_TRY(auto policy, served(name, std::move(engine)));
  VLA_TRY([[maybe_unused]] const auto before, policies_.put(std::move(policy)));
  return {};
}

Status Server::begin() {
  const auto policy = policies_.find("");
  if (!policy && (fronts_.size() > 1 || !options_.default_policy.empty()))
    return Error{Code::usage, "--default-policy", policy.error().expected,
                 options_.default_policy.empty() ? "none" : options_.default_policy,
                 "clients of other protocols name no policy"};
  if (policy) {
    for (const auto& front : fronts_) VLA_CHECK(front->serve(**policy));
    policies_.keep_default((*policy)->name);
  }
  return {};
}

/// Posts the work to the I/O thread's loop. If that thread ends first, the work never runs.
template <class Work>
auto Server::on_io_thread(Work work) -> decltype(work()) {
  const auto task = std::make_shared<std::packaged_task<decltype(work())()>>(std::move(work));
  auto done = task->get_future();
  boost::asio::post(loop_.context(), [task] { (*task)(); });
  while (done.wait_for(std::chrono::milliseconds(20)) != std::future_status::ready)
    if (state_.ended && done.wait_for(std::chrono::seconds(0)) != std::future_status::ready)
      return Error{Code::shutting_down, "server", "", "it has stopped"};
  return done.get();
}

/// Waits until no act holds the policy, so that this thread frees its memory.
void Server::await_last_act(std::shared_ptr<ServedPolicy> policy) const {
  while (policy != nullptr && policy.use_count() > 1 && !state_.ended)
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
}

Status Server::load(const std::string& name, std::shared_ptr<Engine> engine) {
  using Replaced = Result<std::shared_ptr<ServedPolicy>>;
  VLA_TRY(auto next, served(name, std::move(engine)));
  VLA_TRY(auto before, on_io_thread([this, policy = std::move(next)]() -> Replaced {
            VLA_TRY(auto before, policies_.put(policy));
            const auto of_fronts = policies_.find("");
            if (of_fronts && *of_fronts == policy)
              for (const auto& front : fronts_) front->replaced(policy->description);
            return before;
          }));
  await_last_act(std::move(before));
  return {};
}

Status Server::unload(const std::string& name) {
  VLA_TRY(auto policy, on_io_thread([this, name] { return policies_.remove(name); }));
  await_last_act(std::move(policy));
  return {};
}

Result<std::vector<std::shared_ptr<ServedPolicy>>> Server::policies() {
  return on_io_thread([this]() -> Result<std::vector<std::shared_ptr<ServedPolicy>>> { return policies_.all(); });
}

std::vector<std::string> Server::told() const {
  std::vector<std::string> all;
  for (const auto& front : fronts_)
    if (std::string told = front->told(); !told.empty()) all.push_back(std::move(told));
  return all;
}

/// The calling thread runs the engine's computations.
Status Server::run(std::span<Observer* const> observers) {
  observers_ = observers;
  records_ = std::any_of(observers.begin(), observers.end(), [](const Observer* o) { return o->records(); });
  const bool is_host = policies_.all().front()->engine->device().is_host();
  state_.begin();
  Io io(loop_, fronts_, exchange_, policies_, state_, observers);
  DoubleBuffer<Act> acts({Act{.place = 0}, Act{.place = 1}});
  std::thread preparing;
  if (!is_host) {
    VLA_TRY(preparing, start_thread("preparing thread", [&] {
              while (prepare_next(acts.to_prepare())) acts.prepared();
              acts.close();
            }));
  }
  Result<std::thread> talking = start_thread("I/O thread", [&] { io.run(); });
  if (!talking) exchange_.close();
  if (preparing.joinable()) {
    while (Act* act = acts.to_compute()) compute(*act), acts.computed();
    preparing.join();
  } else {
    for (Act act; prepare_next(act);) compute(act);
  }
  if (!talking) return talking.error();
  talking->join();
  fronts_.clear();
  return lost_device_;
}

/// An exception from a library fails this request, not the server.
template <class Work>
void Server::attempt(Act& act, const Work& work) noexcept {
  try {
    if (Status done = work(); !done) act.answer.error = done.error();
  } catch (const std::bad_alloc&) {
    act.answer.error = out_of_memory("act");
  } catch (const std::exception&) {
    act.answer.error = Error{Code::internal, "act", "", "an exception", "report this"};
  }
}

bool Server::prepare_next(Act& act) {
  std::optional<Job> job = exchange_.next();
  if (!job) return false;
  for (Observer* observer : observers_) observer->started(*job);
  act.answer = {};
  act.answer.job = std::move(*job);
  act.answer.started = loop_.now();
  act.clock = {};
  attempt(act, [&] { return prepare(act); });
  return true;
}

void Server::compute(Act& act) {
  if (!act.answer.error) attempt(act, [&] { return respond(act); });
  act.answer.finished = loop_.now();
  act.request = {};
  const std::shared_ptr<ServedPolicy> policy = act.answer.job.policy;
  const Status device = policy->engine->device().failure();
  const bool is_answered = !act.answer.error;
  exchange_.put(std::move(act.answer));
  if (sizes_ != nullptr && is_answered) sizes_->add(*policy->engine);
  if (device) return;
  lost_device_ = device;
  state_.device_lost = true;  // no act after this one can succeed
  stop();
}

Status Server::prepare(Act& act) const {
  VLA_TRY(act.request, act.answer.job.call->decode(act.policy()));
  act.request.observation.reject_out_of_range = options_.strict_state;
  if (!options_.first_frames.empty() && !saved_frames_.exchange(true)) {
    VLA_TRY(const Robot* const robot, act.policy().engine->robot(act.request.observation.embodiment));
    VLA_TRY([[maybe_unused]] const auto files,
            save_first_frames(act.request.observation, *robot, options_.first_frames));
  }
  act.clock.lap(act.answer.stages, "decode");
  const Engine& engine = *act.policy().engine;
  VLA_CHECK(engine.encode(act.request.observation, act.request.noise, act.request.leftover, act.encoded()));
  if (const auto deadline = act.answer.job.deadline)
    act.encoded().is_late = [this, until = *deadline] { return loop_.now() >= until; };
  VLA_CHECK(engine.send_ahead(act.encoded()));
  act.clock = {};  // the wait for the device begins
  return {};
}

Status Server::respond(Act& act) const {
  Answer& answer = act.answer;
  ServedPolicy& policy = act.policy();
  if (!policy.engine->device().is_host()) act.clock.lap(act.encoded().timing, "wait");
  VLA_TRY(ActionChunk chunk, policy.engine->compute(act.encoded()));
  answer.stages.insert(answer.stages.end(), chunk.timing.begin(), chunk.timing.end());
  chunk.timing = answer.stages;
  if (const auto limits = policy.limits.find(act.encoded().robot); limits != policy.limits.end())
    VLA_CHECK(limits->second.check(chunk, answer.n_beyond));
  answer.out_of_range = chunk.out_of_range, answer.notes = chunk.notes;
  act.request.observation.embodiment = act.encoded().robot->bundle().embodiment();
  const double queue_ms = std::chrono::duration<double, std::milli>(answer.started - answer.job.at).count();
  Reply reply{act.request, std::move(chunk), queue_ms};
  if (records_ && answer.job.call->native() == nullptr)
    answer.record =
        record_of(answer.job.request_id, reply, description_of(policy.description, act.request.observation.embodiment));
  answer.response = answer.job.call->encode(std::move(reply), policy);
  return {};
}

}  // namespace vla::serve
