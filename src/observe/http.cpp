// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/http.h"

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

namespace vla::observe {
namespace {

namespace beast = boost::beast;
namespace http = boost::beast::http;
using boost::asio::ip::tcp;
using boost::system::error_code;
using Response = http::response<http::string_body>;

constexpr std::size_t kMaxConnections = 64;
constexpr std::size_t kMaxHeader = 4096;
constexpr const char* kPolicy =
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; img-src blob:; "
    "frame-ancestors 'none'";
constexpr auto kRequestPatience =
    std::chrono::seconds(2);  // from accepting the connection to the last byte of the answer

struct Handlers {
  HttpHandler get, post;
};

/// One request and its answer. The last owner of the shared pointer, usually the pending operation, closes it.
class Connection : public std::enable_shared_from_this<Connection> {
 public:
  Connection(tcp::socket socket, const Handlers& handlers) : stream_(std::move(socket)), handlers_(handlers) {
    parser_.header_limit(kMaxHeader);
  }

  void start() {
    stream_.expires_after(kRequestPatience);
    http::async_read_header(stream_, buffer_, parser_, [self = shared_from_this()](error_code error, std::size_t) {
      if (!error) self->answer();
    });
  }
  void close() { stream_.close(); }

 private:
  void answer() {
    const auto& request = parser_.get();
    HttpReply reply = {405, "text/plain; charset=utf-8", handlers_.post ? "GET and POST only\n" : "GET only\n"};
    if (const HttpHandler* handler = handler_of(request.method()); handler != nullptr && *handler) {
      const std::string target(request.target());
      const std::size_t end = std::min(target.find('?'), target.size());
      reply = (*handler)(target.substr(0, end), target.substr(std::min(end + 1, target.size())));
    }
    response_.version(request.version());
    response_.result(static_cast<unsigned>(reply.status));
    response_.set(http::field::content_type, reply.type);
    response_.set(http::field::cache_control, "no-store");
    response_.set("X-Content-Type-Options", "nosniff");
    response_.set("Referrer-Policy", "no-referrer");  // does not log a token in the address
    response_.set("Content-Security-Policy", kPolicy);
    response_.keep_alive(false);
    response_.body() = std::move(reply.body);
    response_.content_length(response_.body().size());
    if (request.method() == http::verb::head) response_.body().clear();
    http::async_write(stream_, response_, [self = shared_from_this()](error_code, std::size_t) {
      error_code ignored;
      self->stream_.socket().shutdown(tcp::socket::shutdown_send, ignored);
    });
  }

  const HttpHandler* handler_of(http::verb method) const {
    if (method == http::verb::get || method == http::verb::head) return &handlers_.get;
    return method == http::verb::post ? &handlers_.post : nullptr;
  }

  beast::tcp_stream stream_;
  const Handlers& handlers_;
  beast::flat_buffer buffer_{2 * kMaxHeader};
  http::request_parser<http::empty_body> parser_;
  Response response_;
};

}  // namespace

class Http::Server {
 public:
  explicit Server(Handlers handlers) : handlers_(std::move(handlers)) {}
  ~Server() {
    context_.stop();
    if (thread_.joinable()) thread_.join();
  }

  Status start(const std::string& address, const char* option, bool insecure) {
    VLA_TRY(address_, net::bind_tcp(listener_, context_, address, option, insecure));
    VLA_TRY(thread_, start_thread(option, [this] { run(); }));
    return {};
  }

  const std::string& address() const { return address_; }

 private:
  /// An exception of a library ends only the connection in which it occurred.
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
    const auto connection = std::make_shared<Connection>(std::move(socket), handlers_);
    open_.push_back(connection);
    connection->start();
  }

  const Handlers handlers_;
  std::string address_;
  boost::asio::io_context context_{1};
  std::optional<net::Listener<tcp>> listener_;
  std::list<std::weak_ptr<Connection>> open_;  // oldest first
  std::thread thread_;
};

Http::Http(std::unique_ptr<Server> server) : server_(std::move(server)) {}
Http::~Http() = default;
const std::string& Http::address() const { return server_->address(); }

Result<std::unique_ptr<Http>> Http::open(const std::string& address, const char* option, bool insecure, HttpHandler get,
                                         HttpHandler post) {
  std::unique_ptr<Server> server;
  try {
    server = std::make_unique<Server>(Handlers{std::move(get), std::move(post)});
  } catch (const boost::system::system_error& error) {
    return Error{Code::io, option, "what sockets need of the system", error.code().message()};
  }
  VLA_CHECK(server->start(address, option, insecure));
  return std::unique_ptr<Http>(new Http(std::move(server)));
}

}  // namespace vla::observe
