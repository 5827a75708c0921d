// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/door/link.h"

#include <array>
#include <boost/asio/read.hpp>
#include <boost/asio/write.hpp>
#include <cstring>
#include <exception>

namespace vla::serve {
namespace {

namespace asio = boost::asio;
using asio::local::stream_protocol;
using boost::system::error_code;
using LinkKind = LinkMessage::Kind;

struct Head {
  std::uint32_t kind = 0, n_text = 0;
  std::uint64_t connection = 0, n_bytes = 0;
};

}  // namespace

/// Lives until its last callback has run.
class Link::Ends : public std::enable_shared_from_this<Link::Ends> {
 public:
  Ends(asio::io_context& context, int descriptor, std::size_t max_bytes)
      : socket_(context, stream_protocol(), descriptor), max_bytes_(max_bytes) {}

  void start(Handler& handler) {
    handler_ = &handler;
    read_head();
  }
  void send(LinkKind kind, std::uint64_t connection, const std::string& text, std::string_view bytes) {
    if (handler_ == nullptr && is_broken_) return;
    const Head head{static_cast<std::uint32_t>(kind), static_cast<std::uint32_t>(text.size()), connection,
                    bytes.size()};
    std::string out(sizeof head, '\0');
    std::memcpy(out.data(), &head, sizeof head);
    out.reserve(out.size() + text.size() + bytes.size());
    (out += text) += bytes;
    n_queued_ += out.size();
    out_.push_back(std::move(out));
    if (out_.size() == 1) write();
  }
  void close() {
    handler_ = nullptr;
    is_broken_ = true;
    error_code ignored;
    socket_.close(ignored);
  }
  int descriptor() { return socket_.native_handle(); }
  std::size_t n_queued() const { return n_queued_; }

 private:
  void read_head() {
    asio::async_read(socket_, asio::buffer(&head_, sizeof head_),
                     [self = shared_from_this()](error_code error, std::size_t) {
                       if (error) return self->fail(error.message());
                       self->read_rest();
                     });
  }
  void read_rest() {
    if (head_.kind > static_cast<std::uint32_t>(LinkKind::keep) || head_.n_text > kMaxText ||
        head_.n_bytes > max_bytes_)
      return fail("what came is no message");
    auto bytes = net::Bytes::make(head_.n_bytes);
    if (!bytes) return fail("no memory for a message");
    message_ = {static_cast<LinkKind>(head_.kind), head_.connection, std::string(head_.n_text, '\0'),
                std::move(*bytes)};
    const std::span<std::byte> span = message_.bytes.span();
    const std::array parts{asio::buffer(message_.text), asio::buffer(span.data(), span.size())};
    asio::async_read(socket_, parts, [self = shared_from_this()](error_code error, std::size_t) {
      if (error) return self->fail(error.message());
      try {
        if (self->handler_ != nullptr) self->handler_->came(std::move(self->message_));
        if (!self->is_broken_) self->read_head();
      } catch (const std::exception&) {
        self->fail("no memory for what came");
      }
    });
  }
  void write() {
    asio::async_write(socket_, asio::buffer(out_.front()), [self = shared_from_this()](error_code error, std::size_t) {
      if (error) return self->fail(error.message());
      self->n_queued_ -= self->out_.front().size();
      self->out_.pop_front();
      if (!self->out_.empty()) self->write();
    });
  }
  void fail(const std::string& why) {
    n_queued_ = 0;
    if (!std::exchange(is_broken_, true) && handler_ != nullptr) std::exchange(handler_, nullptr)->broke(why);
  }

  stream_protocol::socket socket_;
  const std::size_t max_bytes_;
  Handler* handler_ = nullptr;
  Head head_;
  LinkMessage message_;
  std::deque<std::string> out_;
  std::size_t n_queued_ = 0;
  bool is_broken_ = false;
};

Link::Link(asio::io_context& context, int descriptor, std::size_t max_bytes)
    : ends_(std::make_shared<Ends>(context, descriptor, max_bytes)) {}
Link::~Link() { ends_->close(); }
void Link::start(Handler& handler) { ends_->start(handler); }
void Link::send(LinkMessage::Kind kind, std::uint64_t connection, const std::string& text, std::string_view bytes) {
  ends_->send(kind, connection, text, bytes);
}
int Link::descriptor() const { return ends_->descriptor(); }
std::size_t Link::n_queued() const { return ends_->n_queued(); }

}  // namespace vla::serve
