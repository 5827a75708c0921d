// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Many clients against a running server, every answer checked against its request. scripts/serve_load.py runs it and
// says what the numbers mean.
//
// Each client keeps one act in flight. The acts are kActs different ones, by pixels, state and seed; what each gives is
// asked for alone first, so that an answer that belongs to another request is known by its bytes as well as by its
// number. One line of JSON comes out, and the exit code is 0 where every request got its own answer.
#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <fstream>
#include <nlohmann/json.hpp>
#include <set>
#include <zmq.hpp>

#include <jpeglib.h>

#include "observe/observer.h"
#include "wire/vla.pb.h"

using namespace vla;

namespace {

constexpr std::size_t kActs = 16;
constexpr auto kPatience = std::chrono::seconds(60);

struct Options {
  std::string address, pid;
  std::size_t n_client = 1, n_request = 1000;
  std::uint32_t side = 256;
  std::vector<std::string> jpeg;
};

double ms_since(Clock::time_point start) {
  return std::chrono::duration<double, std::milli>(Clock::now() - start).count();
}

double resident_mb(const std::string& pid) {
  std::ifstream status("/proc/" + pid + "/status");
  for (std::string line; std::getline(status, line);)
    if (line.starts_with("VmRSS:")) return std::stod(line.substr(6)) / 1024;
  return 0;
}

nlohmann::json quantiles(std::vector<double> values) {
  if (values.empty()) return nullptr;
  std::sort(values.begin(), values.end());
  const auto at = [&](double q) {
    return values[static_cast<std::size_t>(q * static_cast<double>(values.size() - 1))];
  };
  return {{"p50", at(0.5)}, {"p99", at(0.99)}, {"max", values.back()}};
}

/// Milliseconds that libjpeg itself takes for a file: what the decoder of the server is measured against.
double plain_jpeg_ms(const std::string& file, std::vector<unsigned char>& pixels) {
  const auto start = Clock::now();
  jpeg_decompress_struct jpeg{};
  jpeg_error_mgr errors{};
  jpeg.err = jpeg_std_error(&errors);
  jpeg_create_decompress(&jpeg);
  jpeg_mem_src(&jpeg, reinterpret_cast<const unsigned char*>(file.data()), file.size());
  jpeg_read_header(&jpeg, TRUE);
  jpeg.out_color_space = JCS_RGB;
  jpeg_start_decompress(&jpeg);
  const std::size_t row_size = std::size_t{3} * jpeg.output_width;
  pixels.resize(row_size * jpeg.output_height);
  while (jpeg.output_scanline < jpeg.output_height) {
    JSAMPROW row = pixels.data() + row_size * jpeg.output_scanline;
    jpeg_read_scanlines(&jpeg, &row, 1);
  }
  jpeg_finish_decompress(&jpeg);
  jpeg_destroy_decompress(&jpeg);
  return ms_since(start);
}

/// The n-th act that the policy takes, whatever the policy is.
v1::Request make_act(const v1::Description& description, const Options& options, std::size_t n) {
  v1::Request request;
  request.set_protocol_version(1);
  v1::Act& act = *request.mutable_act();
  for (const v1::ViewSpec& spec : description.views()) {
    v1::View& view = *act.add_views();
    view.set_name(spec.name());
    if (!options.jpeg.empty()) {
      view.set_jpeg(options.jpeg[(n + static_cast<std::size_t>(act.views_size())) % options.jpeg.size()]);
      continue;
    }
    std::string rows(std::size_t{3} * options.side * options.side, '\0');
    for (std::size_t i = 0; i < rows.size(); ++i) rows[i] = static_cast<char>((i * (n + 1)) >> 6);
    view.mutable_rgb()->set_width(options.side);
    view.mutable_rgb()->set_height(options.side);
    view.mutable_rgb()->set_rows(std::move(rows));
  }
  for (const v1::StateSpec& spec : description.states()) {
    v1::State& state = *act.add_states();
    state.set_name(spec.name());
    for (int i = 0; i < spec.dimensions_size(); ++i)
      state.add_values(0.01f * static_cast<float>(n) + 0.1f * static_cast<float>(i));
  }
  act.set_text("open the drawer");
  act.set_seed(n);
  return request;
}

struct Client {
  zmq::socket_t socket;
  std::string bytes;  // of the request under way
  std::uint64_t request_id = 0;
  std::size_t act = 0, n_answered = 0;
  bool waits = false;
  Clock::time_point sent;

  Client(zmq::context_t& context, const std::string& address) : socket(context, zmq::socket_type::dealer) {
    socket.set(zmq::sockopt::linger, 0);
    socket.set(zmq::sockopt::rcvtimeo, static_cast<int>(std::chrono::milliseconds(kPatience).count()));
    socket.connect(address);
  }
  void send(v1::Request& request, std::uint64_t id) {
    sent = Clock::now();  // what serializing and parsing take belongs to the round trip
    request_id = id;
    waits = true;
    request.set_request_id(id);
    request.SerializeToString(&bytes);
    zmq::message_t message(bytes.data(), bytes.size(), nullptr);  // not copied: they stay until the answer has come
    socket.send(message, zmq::send_flags::none);
  }
  v1::Response receive() {
    zmq::message_t message;
    v1::Response response;
    if (!socket.recv(message) || !response.ParseFromArray(message.data(), static_cast<int>(message.size())))
      fmt::print(stderr, "an answer that does not come or does not parse\n");
    return response;
  }
};

std::string actions_of(const v1::ActionChunk& chunk) {
  return {reinterpret_cast<const char*>(chunk.actions().data()),
          sizeof(float) * static_cast<std::size_t>(chunk.actions_size())};
}

class Load {
 public:
  explicit Load(const Options& options) : options_(options) {
    Client first(context_, options.address);
    v1::Request describe;
    describe.set_protocol_version(1);
    describe.mutable_describe();
    first.send(describe, 1);
    const v1::Description description = first.receive().description();
    for (std::size_t n = 0; n < kActs; ++n) {
      acts_.push_back(make_act(description, options, n));
      first.send(acts_[n], n);
      expected_.push_back(actions_of(first.receive().chunk()));
    }
    for (std::size_t i = 0; i < options.n_client; ++i) clients_.emplace_back(context_, options.address);
  }

