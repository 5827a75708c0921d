// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/control.h"

#include <fmt/format.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <list>
#include <nlohmann/json.hpp>
#include <utility>

#include "base/out_of_memory.h"
#include "base/thread.h"
#include "net/endpoint.h"
#include "wire/envelope.h"

namespace vla::serve {
namespace {

using nlohmann::ordered_json;

constexpr std::size_t kMaxLine = 64 << 10;
constexpr std::size_t kMaxClients = 16;                    // clients whose orders are incomplete
constexpr auto kPatience = std::chrono::seconds(5);        // from a connection to the end of its order
constexpr auto kMoment = std::chrono::milliseconds(50);    // minimum for a client's order, however many others connect
constexpr timeval kReading = {.tv_sec = 2, .tv_usec = 0};  // timeout for sending an answer
constexpr int kLoadNice = 10;                              // loading yields the CPU to acts in progress

Result<sockaddr_un> address_of(const std::string& path) {
  sockaddr_un address = {};
  address.sun_family = AF_UNIX;
  if (path.empty() || path.size() >= sizeof(address.sun_path))
    return Error{Code::usage, "--control", fmt::format("a path of 1 to {} bytes", sizeof(address.sun_path) - 1), path};
  std::copy(path.begin(), path.end(), address.sun_path);
  return address;
}

Error failed(const std::string& path, const char* what) { return {Code::io, path, what, std::strerror(errno)}; }

/// Appends the received part of a line. Returns whether to stop reading: the line is complete or too long, the peer has
/// closed, or an error occurred.
bool read_some(int socket, std::string& line, int flags) {
  char bytes[4096];
  const ssize_t n = ::recv(socket, bytes, sizeof(bytes), flags);
  if (n < 0) return errno != EAGAIN && errno != EINTR;
  line.append(bytes, static_cast<std::size_t>(n));
  return n == 0 || line.size() >= kMaxLine || line.find('\n') != std::string::npos;
}

bool write_line(int socket, std::string line) {
  line += '\n';
  for (std::size_t sent = 0; sent < line.size();) {
    const ssize_t n = ::send(socket, line.data() + sent, line.size() - sent, MSG_NOSIGNAL);
    if (n <= 0) return false;
    sent += static_cast<std::size_t>(n);
  }
  return true;
}

/// Only the user of this process and root may give orders.
bool may_order(int client) {
  ucred peer = {};
  socklen_t size = sizeof(peer);
  return ::getsockopt(client, SOL_SOCKET, SO_PEERCRED, &peer, &size) == 0 && (peer.uid == ::geteuid() || peer.uid == 0);
}

ordered_json told(const ServedPolicy& policy) {
  const v1::Bundle& bundle = policy.description.bundle();
  return {{"policy", policy.name},
          {"bundle", bundle.name()},
          {"arch", bundle.arch()},
          {"checksum", bundle.checksum()},
          {"memory_mb", static_cast<double>(policy.engine->memory().total()) / 1e6}};
}

bool write_json(int socket, const ordered_json& json) {
  return write_line(socket, json.dump(-1, ' ', false, ordered_json::error_handler_t::replace));
}

ordered_json refused(const Error& error) {
  return {{"error",
           {{"code", exit_code(error.code)},
            {"where", error.where},
            {"expected", error.expected},
            {"found", error.found},
            {"hint", error.hint}}}};
}

Error bad_order(const std::string& found) {
  return {Code::bad_request, "order", "list, load, unload or drain, as vla ctl sends them", found};
}

std::string text_of(const ordered_json& json, const char* key) {
  const auto found = json.find(key);
  return found != json.end() && found->is_string() ? found->get<std::string>() : std::string();
}

}  // namespace

Result<std::unique_ptr<Control>> Control::open(const std::string& path, Server& server, Program program) {
  std::unique_ptr<Control> control(new Control(path, server, std::move(program)));
  VLA_CHECK(control->bind());
  return control;
}

Status Control::bind() {
  VLA_TRY(const sockaddr_un address, address_of(path_));
  VLA_CHECK(net::check_free("ipc://" + path_, "--control"));
  ::unlink(path_.c_str());  // any socket at this path is stale: check_free found no server
  stopped_ = ::eventfd(0, EFD_CLOEXEC);
  listener_ = ::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (stopped_ < 0 || listener_ < 0) return failed(path_, "a file descriptor");
  // Restricts the mode before the socket has a name, so that no other user can open it in between.
  if (::fchmod(listener_, S_IRUSR | S_IWUSR) != 0 ||
      ::bind(listener_, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0)
    return failed(path_, "a path that can be bound");
  ::chmod(path_.c_str(), S_IRUSR | S_IWUSR);
  if (::listen(listener_, SOMAXCONN) != 0) return failed(path_, "a socket that listens");
  return {};
}

Status Control::start() {
  VLA_TRY(thread_, start_thread("control", [this] { run(); }));
  return {};
}

bool Control::stop(std::chrono::milliseconds patience) {
  const std::uint64_t one = 1;
  [[maybe_unused]] const auto written = ::write(stopped_, &one, sizeof(one));
  ::unlink(path_.c_str());
  return !thread_.joinable() || thread_ended_.wait_for(patience) == std::future_status::ready;
}

Control::~Control() {
  if (listener_ >= 0) stop(std::chrono::milliseconds(0));
  if (thread_.joinable()) thread_.join();
  for (const int descriptor : {listener_, stopped_})
    if (descriptor >= 0) ::close(descriptor);
}

void Control::run() {
  ::setpriority(PRIO_PROCESS, 0, ::getpriority(PRIO_PROCESS, 0) + kLoadNice);  // for this thread and those it starts
  std::list<Client> clients;
  for (;;) {
    const bool takes = has_room(clients);
    std::vector<pollfd> wait = {{stopped_, POLLIN, 0}, {listener_, static_cast<short>(takes ? POLLIN : 0), 0}};
    for (const Client& client : clients) wait.push_back({client.socket, POLLIN, 0});
    if (::poll(wait.data(), wait.size(), ms_left(clients, takes)) < 0 && errno != EINTR) break;
    if (wait[0].revents != 0) break;
    std::size_t i = 2;
    for (auto client = clients.begin(); client != clients.end(); ++i) {
      const bool is_whole = wait[i].revents != 0 && read_some(client->socket, client->line, MSG_DONTWAIT);
      if (is_whole || Clock::now() >= client->until) answer(*client);
      client = client->socket < 0 ? clients.erase(client) : std::next(client);
    }
    if (wait[1].revents != 0) accept(clients);
  }
  for (const Client& client : clients) ::close(client.socket);
  ended_.set_value();
}

/// Whether another client may be accepted: a place is free, or the oldest client, which would lose its place, has had
/// kMoment to send its order.
bool Control::has_room(const std::list<Client>& clients) {
  return clients.size() < kMaxClients || Clock::now() >= clients.front().until - kPatience + kMoment;
}

/// Milliseconds until the oldest client's kPatience ends, or its kMoment if others wait for a place; -1 without
/// clients.
int Control::ms_left(const std::list<Client>& clients, bool takes) {
  if (clients.empty()) return -1;
  const auto until = clients.front().until - (takes ? Clock::duration(0) : kPatience - kMoment);
  const auto left = std::chrono::ceil<std::chrono::milliseconds>(until - Clock::now());
  return static_cast<int>(std::max<std::int64_t>(left.count(), 0));
}

void Control::accept(std::list<Client>& clients) {
  const int socket = ::accept4(listener_, nullptr, nullptr, SOCK_CLOEXEC);
  if (socket < 0) {
    std::this_thread::sleep_for(std::chrono::milliseconds(100));  // without descriptors, poll would return at once
    return;
  }
  ::setsockopt(socket, SOL_SOCKET, SO_SNDTIMEO, &kReading, sizeof(kReading));
  clients.push_back({socket, Clock::now() + kPatience});
  if (!may_order(socket))
    ::close(socket), clients.pop_back();
  else if (clients.size() > kMaxClients)
    answer(clients.front()), clients.pop_front();
}

/// Answers a client by the part of its order that has arrived. An exception from a library fails this order, not the
/// server.
void Control::answer(Client& client) try {
  const std::unique_ptr<int, void (*)(int*)> closed(&client.socket,
                                                    [](int* open) { ::close(std::exchange(*open, -1)); });
  const std::string line = client.line.substr(0, client.line.find('\n'));
  // Orders are flat. Deeper values are dropped: once parsed, they would take a hundred times their bytes.
  const auto is_kept = [](int depth, ordered_json::parse_event_t, const ordered_json&) { return depth < 2; };
  const ordered_json given = ordered_json::parse(line, is_kept, false);
  try {
    const Result<ordered_json> reply = obey(given);
    write_json(client.socket, reply ? *reply : refused(reply.error()));
  } catch (const std::bad_alloc&) {
    write_json(client.socket, refused(out_of_memory("order")));
  }
} catch (const std::exception&) {  // no memory even for the refusal
}

Result<ordered_json> Control::obey(const ordered_json& given) {
  if (!given.is_object()) return bad_order("another line");
  const std::string what = text_of(given, "do"), name = text_of(given, "policy");
  if (what == "load") return load(name, text_of(given, "bundle"));
  ordered_json done = ordered_json::object();
  if (what == "drain") {
    server_.drain();
  } else if (what == "unload") {
    VLA_CHECK(server_.unload(name));
    program_.unloaded(name);
  } else if (what == "list") {
    VLA_TRY(const auto policies, server_.policies());
    done["policies"] = ordered_json::array();
    for (const auto& policy : policies) done["policies"].push_back(told(*policy));
  } else {
    return bad_order(what);
  }
  return done;
}

Result<ordered_json> Control::load(const std::string& policy, const std::string& bundle) {
  VLA_CHECK(check_policy_name(policy));
  VLA_TRY(const LoadedPolicy loaded, program_.load(bundle));
  VLA_CHECK(server_.load(policy, loaded.engine));
  program_.loaded(policy, *loaded.engine);
  return ordered_json{{"policy", policy},
                      {"load_ms", loaded.load_ms},
                      {"warm_up_ms", loaded.warm_up_ms},
                      {"memory_mb", static_cast<double>(loaded.engine->memory().total()) / 1e6}};
}

Result<ordered_json> order(const std::string& path, const ordered_json& given) {
  VLA_TRY(const sockaddr_un address, address_of(path));
  const int socket = ::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (socket < 0) return failed(path, "a file descriptor");
  const std::unique_ptr<const int, void (*)(const int*)> closed(&socket, [](const int* open) { ::close(*open); });
  if (::connect(socket, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0)
    return failed(path, "the --control of a vla serve that runs");
  if (!write_json(socket, given)) return failed(path, "an order that is taken");
  std::string reply;
  while (!read_some(socket, reply, 0)) continue;
  ordered_json json = ordered_json::parse(reply, nullptr, false);
  if (!json.is_object())
    return Error{Code::io, path, "an answer", reply.empty() ? "none: another user's server, or it ended" : reply};
  const auto error = json.find("error");
  if (error == json.end()) return json;
  return Error{wire::code_of(error->value("code", 0)), text_of(*error, "where"), text_of(*error, "expected"),
               text_of(*error, "found"), text_of(*error, "hint")};
}

}  // namespace vla::serve
