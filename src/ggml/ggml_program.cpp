// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_program.h"

#include <fmt/format.h>

#include <cmath>

namespace vla {
namespace {

/// Translates each node to one or a few ggml operations. If ggml's own operation differs from float32 in the last
/// digits, the node is composed of exact operations.
class Translator {
 public:
  Translator(ggml_context* context, ggml_context* constants, GgmlDevice& device)
      : c(context),
        constants_(constants),
        device_(device),
        alignment_(ggml_backend_buft_get_alignment(device.memory().type())) {}

  ggml_tensor* operator()(const Node& n) {
    node_ = &n;
    return std::visit([this](const auto& op) { return translate(op); }, n.op);
  }
  void keep(ggml_tensor* tensor) { made_.push_back(tensor); }

 private:
  ggml_tensor* in(std::size_t i) const { return made_[static_cast<std::size_t>(node_->in[i].node()->id)]; }
  /// Makes a view contiguous: some operations do not accept a view's strides in dimensions of size one, or a view that
  /// begins at an address where the backend would not place a tensor.
  ggml_tensor* contiguous(ggml_tensor* x) const {
    if (!ggml_is_contiguous(x) || x->view_offs % alignment_ != 0) return ggml_cont(c, x);
    return x->view_src != nullptr ? ggml_reshape(c, x, x) : x;
  }
  ggml_tensor* reshaped(ggml_tensor* x, const Shape& s) const {
    return ggml_reshape_4d(c, contiguous(x), s[0], s[1], s[2], s[3]);
  }

  ggml_tensor* translate(const op::Input& op) { return static_cast<ggml_tensor*>(op.slot->place); }
  ggml_tensor* translate(const op::Parameter& op) { return device_.weight(op.param); }
  ggml_tensor* translate(const op::Constant& op) {
    return ggml_new_tensor(constants_, op.values.index() == 1 ? GGML_TYPE_I32 : GGML_TYPE_F32, 4, node_->shape.data());
  }
  ggml_tensor* translate(const op::Linear& op) {
    ggml_tensor* y = op.rule == op::Rule::int8_rows ? int8_product(op) : product(device_.weight(op.weight));
    return op.bias != nullptr ? ggml_add(c, y, device_.weight(op.bias)) : y;
  }
  /// Vulkan does not repeat a matrix along the fourth dimension, so all rows become one matrix.
  ggml_tensor* product(ggml_tensor* weight) {
    ggml_tensor* x = contiguous(in(0));
    if (x->ne[3] == 1) return ggml_mul_mat(c, weight, x);
    ggml_tensor* rows = ggml_reshape_2d(c, x, x->ne[0], ggml_nrows(x));
    return reshaped(ggml_mul_mat(c, weight, rows), node_->shape);
  }
  /// Codes are integers stored as float32, small enough for exact sums.
  ggml_tensor* int8_product(const op::Linear& op) {
    constexpr float kRound = 0x1.8p23f;  // adding this constant rounds to an integer, ties to even
    constexpr float kSmallest = 1e-5f;
    ggml_tensor* x = contiguous(in(0));
    const int d_in = static_cast<int>(x->ne[0]);
    ggml_tensor* largest = ggml_pool_1d(c, ggml_abs(c, x), GGML_OP_POOL_MAX, d_in, d_in, 0);  // [1, n, ...]
    largest = ggml_clamp(c, largest, kSmallest, INFINITY);
    ggml_tensor* ones = ggml_scale_bias(c, largest, 0.0f, 1.0f);
    ggml_tensor* s = ggml_scale(c, ggml_div(c, ones, largest), 127.0f);
    ggml_tensor* codes = ggml_scale_bias(c, ggml_scale_bias(c, ggml_mul(c, x, s), 1.0f, kRound), 1.0f, -kRound);
    ggml_tensor* step = ggml_div(c, ggml_mul(c, ones, device_.weight(op.weight->scales)), s);
    return ggml_mul(c, ggml_mul_mat(c, device_.weight(op.weight), codes), step);
  }
  ggml_tensor* translate(const op::Embedding& op) { return ggml_get_rows(c, device_.weight(op.table), in(0)); }
  ggml_tensor* translate(const op::Gather&) { return ggml_get_rows(c, in(0), in(1)); }
  ggml_tensor* translate(const op::Norm& op) {
    ggml_tensor* x = contiguous(in(0));
    ggml_tensor* y = op.kind == op::NormKind::rms ? ggml_rms_norm(c, x, op.eps) : ggml_norm(c, x, op.eps);
    if (node_->in.size() > 1) y = ggml_mul(c, y, in(1));
    return node_->in.size() > 2 ? ggml_add(c, y, in(2)) : y;
  }

