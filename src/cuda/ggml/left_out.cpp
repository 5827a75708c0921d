// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Stand-ins for the functions of ggml's CUDA backend that the build leaves out, because no graph of ours has their
// operations (src/CMakeLists.txt lists the sources that are built). The linker reports a missing stand-in. A graph that
// calls one aborts the process with a message that names the function.
#include <ggml-backend.h>
#include <ggml.h>

#include <cstddef>
#include <cstdint>

struct ggml_backend_cuda_context;
struct ggml_cuda_ar_pipeline;
struct ggml_cuda_gated_delta_net_fused_cache {};  // passed by value and never read
struct ggml_cuda_mm_fusion_args_host;
struct ggml_cuda_topk_moe_args;

// Selectors of alternative kernels: none is ever selected. The first one's kernel would compute products of few columns
// in TF32.
bool ggml_cuda_should_use_mmf(ggml_type, int, int, const std::int64_t*, const std::size_t*, int, bool) { return false; }
bool ggml_cuda_should_use_mmq(ggml_type, int, std::int64_t, std::int64_t) { return false; }
bool ggml_cuda_should_use_mmvq(ggml_type, int, std::int64_t) { return false; }
bool ggml_cuda_op_mul_mat_use_fwht(const ggml_tensor*) { return false; }
bool ggml_cuda_should_use_topk_moe(const ggml_tensor*, const ggml_tensor*, const ggml_tensor*, const ggml_tensor*) {
  return false;
}
int get_mmvq_mmid_max_batch(ggml_type, int) { return 0; }
bool ggml_cuda_flash_attn_ext_supported(int, const ggml_tensor*) { return false; }
bool ggml_cuda_lightning_indexer_supported(int, const ggml_tensor*) { return false; }
std::size_t ggml_cuda_flash_attn_ext_get_alloc_size(int, const ggml_tensor* dst) { return ggml_nbytes(dst); }

#define LEFT_OUT_AS(result, name, ...) \
  result name(__VA_ARGS__) { GGML_ABORT("libvla-cuda.so was built without " #name); }
using Context = ggml_backend_cuda_context&;
using In = const ggml_tensor*;
using Out = ggml_tensor*;
LEFT_OUT_AS(void, ggml_cuda_mul_mat_f, Context, In, In, In, Out)
LEFT_OUT_AS(void, ggml_cuda_mul_mat_q, Context, In, In, In, Out)
LEFT_OUT_AS(void, ggml_cuda_mul_mat_vec_q, Context, In, In, In, Out, const ggml_cuda_mm_fusion_args_host*)
LEFT_OUT_AS(bool, ggml_cuda_op_fwht, Context, In, Out)
LEFT_OUT_AS(void, ggml_cuda_op_topk_moe, Context, In, Out, Out, In, In, In, const ggml_cuda_topk_moe_args&)
LEFT_OUT_AS(void, ggml_cuda_op_gated_delta_net_fused_cache, Context, Out, ggml_cuda_gated_delta_net_fused_cache)
LEFT_OUT_AS(void, ggml_cuda_op_rope_fused, Context, Out, Out)
LEFT_OUT_AS(void, ggml_cuda_op_rms_norm_mul_rope_fused, Context, Out, Out, Out, Out)
LEFT_OUT_AS(void, ggml_cuda_op_snake_fused, Context, In, In, In, Out)
LEFT_OUT_AS(void, ggml_cuda_op_ssm_conv, Context, Out, Out, Out)
LEFT_OUT_AS(ggml_cuda_ar_pipeline*, ggml_cuda_ar_pipeline_init, const int*, std::size_t)
LEFT_OUT_AS(void, ggml_cuda_ar_pipeline_free, ggml_cuda_ar_pipeline*)
LEFT_OUT_AS(bool, ggml_cuda_ar_allreduce, ggml_cuda_ar_pipeline*, ggml_backend_t*, ggml_tensor**)

#define LEFT_OUT(name) LEFT_OUT_AS(void, name, Context, Out)
LEFT_OUT(ggml_cuda_flash_attn_ext)
LEFT_OUT(ggml_cuda_op_acc)
LEFT_OUT(ggml_cuda_op_add_id)
LEFT_OUT(ggml_cuda_op_arange)
LEFT_OUT(ggml_cuda_argmax)
LEFT_OUT(ggml_cuda_op_argsort)
LEFT_OUT(ggml_cuda_op_col2im_1d)
LEFT_OUT(ggml_cuda_op_conv_transpose_1d)
LEFT_OUT(ggml_cuda_op_conv2d_dw)
LEFT_OUT(ggml_cuda_conv_2d_transpose_p0)
LEFT_OUT(ggml_cuda_op_conv2d)
LEFT_OUT(ggml_cuda_op_conv3d)
LEFT_OUT(ggml_cuda_count_equal)
LEFT_OUT(ggml_cuda_cross_entropy_loss)
LEFT_OUT(ggml_cuda_cross_entropy_loss_back)
LEFT_OUT(ggml_cuda_op_cumsum)
LEFT_OUT(ggml_cuda_op_diag)
LEFT_OUT(ggml_cuda_op_diag_mask_inf)
LEFT_OUT(ggml_cuda_op_dsv4_hc_comb)
LEFT_OUT(ggml_cuda_op_dsv4_hc_pre)
LEFT_OUT(ggml_cuda_op_dsv4_hc_post)
LEFT_OUT(ggml_cuda_op_fill)
LEFT_OUT(ggml_cuda_op_gated_delta_net)
LEFT_OUT(ggml_cuda_op_gated_linear_attn)
LEFT_OUT(ggml_cuda_lightning_indexer)
LEFT_OUT(ggml_cuda_op_mean)
LEFT_OUT(ggml_cuda_opt_step_adamw)
LEFT_OUT(ggml_cuda_opt_step_sgd)
LEFT_OUT(ggml_cuda_out_prod)
LEFT_OUT(ggml_cuda_op_pad)
LEFT_OUT(ggml_cuda_op_pad_reflect_1d)
LEFT_OUT(ggml_cuda_op_pool2d)
LEFT_OUT(ggml_cuda_op_roll)
LEFT_OUT(ggml_cuda_op_rope)
LEFT_OUT(ggml_cuda_op_rope_back)
LEFT_OUT(ggml_cuda_op_set_rows)
LEFT_OUT(ggml_cuda_op_set)
LEFT_OUT(ggml_cuda_op_solve_tri)
LEFT_OUT(ggml_cuda_op_ssm_scan)
LEFT_OUT(ggml_cuda_op_sum)
LEFT_OUT(ggml_cuda_op_sum_rows)
LEFT_OUT(ggml_cuda_op_top_k)
LEFT_OUT(ggml_cuda_op_tri)
LEFT_OUT(ggml_cuda_op_timestep_embedding)
LEFT_OUT(ggml_cuda_op_upscale)
LEFT_OUT(ggml_cuda_op_rwkv_wkv6)
LEFT_OUT(ggml_cuda_op_rwkv_wkv7)
