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

/// A live page for people: `/` is the page, which asks `/policy` once, `/acts?after=N` for what was answered since, and
/// `/image?act=N&view=I` for frames, `&as=seen` for what the network got of them. POST to `/record?on=1` or `on=0`
/// begins and ends a recording. Every request needs `token=`, which is drawn anew for each server and is no other
/// secret, since browsers keep addresses. The last acts are kept, up to a size in memory; a viewer that falls behind
/// misses some, and holds nothing up. Of a refused act, which may hold anything, only the beginning is told.
class Page final : public Observer {
 public:
  struct Range {
    std::vector<double> low, high;  // one for each value of a state, in world units
  };
  struct Sources {
    std::string token;
    std::function<bool(std::string_view given, std::string_view token)> is_same;
    std::function<Health()> health;
    Recordings* recordings = nullptr;  // of the server, where it was given a folder for them
    bool is_server = true;             // and not a recording that is shown
  };
  /// What the network gets of a view of this act, as a picture of 8 bits. Errors: bad_observation, too_large.
  using See = std::function<Result<Frame>(const v1::Act& act, int view)>;
  /// As Http::open.
  static Result<std::unique_ptr<Page>> open(const std::string& address, bool insecure, Sources sources);

  /// The policy, where its states were in training and where its actions may be, by name, and how it sees, if that is
  /// known; before the first request. Infinite ends are none.
  void describe(const v1::Description& description, const std::map<std::string, Range>& ranges,
                const std::map<std::string, Range>& limits, See see);
  void answered(const Answered& answered) override;
  /// A request and its answer of a recording. False for one that is no act, which is not shown.
  bool show(const Recording::Record& record);
  bool records() const override { return true; }

  const std::string& address() const { return http_->address(); }
  /// For a browser.
  std::string url() const;

  /// An answered act, as the bytes that went over the wire. What is told of them is made when a viewer asks, on the
  /// thread of Http.
  struct Act;
  /// Of the acts that are kept, with what each takes beside its bytes.
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
  /// The last pictures that were made, so that a second viewer costs nothing; of the thread of Http.
  struct Seen {
    std::uint64_t act = 0;
    std::size_t view = 0;
    Result<Frame> picture;
  };
  std::deque<Seen> seen_;
  std::unique_ptr<Http> http_;  // last: its thread asks the others
};

}  // namespace vla::observe