  /// Uses angles from a table, because ggml's own rotation computes each angle from the one before by multiplication.
  ggml_tensor* translate(const op::Rope&) {
    ggml_tensor* x = contiguous(in(0));
    ggml_tensor* table = contiguous(in(1));
    const std::int64_t half = x->ne[0] / 2;
    const std::size_t middle = static_cast<std::size_t>(half) * sizeof(float);
    const auto of_x = [&](std::size_t offset) {
      return ggml_view_4d(c, x, half, x->ne[1], x->ne[2], x->ne[3], x->nb[1], x->nb[2], x->nb[3], offset);
    };
    const auto of_table = [&](std::size_t offset) {
      return ggml_view_3d(c, table, half, 1, x->ne[2], 2 * middle, 2 * middle, offset);
    };
    ggml_tensor *a = ggml_cont(c, of_x(0)), *b = ggml_cont(c, of_x(middle));
    ggml_tensor *cosine = ggml_cont(c, of_table(0)), *sine = ggml_cont(c, of_table(middle));
    ggml_tensor* first = ggml_sub(c, ggml_mul(c, a, cosine), ggml_mul(c, b, sine));
    return ggml_concat(c, first, ggml_add(c, ggml_mul(c, b, cosine), ggml_mul(c, a, sine)), 0);
  }

  /// A product, a softmax and a product, because ggml's fused attention rounds keys and values to float16.
  ggml_tensor* translate(const op::Attention& op) {
    const std::size_t first = op.has_mask ? 2 : 1;
    ggml_tensor *k = in(first), *v = in(first + 1), *q = in(0);
    for (std::size_t i = first + 2; i < node_->in.size(); i += 2)
      k = ggml_concat(c, k, in(i), 2), v = ggml_concat(c, v, in(i + 1), 2);
    const float scale = 1.0f / std::sqrt(static_cast<float>(q->ne[0]));
    ggml_tensor* query = ggml_cont(c, ggml_permute(c, q, 0, 2, 1, 3));  // [d_head, n_query, n_head, n_batch]
    ggml_tensor* key = ggml_cont(c, ggml_permute(c, k, 0, 2, 1, 3));    // [d_head, n_key, n_head_kv, n_batch]
    ggml_tensor* value = ggml_cont(c, ggml_permute(c, v, 1, 2, 0, 3));  // [n_key, d_head, n_head_kv, n_batch]
    ggml_tensor* score = ggml_mul_mat(c, key, query);                   // [n_key, n_query, n_head, n_batch]
    ggml_tensor* weight = ggml_soft_max_ext(c, score, op.has_mask ? contiguous(in(1)) : nullptr, scale, 0.0f);
    ggml_tensor* mixed = ggml_permute(c, ggml_mul_mat(c, value, weight), 0, 2, 1, 3);
    return ggml_cont_3d(c, mixed, q->ne[0] * q->ne[1], q->ne[2], q->ne[3]);
  }

  /// ggml's own ReLU turns NaN into zero; here NaN stays NaN.
  ggml_tensor* relu(ggml_tensor* x) { return ggml_add(c, ggml_relu(c, x), ggml_scale(c, x, 0.0f)); }

