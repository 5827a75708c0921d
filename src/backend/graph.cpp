// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/graph.h"

namespace vla {
namespace {

/// Room for a graph: no module makes more than this many nodes for each of its parameters.
constexpr std::size_t kNodesPerParam = 48;
constexpr std::size_t kLeastNodes = 4096;

bool match_one(std::string_view pattern, std::string_view path) {
  if (pattern.empty()) return path.empty();
  if (pattern.front() == '*') return match_one(pattern.substr(1), path) || (!path.empty() && match_one(pattern, path.substr(1)));
  return !path.empty() && pattern.front() == path.front() && match_one(pattern.substr(1), path.substr(1));
}

}  // namespace

bool match_path(const std::string& pattern, const std::string& path) {
  std::string_view rest = pattern;
  while (!rest.empty()) {
    const std::size_t comma = std::min(rest.find(','), rest.size());
    if (comma > 0 && match_one(rest.substr(0, comma), path)) return true;
    rest.remove_prefix(std::min(comma + 1, rest.size()));
  }
  return false;
}

Graph::Graph(const Weights& weights, Store& store, TapPattern taps) : weights_(weights), store_(store), pattern_(std::move(taps)) {
  const std::size_t n_node = kLeastNodes + kNodesPerParam * weights.count();
  const std::size_t memory = ggml_graph_overhead_custom(n_node, false) + n_node * ggml_tensor_overhead();
  context_.reset(ggml_init({.mem_size = memory, .mem_buffer = nullptr, .no_alloc = true}));
  graph_ = ggml_new_graph_custom(context_.get(), n_node, false);
}

Tensor Graph::constant(const std::string& key, const std::function<Tensor(Store&)>& make) {
  const auto [place, is_new] = constants_.try_emplace(key);
  if (is_new) place->second = make(store_);
  return place->second;
}

Tensor Graph::name(const std::string& path, Tensor value) {
  if (pattern_.empty() || !match_path(pattern_, path)) return value;
  // A view's memory belongs to another tensor, which may be overwritten later in the run: keep a copy.
  ggml_tensor* kept = value.node();
  if (kept->view_src != nullptr || !ggml_is_contiguous(kept)) kept = ggml_cont(context_.get(), kept);
  ggml_set_output(kept);
  require(kept);
  taps_.emplace_back(path, kept);
  return value;
}

void Graph::require(Tensor value) { ggml_build_forward_expand(graph_, value.node()); }

void Graph::write(Tensor value, Tensor target) { require(ggml_cpy(context_.get(), value.node(), target.node())); }

Status Graph::allocate(ComputeMemory& memory) {
  if (ggml_gallocr_alloc_graph(memory.allocator(), graph_)) return {};
  return Error{Code::out_of_memory, "working memory", "", "the device refused the allocation", "free memory or use a smaller model"};
}

Status Graph::run(const Device& device) {
  const ggml_status status = ggml_backend_graph_compute(device.backend(), graph_);
  if (status == GGML_STATUS_SUCCESS) return {};
  if (status == GGML_STATUS_ALLOC_FAILED) return Error{Code::out_of_memory, "graph", "", "the device ran out of memory"};
  return Error{Code::device, "graph", "a finished run", ggml_status_to_string(status)};
}

int Graph::n_node() const { return ggml_graph_n_nodes(graph_); }

}  // namespace vla
