// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <prometheus/counter.h>
#include <prometheus/gauge.h>
#include <prometheus/histogram.h>
#include <prometheus/registry.h>

#include <map>
#include <mutex>
#include <string>

#include "engine/engine.h"
#include "observe/observer.h"
#include "wire/vla.pb.h"

namespace vla::observe {

/// Counts and times requests for Prometheus. docs/serving.md lists the metrics. Label values come from the server,
/// never from a client, so their number is bounded.
class Metrics final : public Observer {
 public:
  Metrics();

  /// Adds a policy, replacing one of the same name. Any thread may call this and `forget`.
  void describe(const v1::Description& description, const MemoryUse& memory);
  void forget(const std::string& policy);
  /// The metrics in exposition format 0.0.4. Reads resident memory now. Any thread may call it.
  std::string text(const Health& health) const;

  void received(const Received& request) override;
  void dropped(const Dropped& connection) override;
  void answered(const Answered& answered) override;

 private:
  using Gauges = prometheus::Family<prometheus::Gauge>;
  void set(const std::string& policy, Gauges& family, prometheus::Labels labels, double value);
  void observe(const std::string& stage, double seconds);

  std::shared_ptr<prometheus::Registry> registry_ = std::make_shared<prometheus::Registry>();
  prometheus::Family<prometheus::Counter>& requests_;
  prometheus::Family<prometheus::Histogram>& stages_;
  prometheus::Family<prometheus::Counter>& dropped_;
  Gauges &bundles_, &runtimes_, &memory_;
  prometheus::Counter &received_bytes_, &sent_bytes_, &clients_, &refused_, &beyond_, &rows_beyond_;
  prometheus::Counter *chunks_noted_, *chunks_refused_;  // chunks with rows beyond the limits
  std::mutex mutex_;
  std::multimap<std::string, std::pair<Gauges*, prometheus::Gauge*>> gauges_;  // keyed by policy
  // For the I/O thread only:
  std::map<std::string, prometheus::Histogram*> stage_;
  std::map<std::pair<Kind, int>, prometheus::Counter*> request_;
};

}  // namespace vla::observe