  ggml_tensor* translate(const op::Activate& op) {
    ggml_tensor* x = contiguous(in(0));
    switch (op.activation) {
      case Activation::gelu_tanh: {  // x sigmoid(2 u): ggml's own operation reads a float16 table
        constexpr float kLinear = 1.5957691216f, kCubic = kLinear * 0.044715f;  // 2 sqrt(2/pi)
        ggml_tensor* factor = ggml_scale_bias(c, ggml_sqr(c, x), kCubic, kLinear);
        return ggml_mul(c, x, ggml_sigmoid(c, ggml_mul(c, x, factor)));
      }
      case Activation::gelu_erf:
        return ggml_gelu_erf(c, x);
      case Activation::silu:
        return ggml_silu(c, x);
      case Activation::relu:
        return relu(x);
      case Activation::relu_squared:
        return ggml_sqr(c, relu(x));
      case Activation::mish: {  // x n / (n + 2) with n = (1 + e^x)^2 - 1; the clamp writes to a copy
        ggml_tensor* power = ggml_exp(c, ggml_clamp(c, ggml_scale(c, x, 1.0f), -100.0f, 20.0f));
        ggml_tensor* n = ggml_mul(c, power, ggml_scale_bias(c, power, 1.0f, 2.0f));
        return ggml_mul(c, x, ggml_div(c, n, ggml_scale_bias(c, n, 1.0f, 2.0f)));
      }
      case Activation::none:
        break;
    }
    return x;
  }
  ggml_tensor* translate(const op::Add&) { return ggml_add(c, contiguous(in(0)), contiguous(in(1))); }
  ggml_tensor* translate(const op::Multiply&) { return ggml_mul(c, contiguous(in(0)), contiguous(in(1))); }
  ggml_tensor* translate(const op::Scale& op) { return ggml_scale(c, contiguous(in(0)), op.factor); }
  ggml_tensor* translate(const op::Concat& op) {
    ggml_tensor* all = in(0);
    for (std::size_t i = 1; i < node_->in.size(); ++i) all = ggml_concat(c, all, in(i), op.dim);
    return all;
  }
  ggml_tensor* translate(const op::Slice& op) {
    ggml_tensor* x = in(0);
    const Shape& s = node_->shape;
    return ggml_view_4d(c, x, s[0], s[1], s[2], s[3], x->nb[1], x->nb[2], x->nb[3],
                        static_cast<std::size_t>(op.first) * x->nb[op.dim]);
  }
  ggml_tensor* translate(const op::Repeat&) {
    const Shape& s = node_->shape;
    return ggml_repeat_4d(c, contiguous(in(0)), s[0], s[1], s[2], s[3]);
  }
  ggml_tensor* translate(const op::Reshape&) { return reshaped(in(0), node_->shape); }
  /// ggml_permute takes the destination of each dimension of x. The result is made contiguous, because not all ggml
  /// operations read rows that are not.
  ggml_tensor* translate(const op::Permute& op) {
    std::array<int, 4> to{};
    for (int i = 0; i < 4; ++i) to[static_cast<std::size_t>(op.order[static_cast<std::size_t>(i)])] = i;
    return ggml_cont(c, ggml_permute(c, in(0), to[0], to[1], to[2], to[3]));
  }
  ggml_tensor* translate(const op::Patches& op) {
    ggml_tensor* kernel = ggml_new_tensor_4d(c, GGML_TYPE_F32, op.size, op.size, 3, 1);  // only its shape is read
    ggml_tensor* rows = ggml_im2col(c, kernel, contiguous(in(0)), op.size, op.size, 0, 0, 1, 1, true, GGML_TYPE_F32);
    return reshaped(rows, node_->shape);
  }
  ggml_tensor* translate(const op::PixelShuffle& op) {
    ggml_tensor* x = in(0);
    const std::int64_t f = op.factor, n_row = x->ne[1] / op.n_column;
    // Patch (f R + r, f C + c): the order after the features is c, C, r, R; exchanging C and r makes each f x f square
    // contiguous.
    ggml_tensor* split = reshaped(x, {x->ne[0] * f, op.n_column / f, f, n_row / f * x->ne[2]});
    return reshaped(ggml_cont(c, ggml_permute(c, split, 0, 2, 1, 3)), node_->shape);
  }
  /// ggml's images and unfolded rows are [width, height, d].
  ggml_tensor* translate(const op::Unfold& op) {
    return reshaped(ggml_cont(c, ggml_permute(c, covered(op.window), 1, 0, 2, 3)), node_->shape);
  }
  /// The elements in a window: [size^2, d, n_place, n_view].
  ggml_tensor* covered(const op::Window& window) {
    const auto [size, stride, padding] = window;
    const Shape& s = node_->shape;
    const std::int64_t d = node_->in[0].dim(0), area = std::int64_t{size} * size;
    ggml_tensor* image = ggml_cont(c, ggml_permute(c, in(0), 2, 0, 1, 3));
    ggml_tensor* kernel = ggml_new_tensor_4d(c, GGML_TYPE_F32, size, size, d, 1);  // only its shape is read
    ggml_tensor* rows = ggml_im2col(c, kernel, image, stride, stride, padding, padding, 1, 1, true, GGML_TYPE_F32);
    return reshaped(rows, {area, d, s[1] * s[2], s[3]});
  }
  /// ggml's own maximum ignores NaN; here NaN stays NaN.
  ggml_tensor* translate(const op::MaxPool& op) {
    const auto [size, stride, padding] = op.window;
    ggml_tensor* image = ggml_cont(c, ggml_permute(c, in(0), 2, 0, 1, 3));
    const auto pool = [&, n = size, step = stride, pad = static_cast<float>(padding)](ggml_op_pool kind,
                                                                                      ggml_tensor* x) {
      return ggml_pool_2d(c, x, kind, n, n, step, step, pad, pad);
    };
    ggml_tensor* nothing = pool(GGML_OP_POOL_AVG, ggml_scale(c, image, 0.0f));
    return ggml_cont(c, ggml_permute(c, ggml_add(c, pool(GGML_OP_POOL_MAX, image), nothing), 1, 2, 0, 3));
  }
  ggml_tensor* translate(const op::Depthwise& op) {
    const Shape& s = node_->shape;
    const std::int64_t area = std::int64_t{op.window.size} * op.window.size;
    ggml_tensor* weight = ggml_cont(c, ggml_transpose(c, reshaped(in(1), {s[0], area, 1, 1})));  // [size^2, d]
    ggml_tensor* sums = ggml_sum_rows(c, ggml_mul(c, covered(op.window), weight));               // [1, d, ...]
    return ggml_add(c, reshaped(sums, s), contiguous(in(2)));
  }
  /// Rows of tokens: [n, d_group, n_group, n_view].
  ggml_tensor* translate(const op::ChannelAttention& op) {
    const Shape& s = node_->shape;
    const Shape split = {s[0] / op.n_group, op.n_group, s[1], s[2]};
    const auto rows = [&](std::size_t i) { return ggml_cont(c, ggml_permute(c, reshaped(in(i), split), 1, 2, 0, 3)); };
    ggml_tensor* score = ggml_mul_mat(c, rows(1), rows(0));  // [d_group of keys, of queries, n_group, n_view]
    const float scale = 1.0f / std::sqrt(static_cast<float>(s[1]));
    ggml_tensor* weight = ggml_soft_max_ext(c, score, nullptr, scale, 0.0f);
    ggml_tensor* value = ggml_cont(c, ggml_permute(c, reshaped(in(2), split), 0, 2, 1, 3));  // [d_group, n, ...]
    ggml_tensor* mixed = ggml_mul_mat(c, weight, value);  // [d_group of queries, n, n_group, n_view]
    return reshaped(ggml_cont(c, ggml_permute(c, mixed, 0, 2, 1, 3)), s);
  }
  ggml_tensor* translate(const op::Write& op) { return ggml_cpy(c, in(0), static_cast<ggml_tensor*>(op.slot->place)); }

