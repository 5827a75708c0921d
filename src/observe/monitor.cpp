// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/monitor.h"

#include <fmt/format.h>

#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/beast/core/flat_buffer.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/http/empty_body.hpp>
#include <boost/beast/http/parser.hpp>
#include <boost/beast/http/read.hpp>
#include <boost/beast/http/string_body.hpp>
#include <boost/beast/http/write.hpp>
#include <exception>
#include <list>

#include "base/thread.h"
#include "net/listener.h"
#include "net/tcp.h"

namespace vla::serve {
namespace {

namespace beast = boost::beast;
namespace http = boost::beast::http;
using boost::asio::ip::tcp;
using boost::system::error_code;
using Request = http::request<http::empty_body>;
using Response = http::response<http::string_body>;

constexpr std::size_t kMaxConnections = 64;
constexpr std::size_t kMaxHeader = 4096;
constexpr auto kPatience = std::chrono::seconds(2);  // from the connection to the last byte of its answer

Response text(const Request& request, http::status status, std::string body) {
  Response response(status, request.version());
  response.set(http::field::content_type, "text/plain; charset=utf-8");
  response.body() = std::move(body);
  return response;
}

Response reply_to(const Monitor::Sources& sources, const Request& request) {
  if (request.method() != http::verb::get && request.method() != http::verb::head)
    return text(request, http::status::method_not_allowed, "GET only\n");
  const std::string path(request.target().substr(0, request.target().find('?')));
  if (path == "/healthz") return text(request, http::status::ok, "ok\n");
  if (path == "/metrics") {
    Response response = text(request, http::status::ok, sources.metrics());
    response.set(http::field::content_type, "text/plain; version=0.0.4; charset=utf-8");
    return response;
  }
  if (path != "/readyz") return text(request, http::status::not_found, "/metrics, /healthz and /readyz are here\n");
  const std::string obstacle = sources.obstacle();
  if (obstacle.empty()) return text(request, http::status::ok, "ready\n");
  return text(request, http::status::service_unavailable, obstacle + "\n");
}

/// One request and its answer. Whoever holds the shared pointer last, the pending operation as a rule, closes it.
class Connection : public std::enable_shared_from_this<Connection> {
 public:
  Connection(tcp::socket socket, const Monitor::Sources& sources) : stream_(std::move(socket)), sources_(sources) {
    parser_.header_limit(kMaxHeader);
  }

  void start() {
    stream_.expires_after(kPatience);
    http::async_read_header(stream_, buffer_, parser_, [self = shared_from_this()](error_code error, std::size_t) {
      if (!error) self->answer();
    });
  }
  void close() { stream_.close(); }

 private:
  void answer() {
    response_ = reply_to(sources_, parser_.get());
    response_.set(http::field::cache_control, "no-store");
    response_.keep_alive(false);
    response_.content_length(response_.body().size());
    if (parser_.get().method() == http::verb::head) response_.body().clear();
    http::async_write(stream_, response_, [self = shared_from_this()](error_code, std::size_t) {
      error_code ignored;
      self->stream_.socket().shutdown(tcp::socket::shutdown_send, ignored);
    });
  }

  beast::tcp_stream stream_;
  const Monitor::Sources& sources_;
  beast::flat_buffer buffer_{2 * kMaxHeader};
  http::request_parser<http::empty_body> parser_;
  Response response_;
};

}  // namespace

class Monitor::Http {
 public:
  explicit Http(Sources sources) : sources_(std::move(sources)) {}
  ~Http() {
    context_.stop();
    if (thread_.joinable()) thread_.join();
  }

  Status start(const std::string& address, bool insecure) {
    VLA_TRY(const tcp::endpoint endpoint, net::tcp_endpoint_of(address, "--metrics", insecure));
    try {
      listener_.emplace(context_, endpoint);
      address_ = fmt::format("{}:{}", address.substr(0, address.rfind(':')), listener_->endpoint().port());
    } catch (const boost::system::system_error& error) {
      return Error{Code::io, address, "a free address of this machine", error.code().message(),
                   "choose another with --metrics; port 0 takes a free one"};
    }
    VLA_TRY(thread_, start_thread("--metrics", [this] { run(); }));
    return {};
  }

  const std::string& address() const { return address_; }

 private:
  /// Whatever a library throws costs the connection that it happened to.
  void run() noexcept {
    while (!context_.stopped()) {
      try {
        listener_->listen([this](tcp::socket socket) { add(std::move(socket)); });
        context_.run();
      } catch (const std::exception&) {
        std::this_thread::sleep_for(std::chrono::milliseconds(100));
      }
    }
  }

  void add(tcp::socket socket) {
    open_.remove_if([](const std::weak_ptr<Connection>& connection) { return connection.expired(); });
    if (open_.size() >= kMaxConnections) {
      if (const auto oldest = open_.front().lock()) oldest->close();
      open_.pop_front();
    }
    const auto connection = std::make_shared<Connection>(std::move(socket), sources_);
    open_.push_back(connection);
    connection->start();
  }

  const Sources sources_;
  std::string address_;
  boost::asio::io_context context_{1};
  std::optional<net::Listener<tcp>> listener_;
  std::list<std::weak_ptr<Connection>> open_;  // oldest first
  std::thread thread_;
};

Monitor::Monitor(std::unique_ptr<Http> http) : http_(std::move(http)) {}
Monitor::~Monitor() = default;
const std::string& Monitor::address() const { return http_->address(); }

Result<std::unique_ptr<Monitor>> Monitor::open(const std::string& address, bool insecure, Sources sources) {
  std::unique_ptr<Http> http;
  try {
    http = std::make_unique<Http>(std::move(sources));
  } catch (const boost::system::system_error& error) {
    return Error{Code::io, "--metrics", "what sockets need of the system", error.code().message()};
  }
  VLA_CHECK(http->start(address, insecure));
  return std::unique_ptr<Monitor>(new Monitor(std::move(http)));
}

}  // namespace vla::serve
