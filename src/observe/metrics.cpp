// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "observe/metrics.h"

#include <prometheus/gauge.h>
#include <prometheus/text_serializer.h>

#include <new>

#include "base/process.h"

namespace vla::observe {
namespace {

const prometheus::Histogram::BucketBoundaries kSeconds = {1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 0.01, 0.025,
                                                          0.05, 0.1,    0.25, 0.5,  1,      2.5,  5,    10};

double seconds(Clock::duration time) { return std::chrono::duration<double>(time).count(); }

prometheus::MetricFamily gauge(const char* name, const char* help, double value) {
  prometheus::MetricFamily family{name, help, prometheus::MetricType::Gauge, {}};
  family.metric.emplace_back().gauge.value = value;
  return family;
}

prometheus::Counter& counter(prometheus::Registry& registry, const char* name, const char* help) {
  return prometheus::BuildCounter().Name(name).Help(help).Register(registry).Add({});
}

prometheus::Family<prometheus::Gauge>& gauges(prometheus::Registry& registry, const char* name, const char* help) {
  return prometheus::BuildGauge().Name(name).Help(help).Register(registry);
}

}  // namespace

Metrics::Metrics()
    : requests_(prometheus::BuildCounter()
                    .Name("vla_requests_total")
                    .Help("Requests answered, by kind and code")
                    .Register(*registry_)),
      stages_(prometheus::BuildHistogram()
                  .Name("vla_stage_seconds")
                  .Help("Wall time of acts that reached the engine, by stage")
                  .Register(*registry_)),
      dropped_(prometheus::BuildCounter()
                   .Name("vla_dropped_connections_total")
                   .Help("Connections that the server ended, by reason")
                   .Register(*registry_)),
      bundles_(gauges(*registry_, "vla_bundle_info", "A bundle that answers")),
      runtimes_(gauges(*registry_, "vla_runtime_info", "What computes")),
      memory_(gauges(*registry_, "vla_engine_memory_bytes", "Memory of a policy, by what it holds")),
      received_bytes_(counter(*registry_, "vla_received_bytes_total", "Bytes of requests")),
      sent_bytes_(counter(*registry_, "vla_sent_bytes_total", "Bytes of answers")),
      clients_(counter(*registry_, "vla_clients_total", "Connections that have sent a request")),
      refused_(counter(*registry_, "vla_refused_clients_total", "Handshakes of clients whose key is not listed")),
      beyond_(counter(*registry_, "vla_state_beyond_total", "Acts answered though their state is beyond its bound")),
      rows_beyond_(counter(*registry_, "vla_rows_beyond_limits_total", "Rows of chunks outside of the limits")) {
  auto& chunks = prometheus::BuildCounter()
                     .Name("vla_chunks_beyond_limits_total")
                     .Help("Chunks with rows outside of the limits, by what became of them")
                     .Register(*registry_);
  chunks_noted_ = &chunks.Add({{"outcome", "noted"}}), chunks_refused_ = &chunks.Add({{"outcome", "refused"}});
  gauges(*registry_, "vla_build_info", "Version of the server").Add({{"version", VLA_VERSION}}).Set(1);
}

void Metrics::set(const std::string& policy, Gauges& family, prometheus::Labels labels, double value) {
  if (!policy.empty()) labels["policy"] = policy;
  prometheus::Gauge& gauge = family.Add(labels);
  gauge.Set(value);
  gauges_.emplace(policy, std::pair(&family, &gauge));
}

void Metrics::describe(const v1::Description& description, const MemoryUse& memory) {
  const std::string& policy = description.policy();
  forget(policy);
  const std::lock_guard lock(mutex_);
  const v1::Bundle& bundle = description.bundle();
  set(policy, bundles_,
      {{"name", bundle.name()}, {"arch", bundle.arch()}, {"checksum", bundle.checksum()}, {"dtype", bundle.dtype()}},
      1);
  const v1::Runtime& runtime = description.runtime();
  set(policy, runtimes_,
      {{"device", runtime.device()}, {"precision", runtime.precision()}, {"kernels", runtime.kernels()}}, 1);
  set(policy, memory_, {{"part", "weights"}}, static_cast<double>(memory.weights));
  set(policy, memory_, {{"part", "plan"}}, static_cast<double>(memory.plan));
  set(policy, memory_, {{"part", "working"}}, static_cast<double>(memory.working));
}

void Metrics::forget(const std::string& policy) {
  const std::lock_guard lock(mutex_);
  const auto [begin, end] = gauges_.equal_range(policy);
  for (auto at = begin; at != end; ++at) at->second.first->Remove(at->second.second);
  gauges_.erase(begin, end);
}

std::string Metrics::text(const Health& health) const {
  std::vector<prometheus::MetricFamily> families = registry_->Collect();
  families.push_back(gauge("vla_ready", "1 while acts are taken", health.ready ? 1 : 0));
  families.push_back(gauge("vla_queue_depth", "Acts that wait", static_cast<double>(health.n_waiting)));
  families.push_back(gauge("vla_computing", "1 while the engine computes", health.computing ? 1 : 0));
  families.push_back(gauge("vla_uptime_seconds", "Time since the server became ready", health.uptime_s));
  families.push_back(
      gauge("process_resident_memory_bytes", "Resident memory of the process", static_cast<double>(resident_size())));
  return prometheus::TextSerializer().Serialize(families);
}

void Metrics::received(const Received& request) {
  received_bytes_.Increment(static_cast<double>(request.size));
  if (request.is_first) clients_.Increment();
}

/// `why` is one of a fixed list of words.
void Metrics::dropped(const Dropped& connection) try {
  if (connection.why == "key") refused_.Increment();
  dropped_.Add({{"why", connection.why}}).Increment();
} catch (const std::bad_alloc&) {  // not counted; the server continues
}

void Metrics::answered(const Answered& answered) try {
  sent_bytes_.Increment(static_cast<double>(answered.n_sent));
  const Received& request = answered.request;
  const int code = answered.error == nullptr ? 0 : exit_code(answered.error->code);
  prometheus::Counter*& count = request_[{request.kind, code}];
  if (count == nullptr) count = &requests_.Add({{"kind", kind_name(request.kind)}, {"code", answered.code()}});
  if (answered.out_of_range) beyond_.Increment();
  rows_beyond_.Increment(answered.n_beyond);
  if (answered.n_beyond > 0) (answered.error == nullptr ? chunks_noted_ : chunks_refused_)->Increment();
  count->Increment();
  if (answered.stages.empty()) return;
  observe("queue", seconds(answered.started - request.at));
  for (const auto& [stage, ms] : answered.stages) observe(stage, ms / 1e3);
  observe("total", seconds(answered.sent - request.at));
} catch (const std::bad_alloc&) {  // not counted; the server continues
}

void Metrics::observe(const std::string& stage, double seconds) {
  prometheus::Histogram*& histogram = stage_[stage];
  if (histogram == nullptr) histogram = &stages_.Add({{"stage", stage}}, kSeconds);
  histogram->Observe(seconds);
}

}  // namespace vla::observe