  ggml_context *c, *constants_;
  const GgmlDevice& device_;
  std::size_t alignment_;
  const Node* node_ = nullptr;
  std::vector<ggml_tensor*> made_;  // by Node::id
};

bool is_leaf(const Node& node) { return node.in.empty(); }

Work work_of(const Node& node) {
  Work work;
  if (const auto* linear = node.as<op::Linear>()) work.weights = 4.0 * static_cast<double>(linear->weight->count());
  work.flop = flop_of(node), work.bytes = work.weights + 4.0 * static_cast<double>(count(node.shape));
  for (Tensor in : node.in) work.bytes += 4.0 * static_cast<double>(count(in.shape()));
  return work;
}

/// Checks that the backend supports the ggml operations of a node. Errors: unsupported, naming the first that it lacks.
Status check_supported(const GgmlDevice& device, ggml_cgraph* graph, int first, const Node& node) {
  for (int i = first; i < ggml_graph_n_nodes(graph); ++i) {
    const ggml_tensor* made = ggml_graph_node(graph, i);
    if (ggml_backend_supports_op(device.backend(), made)) continue;
    return Error{Code::unsupported, node.path.empty() ? op_name(node.op) : node.path,
                 "an operation that " + device.name() + " has",
                 fmt::format("{} of {:.1f} MB", ggml_op_desc(made), 1e-6 * static_cast<double>(ggml_nbytes(made))),
                 "use --device cpu"};
  }
  return {};
}

}  // namespace

Result<std::unique_ptr<Program>> GgmlProgram::make(const Graph& graph, GgmlDevice& device) {
  constexpr std::size_t kMaxPerNode = 16;  // most tensors of a node, without its concatenations
  std::unique_ptr<GgmlProgram> program(new GgmlProgram(device));
  std::size_t n = 64;
  for (const Node& node : graph.nodes()) n += kMaxPerNode + 2 * node.in.size();
  const std::size_t n_stage = graph.stages().size() + 1;
  VLA_TRY(program->context_, make_context(n, ggml_graph_overhead_custom(n, false)));
  VLA_TRY(program->constant_context_, make_context(graph.nodes().size() + 1));
  ggml_context* c = program->context_.get();
  program->graph_ = ggml_new_graph_custom(c, n, false);

  Translator translate(c, program->constant_context_.get(), device);
  const std::vector<bool> needed = graph.needed();
  std::vector<std::pair<ggml_tensor*, const Node*>> constants;
  std::vector<int> phase_end;          // in ggml nodes
  std::vector<std::size_t> stage_end;  // in phases
  program->work_.resize(n_stage);
  for (const Node& node : graph.nodes()) {
    while (stage_end.size() < graph.stages().size() &&
           static_cast<std::size_t>(node.id) >= graph.stages()[stage_end.size()].n_node)
      stage_end.push_back(phase_end.size());
    ggml_tensor* made = needed[static_cast<std::size_t>(node.id)] ? translate(node) : nullptr;
    translate.keep(made);
    if (made == nullptr) continue;
    if (node.as<op::Constant>() != nullptr) constants.emplace_back(made, &node);
    if (node.tapped) {  // a view's memory may be overwritten later in the run: keep a copy
      if (made->view_src != nullptr || !ggml_is_contiguous(made) || is_leaf(node)) made = ggml_cont(c, made);
      ggml_set_output(made);
      program->taps_.push_back({node.path, node.shape});
      program->tap_tensors_.push_back(made);
    }
    if (is_leaf(node) && !node.tapped) continue;
    const int n_before = ggml_graph_n_nodes(program->graph_);
    ggml_build_forward_expand(program->graph_, made);
    VLA_CHECK(check_supported(device, program->graph_, n_before, node));
    program->work_[stage_end.size()] += work_of(node);
    phase_end.push_back(ggml_graph_n_nodes(program->graph_));
    lower::MatrixReads::value_type& reads = program->reads_.emplace_back();
    if (const auto* linear = node.as<op::Linear>()) reads.push_back({linear->weight});
  }
  while (stage_end.size() < n_stage) stage_end.push_back(phase_end.size());
  for (const Graph::Stage& stage : graph.stages()) program->stages_.push_back({stage.name, {}});

  VLA_TRY(const std::size_t n_constant,
          device.memory().place(program->constant_context_.get(), "constants", &program->constant_memory_));
  for (const auto& [tensor, node] : constants) {
    if (device.memory().is_dry()) break;
    VLA_CHECK(device.guarded([&, to = tensor, from = node] {
      std::visit([to](const auto& values) { ggml_backend_tensor_set(to, values.data(), 0, values.size() * 4); },
                 from->as<op::Constant>()->values);
    }));
  }
  VLA_TRY(program->places_, device.place(program->graph_));
  VLA_CHECK(program->cut(phase_end, stage_end));
  for (int i = 0; i < ggml_graph_n_nodes(program->graph_); ++i) {
    const ggml_tensor* node = ggml_graph_node(program->graph_, i);
    program->text_ += fmt::format("{:>4} {:<12} [{}, {}, {}, {}]\n", i, ggml_op_desc(node), node->ne[0], node->ne[1],
                                  node->ne[2], node->ne[3]);
  }
  program->size_ = n_constant + (device.is_host() ? ggml_used_mem(c) : 0);
  return std::unique_ptr<Program>(std::move(program));
}

/// Cuts the graph where a stage ends and where groups of streamed matrices must be loaded.
Status GgmlProgram::cut(const std::vector<int>& phase_end, const std::vector<std::size_t>& stage_end) {
  VLA_TRY(const std::vector<lower::Groups> groups, lower::find_groups(reads_, device_.groups()));
  std::size_t begin = 0;
  int first = 0;  // index of a ggml node
  for (const std::size_t end : stage_end) {
    std::vector<Part>& parts = parts_.emplace_back();
    for (const lower::Segment& segment : lower::cut_phases(std::span(groups).subspan(begin, end - begin), begin)) {
      const int last = phase_end[segment.end - 1];
      const auto size = static_cast<std::size_t>(last - first) + 1;
      Part& part = parts.emplace_back(Part{segment.groups, {}, nullptr});
      VLA_TRY(part.context, make_context(0, ggml_graph_overhead_custom(size, false)));
      part.graph = ggml_new_graph_custom(part.context.get(), size, false);
      for (; first < last; ++first) ggml_graph_add_node(part.graph, ggml_graph_node(graph_, first));
    }
    begin = end;
  }
  const bool is_whole = parts_.size() == 1 && parts_.front().size() == 1;
  if (is_whole) parts_.front().front().graph = graph_;  // the full graph records what a backend may fuse
  return {};
}

Status GgmlProgram::run() {
  VLA_CHECK(device_.failure());
  for (std::size_t i = 0; i < parts_.size(); ++i) {
    for (const Part& part : parts_[i]) {
      if (part.groups.any()) VLA_CHECK(device_.bring(part.groups));
      VLA_CHECK(device_.launch(part.graph));
    }
    VLA_CHECK(device_.wait());
    if (i < stages_.size()) stages_[i].done = std::chrono::steady_clock::now();
  }
  return {};
}

std::vector<float> GgmlProgram::tap(std::size_t i) const {
  Slot slot;
  slot.place = tap_tensors_[i];
  std::vector<float> values(static_cast<std::size_t>(ggml_nelements(tap_tensors_[i])));
  device_.get(slot, values.data(), values.size() * sizeof(float));
  return values;
}

}  // namespace vla
