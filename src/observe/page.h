// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <map>
#include <mutex>
#include <vector>

#include "engine/engine.h"
#include "observe/http.h"
#include "observe/observer.h"
#include "observe/recording.h"
#include "observe/recordings.h"
#include "wire/vla.pb.h"

namespace vla::observe {

/// A live page for people. `/` is the page. It requests `/policy` once, `/acts?after=N` for newly answered acts, and
/// `/image?act=N&view=I` for frames, with `&as=seen` as the network gets them. POST to `/record?on=1` or `on=0` begins
/// or ends a recording. Every request needs `token=`, which is drawn anew for each server and protects nothing else,
/// since browsers keep addresses. The last acts stay in memory, up to a size; a viewer that falls behind misses some
/// and delays nobody. Of a refused act, which may contain anything, only the beginning is shown.
class Page final : public Observer {
 public:
  struct Range {
    std::vector<double> low, high;  // one for each value of a state, in world units
  };
  struct Sources {
    std::string token;
    std::function<bool(std::string_view given, std::string_view token)> is_same;
    std::function<Health()> health;
    Recordings* recordings = nullptr;  // the server's; null without a folder for them
    bool is_server = true;             // false: the page shows a recording
  };
  /// Returns a view of this act as the network gets it, an 8-bit picture. Errors: bad_observation, too_large.
  using See = std::function<Result<Frame>(const v1::Act& act, int view)>;
  /// As Http::open.
  static Result<std::unique_ptr<Page>> open(const std::string& address, bool insecure, Sources sources);

  /// Sets the policy, the training ranges of its states (`ranges`, by EMBODIMENT/STATE), the limits of its actions (by
  /// name), and `see`, which may be empty. Call it before the first request. An infinite end is no limit.
  void describe(const v1::Description& description, const std::map<std::string, Range>& ranges,
                const std::map<std::string, Range>& limits, See see);
  void answered(const Answered& answered) override;
  /// Adds a recorded request and its answer. Returns false, and does not show it, if the answer is neither a chunk nor
  /// an error.
  bool show(const Recording::Record& record);
  bool records() const override { return true; }

  const std::string& address() const { return http_->address(); }
  /// The address for a browser, with the token.
  std::string url() const;

  /// An answered act, as serialized messages. Their JSON is made when a viewer asks, on Http's thread.
  struct Act;
  /// Maximum memory of the kept acts, with the overhead of each.
  static constexpr std::size_t kMaxBytes = 96 << 20;

 private:
  explicit Page(Sources sources) : sources_(std::move(sources)) {}
  void keep(const std::shared_ptr<Act>& act, std::span<const std::byte> in, std::span<const std::byte> out);
  HttpReply reply(const std::string& path, const std::string& query);
  HttpReply reply_to_post(const std::string& path, const std::string& query);
  bool may_ask(const std::string& query) const;
  HttpReply acts_after(std::uint64_t id);
  HttpReply image(std::uint64_t id, std::size_t view, bool as_seen);
  const Result<Frame>& seen(const Act& act, std::size_t view);

  const Sources sources_;
  std::mutex mutex_;
  std::deque<std::shared_ptr<Act>> acts_;  // ids count up without gaps
  std::uint64_t n_act_ = 0;
  std::size_t bytes_ = 0;
  std::string policy_ = "{}";
  See see_;
  /// The last pictures, kept so that a second viewer costs nothing. Only Http's thread uses them.
  struct Seen {
    std::uint64_t act = 0;
    std::size_t view = 0;
    Result<Frame> picture;
  };
  std::deque<Seen> seen_;
  std::unique_ptr<Http> http_;  // last member: its thread uses the others
};

}  // namespace vla::observe
