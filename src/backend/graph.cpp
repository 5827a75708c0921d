// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "backend/graph.h"

#include <set>

#include "backend/pages.h"

namespace vla {
namespace {

/// Room for a graph: no module makes more than this many nodes for each of its parameters.
constexpr std::size_t kNodesPerParam = 48;
constexpr std::size_t kLeastNodes = 4096;

/// A product with fewer operations than this takes about as long as bringing the threads together after it.
constexpr double kLeastWork = 4e6;

/// A node that passes its operand on and notes when it was reached: ggml starts a node after the one before it is done.
void note_time(ggml_tensor*, const ggml_tensor*, int, int, void* stage) {
  static_cast<Stage*>(stage)->done = std::chrono::steady_clock::now();
}

}  // namespace

Status ComputeMemory::reserve(ggml_cgraph* graph) {
  if (ggml_gallocr_reserve(allocator_.get(), graph)) return {};
  return Error{Code::out_of_memory, "working memory", "", "the device refused the allocation",
               "free memory or use a smaller model"};
}

Graph::Graph(const Weights& weights, Store& store, TapFilter keep)
    : weights_(weights), store_(store), keep_(std::move(keep)) {
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
  if (!keeps(path)) return value;
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

Tensor Graph::stage(const std::string& name, Tensor value) {
  Stage& stage = stages_.emplace_back(Stage{name, {}, {}});
  stage.mark = ggml_map_custom1_inplace(context_.get(), value.node(), note_time, 1, &stage);
  note_work(stage.mark, {});
  require(stage.mark);
  return stage.mark;
}

Work Graph::work_of_node(const ggml_tensor* node) const {
  const auto noted = noted_work_.find(node);
  return noted != noted_work_.end() ? noted->second : work_of(node);
}

std::vector<Work> Graph::work() const {
  std::vector<Work> parts(1);
  for (int i = 0; i < ggml_graph_n_nodes(graph_); ++i) {
    const ggml_tensor* node = ggml_graph_node(graph_, i);
    parts.back() += work_of_node(node);
    if (parts.size() <= stages_.size() && node == stages_[parts.size() - 1].mark.node()) parts.emplace_back();
  }
  return parts;
}

Status Graph::allocate(ComputeMemory& memory) {
  if (!scratch().ok())
    return Error{Code::out_of_memory, "scratch memory of threads", "", "the system refused the allocation",
                 "free memory or use fewer threads"};
  if (ggml_gallocr_alloc_graph(memory.allocator(), graph_)) return {};
  return Error{Code::out_of_memory, "working memory", "", "the graph does not fit into what was reserved for it"};
}

void Graph::touch() const {
  std::set<ggml_backend_buffer_t> buffers;
  for (int i = 0; i < ggml_graph_n_nodes(graph_); ++i) buffers.insert(ggml_graph_node(graph_, i)->buffer);
  buffers.erase(nullptr);
  for (ggml_backend_buffer_t buffer : buffers) {
    void* data = ggml_backend_buffer_get_base(buffer);
    want_large_pages(data, ggml_backend_buffer_get_size(buffer));
    want_memory_now(data, ggml_backend_buffer_get_size(buffer));
  }
}

int Graph::n_thread(const Device& device) const {
  double flop = 0;
  int n_product = 0;
  for (int i = 0; i < ggml_graph_n_nodes(graph_); ++i)
    if (const double of_node = work_of_node(ggml_graph_node(graph_, i)).flop; of_node > 0) flop += of_node, ++n_product;
  return flop < kLeastWork * n_product ? 1 : device.n_thread();
}

Status Graph::run(const Device& device) {
  ggml_backend_cpu_set_n_threads(device.backend(), n_thread_ > 0 ? n_thread_ : n_thread_ = n_thread(device));
  const ggml_status status = ggml_backend_graph_compute(device.backend(), graph_);
  if (status == GGML_STATUS_SUCCESS) return {};
  if (status == GGML_STATUS_ALLOC_FAILED)
    return Error{Code::out_of_memory, "graph", "", "the device ran out of memory"};
  return Error{Code::device, "graph", "a finished run", ggml_status_to_string(status)};
}

int Graph::n_node() const { return ggml_graph_n_nodes(graph_); }

}  // namespace vla