  /// Whether every answer can be told from every other by its bytes.
  bool acts_differ() const {
    return std::set<std::string>(expected_.begin(), expected_.end()).size() == kActs && !expected_[0].empty();
  }

  void run() {
    std::vector<zmq::pollitem_t> items;
    for (Client& client : clients_) items.push_back({client.socket.handle(), 0, ZMQ_POLLIN, 0});
    start_ = Clock::now();
    for (Client& client : clients_) send(client);
    while (n_answered_ < options_.n_request && zmq::poll(items, kPatience) > 0)
      for (std::size_t i = 0; i < items.size(); ++i)
        if ((items[i].revents & ZMQ_POLLIN) != 0) take(clients_[i]);
    seconds_ = ms_since(start_) / 1e3;
    n_unasked_ = std::max(0, zmq::poll(items, std::chrono::milliseconds(200)));
  }

  bool flawless() const {
    return n_answered_ == options_.n_request && n_crossed_ == 0 && n_error_ == 0 && n_unasked_ == 0;
  }

  nlohmann::json report() const {
    const auto [least, most] = std::minmax_element(
        clients_.begin(), clients_.end(), [](const Client& a, const Client& b) { return a.n_answered < b.n_answered; });
    return {{"clients", options_.n_client},
            {"requests", options_.n_request},
            {"answers", n_answered_},
            {"crossed", n_crossed_},
            {"errors", n_error_},
            {"unasked", n_unasked_},
            {"per_second", static_cast<double>(n_answered_) / seconds_},
            {"served", {{"least", least->n_answered}, {"most", most->n_answered}}},
            {"round_trip_ms", quantiles(round_trip_)},
            {"overhead_ms", quantiles(overhead_)},
            {"queue_ms", quantiles(queue_)},
            {"decode_ms", quantiles(decode_)},
            {"plain_jpeg_ms", quantiles(plain_jpeg_)},
            {"resident_mb", resident_mb_}};
  }

 private:
  void send(Client& client) {
    if (n_sent_ == options_.n_request) return;
    client.act = n_sent_ % kActs;
    client.send(acts_[client.act], kActs + n_sent_++);
  }

  void take(Client& client) {
    const v1::Response response = client.receive();
    const double round_trip = ms_since(client.sent);
    const v1::ActionChunk& chunk = response.chunk();
    if (!response.has_chunk()) {
      ++n_error_;
    } else if (!client.waits || response.request_id() != client.request_id || chunk.seed() != client.act ||
               actions_of(chunk) != expected_[client.act]) {
      ++n_crossed_;
    }
    client.waits = false;
    ++client.n_answered;
    note(chunk, round_trip);
    send(client);
  }

  void note(const v1::ActionChunk& chunk, double round_trip) {
    round_trip_.push_back(round_trip);
    overhead_.push_back(round_trip - chunk.engine_ms());
    queue_.push_back(chunk.queue_ms());
    if (chunk.stages_size() > 0) decode_.push_back(chunk.stages(0).ms());
    if (!options_.jpeg.empty()) time_plain_jpeg();
    ++n_answered_;
    if (n_answered_ * 10 / options_.n_request > resident_mb_.size()) resident_mb_.push_back(resident_mb(options_.pid));
  }

  /// The same files, at the same moment of a busy machine.
  void time_plain_jpeg() {
    double ms = 0;
    for (const v1::View& view : acts_[(n_answered_) % kActs].act().views()) ms += plain_jpeg_ms(view.jpeg(), pixels_);
    plain_jpeg_.push_back(ms);
  }

  Options options_;
  zmq::context_t context_;
  std::vector<v1::Request> acts_;
  std::vector<std::string> expected_;  // bytes of the actions of each act
  std::vector<Client> clients_;
  Clock::time_point start_;
  double seconds_ = 0;
  std::vector<double> resident_mb_;  // of the server after each tenth of the requests
  std::size_t n_sent_ = 0, n_answered_ = 0, n_crossed_ = 0, n_error_ = 0;
  int n_unasked_ = 0;
  std::vector<double> round_trip_, overhead_, queue_, decode_, plain_jpeg_;
  std::vector<unsigned char> pixels_;
};

std::string read_file(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  CLI::App app("Many clients against a running server, every answer checked");
  app.add_option("ADDRESS", options.address)->required();
  app.add_option("--clients", options.n_client, "Each keeps one act in flight")->check(CLI::Range(1, 1000));
  app.add_option("--requests", options.n_request, "Of all clients together")->check(CLI::Range(1, 100'000'000));
  app.add_option("--side", options.side, "Raw frames are SIDE x SIDE")->check(CLI::Range(1, 4096));
  app.add_option("--jpeg", options.jpeg, "Files to send instead of raw frames")->check(CLI::ExistingFile);
  app.add_option("--pid", options.pid, "Of the server, whose resident memory is told after each tenth of the requests");
  CLI11_PARSE(app, argc, argv);
  for (std::string& file : options.jpeg) file = read_file(file);
  Load load(options);
  if (!load.acts_differ()) {
    fmt::print(stderr,
               "error: the acts of this load give equal chunks, or none, so that crossed answers would not show\n");
    return 1;
  }
  load.run();
  fmt::print("{}\n", load.report().dump());
  return load.flawless() ? 0 : 1;
}
