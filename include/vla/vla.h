/* SPDX-FileCopyrightText: The vla.cpp authors */
/* SPDX-License-Identifier: Apache-2.0 */
/*
 * The C interface of vla.cpp: one observation in, one action chunk out. C99 and C++. The guide is docs/c_api.md.
 *
 *   vla_policy* policy;
 *   vla_chunk* chunk;
 *   if (vla_open("policy.gguf", NULL, &policy) != VLA_OK) return fail(vla_last_error(NULL));
 *   if (vla_act(policy, &observation, &chunk) != VLA_OK) return fail(vla_last_error(policy));
 *   use(vla_chunk_actions(chunk), vla_chunk_horizon(chunk), vla_chunk_d_action(chunk));
 *   vla_chunk_close(chunk);
 *   vla_policy_close(policy);
 *
 * Ownership. The caller closes what a function returns through `out`. A function reads its arguments during the call
 * and keeps no pointer to them. A description and its strings live as long as their policy. The numbers and strings of
 * a chunk live as long as the chunk, which may outlive its policy.
 *
 * Threads. Every function may be called from any thread. Calls of vla_act with one policy run one after the other;
 * different policies run at the same time. No thread may use a policy or chunk during or after the call that closes it.
 *
 * Errors. No function throws, and none guesses: a bad argument gives a status and an error that says where it is, what
 * was expected and what was found.
 *
 * Versions. New members are added at the end of a struct. The caller sets struct_size to the size that it was compiled
 * with, so that it works with every later library of the same VLA_ABI_VERSION. Bytes beyond the struct that a library
 * knows must be zero.
 */
#ifndef VLA_VLA_H_
#define VLA_VLA_H_

#include <stddef.h>
#include <stdint.h>

#if defined(__GNUC__)
#define VLA_API __attribute__((visibility("default")))
#else
#define VLA_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Changes when programs must be compiled again. The library's file name contains it too. */
#define VLA_ABI_VERSION 1

/* The VLA_ABI_VERSION that the library was built with, for programs that load the library with dlopen. */
VLA_API uint32_t vla_abi_version(void);
/* The library's version, "0.1.0". */
VLA_API const char* vla_version(void);

/* The result of a call; the numbers are the exit codes of the program `vla`. */
typedef int32_t vla_status;
enum {
  VLA_OK = 0,
  VLA_INTERNAL = 1,        /* a fault of the library: please report it */
  VLA_USAGE = 2,           /* an argument that is wrong for every bundle */
  VLA_BAD_BUNDLE = 3,      /* the file is damaged or does not fit this library */
  VLA_BAD_OBSERVATION = 4, /* a view, state, text or noise that the policy does not accept */
  VLA_BAD_ACTION = 5,      /* the network computed a number that is not finite */
  VLA_UNSUPPORTED = 6,     /* valid, but not supported by this library */
  VLA_OUT_OF_MEMORY = 7,
  VLA_DEVICE = 8,
  VLA_IO = 9 /* a file cannot be read */
};

typedef struct vla_policy vla_policy; /* a loaded bundle */
typedef struct vla_chunk vla_chunk;   /* a policy's answer to one observation */

/* The strings are never NULL; an unused one is empty. */
typedef struct vla_error {
  size_t struct_size;
  vla_status code;
  const char* code_name; /* "bad_observation", ...; "ok" when nothing failed */
  const char* where;     /* a file, key, feature or argument */
  const char* expected;
  const char* found;
  const char* hint;    /* what to do next, if known */
  const char* message; /* all of the above in one line */
} vla_error;

/* The error of this thread's last failed call, if that call was with `policy`; else an error with the code VLA_OK. Pass
 * NULL for a call without a policy, such as vla_open. Never NULL. Valid until this thread's next failed call, or until
 * the thread ends. */
VLA_API const vla_error* vla_last_error(const vla_policy* policy);

typedef struct vla_options {
  size_t struct_size;
  int32_t n_thread;    /* CPU threads, at most 512; 0: every core that the process may use */
  const char* kernels; /* On the CPU: "ggml", "portable", "neon", "neon_bf16", "avx2", "avx512", "avx512_bf16" or "amx";
                          "float32": the best that does not round to bf16; "bf16": the best that does, with large
                          matrices rounded to bf16; "int8" or "int4": the best, with large matrices quantized, faster
                          and less exact. NULL: the best for the bundle's dtype, which rounds to bf16 if the bundle is
                          in bf16 and the machine supports it.
                          Vulkan: NULL, "ggml" and "float32", which are the same, or "bf16". CUDA: NULL: matrices as
                          they are stored; "float32", "bf16", "int8" or "int4": large matrices converted; "ggml" */
  int32_t strict_state; /* 1: a state far outside the range of the training data is refused with VLA_BAD_OBSERVATION;
                           0: it is answered, and the chunk has a note */
  const char* device;   /* "cpu", "vulkan", "vulkan:1", "cuda", ...; NULL: "cpu". There is no fallback: an absent device
                           fails with VLA_DEVICE, and `expected` lists the devices present */
  const char* embodiment; /* for a bundle for several robots: tag of the robot to load; NULL: all robots. A tag that
                             the bundle does not have fails with VLA_USAGE, and `expected` lists the tags */
  uint64_t memory;        /* limit in bytes of the process's memory, or on a GPU of the policy's GPU memory; 0: no
                             limit. Matrices that do not fit stay in the file and are read in every act; actions are
                             the same to the bit. A limit that is too low fails with VLA_OUT_OF_MEMORY, and `expected`
                             says how many bytes suffice */
} vla_options;
#define VLA_OPTIONS_INIT \
  { sizeof(vla_options), 0, NULL, 0, NULL, NULL, 0 }

/* Opens, checks and loads a bundle. `options` may be NULL, which means VLA_OPTIONS_INIT. On failure *out is NULL. */
VLA_API vla_status vla_open(const char* path, const vla_options* options, vla_policy** out);
/* Frees a policy; NULL is allowed. */
VLA_API void vla_policy_close(vla_policy* policy);

/* A camera of the policy. */
typedef struct vla_view_info {
  size_t struct_size;
  const char* name;      /* in full: "observation.images.top"; an observation may use the last part, "top", too */
  const char* alias;     /* a second name, or empty */
  int32_t optional;      /* 1: leaving the view out of an observation declares it absent */
  int32_t width, height; /* pixels of the network's input; frames of any size are fitted into it */
} vla_view_info;

/* A state vector of the policy. */
typedef struct vla_state_info {
  size_t struct_size;
  const char* name;                /* in full: "observation.state" */
  size_t width;                    /* number of values */
  const char* const* number_names; /* one per number */
  const char* const* units;        /* one per number, empty where the bundle does not state it */
} vla_state_info;

/* A policy's inputs and outputs. */
typedef struct vla_description vla_description;
struct vla_description {
  size_t struct_size;

  size_t n_view, min_views;          /* at least min_views of the views must be present in an observation */
  const vla_view_info* const* views; /* in the order in which the network sees them */
  size_t n_state;
  const vla_state_info* const* states;
  size_t max_text_tokens; /* a longer instruction is truncated, and the chunk has a note; 0: the policy reads no text */

  size_t horizon, d_action;        /* a chunk has `horizon` rows of d_action numbers */
  const char* const* action_names; /* d_action names */
  const char* const* action_units; /* d_action units, empty where the bundle does not state them */
  double rate_hz;                  /* rows per second; 0 where the bundle does not state it */
  size_t d_noise;                  /* noise has `noise_rows` rows (see below) of d_noise numbers */
  const char* noise;               /* the distribution of noise drawn from a seed: "normal" or "uniform" */

  const char* bundle_path;
  const char* arch;      /* "smolvla" */
  const char* checksum;  /* "xxh3:..." */
  const char* source;    /* the checkpoint that was converted into the bundle */
  const char* revision;  /* the checkpoint's revision, or empty */
  const char* converter; /* program that converted it, and the program's version */
  const char* dtype;     /* how matrices are stored: "f32", "bf16", "f16", "int8" or "int4" */
  const char* precision; /* of the large matrix products: "f32", "bf16" with sums in float32, or "int8" */
  const char* kernels;   /* implementation of the large matrix products: "ggml", "portable", "neon", "avx2", ... */
  const char* device;    /* "cpu, 8 threads", or "vulkan:0, " and the device's name from its driver */
  uint64_t memory_weights, memory_plan, memory_working; /* bytes */

  size_t noise_rows; /* rows of noise: `horizon`, or more if the network computes rows that the robot does not get, or
                        if solver steps draw noise: first the rows of the start, then as many rows for each such step */
  const char* real_time_chunking; /* how the policy uses an observation's leftover: "guided" or "inpainted"; empty: an
                                     observation must have none */
  const char* embodiment;         /* tag of the robot; empty where the bundle is for one unnamed robot */
  /* One description per robot, if the policy has several. Views, states, actions, horizon, noise and
   * real_time_chunking are then set only in those; in this description they are 0 or empty. */
  size_t n_embodiment;
  const vla_description* const* embodiments;
  size_t n_action_steps; /* rows of a chunk that the checkpoint executes before the next observation; 0 where the bundle
                            does not state it */
};

/* NULL only when `policy` is NULL. */
VLA_API const vla_description* vla_describe(const vla_policy* policy);

enum {
  VLA_IMAGE_ABSENT = 1, /* the observation has no frame of this view; `data` is NULL and `size` 0 */
  VLA_IMAGE_RGB8 = 2,   /* rows from top to bottom, red green blue, 8 bits each */
  VLA_IMAGE_FILE = 3    /* the bytes of a JPEG, PNG or NumPy file, recognized by their content */
};

typedef struct vla_view {
  size_t struct_size;
  const char* name;
  uint32_t kind;         /* VLA_IMAGE_...; there is no default */
  int32_t width, height; /* of RGB8, in pixels; else 0 */
  size_t stride;         /* of RGB8: bytes from row to row; 0: rows follow each other without a gap; else 0 */
  const void* data;
  size_t size; /* bytes; of RGB8 stride * height, with or without the padding after the last pixel */
} vla_view;
#define VLA_VIEW_INIT \
  { sizeof(vla_view), NULL, 0, 0, 0, 0, NULL, 0 }

typedef struct vla_state {
  size_t struct_size;
  const char* name;    /* NULL: the only state of the policy */
  const float* values; /* in the units of the robot */
  size_t n_value;
} vla_state;
#define VLA_STATE_INIT \
  { sizeof(vla_state), NULL, NULL, 0 }

/* An observation. Exactly one of noise and seed must be given. */
typedef struct vla_observation {
  size_t struct_size;
  const vla_view* views; /* an array */
  size_t n_view;
  const vla_state* states; /* an array */
  size_t n_state;
  const char* text;   /* the instruction, UTF-8, which may be empty; a NUL at the end is not needed and not counted.
                         NULL: no instruction, for a policy that reads none (max_text_tokens 0) */
  size_t text_size;   /* bytes */
  const float* noise; /* the solver's noise, (noise_rows, d_noise) row by row, or NULL */
  size_t n_noise;     /* noise_rows * d_noise */
  uint32_t has_seed;  /* 1: the noise is drawn from `seed`, the same bytes on every machine */
  uint64_t seed;
  /* Real-time chunking: the next chunk continues rows of the previous chunk that are not executed yet. NULL: none. */
  const float* leftover;  /* the last rows of the previous chunk's vla_chunk_normalized */
  size_t n_leftover;      /* rows * d_action */
  int32_t leftover_delay; /* how many of these rows will have been executed when the next chunk arrives */
  const char* schedule;   /* only for a "guided" policy: how the weight of the rows after the delay falls, "zeros",
                             "ones", "linear" or "exp" */
  double max_guidance;    /* only for a "guided" policy: the largest weight of the guidance, above 0 */
  const char* embodiment; /* tag of the observed robot; NULL where the policy has one robot */
} vla_observation;
#define VLA_OBSERVATION_INIT \
  { sizeof(vla_observation), NULL, 0, NULL, 0, NULL, 0, NULL, 0, 0, 0, NULL, 0, 0, NULL, 0, NULL }

/* Answers one observation. On failure *out is NULL, and the policy can still answer further observations. */
VLA_API vla_status vla_act(vla_policy* policy, const vla_observation* observation, vla_chunk** out);
/* Frees a chunk; NULL is allowed. */
VLA_API void vla_chunk_close(vla_chunk* chunk);

/* The actions, (horizon, d_action) row by row, in the units of the robot; all are finite. For a NULL chunk every
 * vla_chunk_ function below returns NULL or 0, as this one does. */
VLA_API const float* vla_chunk_actions(const vla_chunk* chunk);
/* The network's output before unnormalization, (horizon, d_action) row by row; the leftover of the next observation is
 * taken from it. */
VLA_API const float* vla_chunk_normalized(const vla_chunk* chunk);
VLA_API size_t vla_chunk_horizon(const vla_chunk* chunk);
VLA_API size_t vla_chunk_d_action(const vla_chunk* chunk);
/* Warnings about this answer, e.g. that the instruction was truncated; a NULL note beyond the last. */
VLA_API size_t vla_chunk_n_note(const vla_chunk* chunk);
VLA_API const char* vla_chunk_note(const vla_chunk* chunk, size_t i);
/* Milliseconds per stage, in the order in which the stages ran; name NULL and time 0 beyond the last. */
VLA_API size_t vla_chunk_n_stage(const vla_chunk* chunk);
VLA_API const char* vla_chunk_stage_name(const vla_chunk* chunk, size_t i);
VLA_API double vla_chunk_stage_ms(const vla_chunk* chunk, size_t i);
/* Milliseconds that vla_act waited for other calls with the same policy. */
VLA_API double vla_chunk_queue_ms(const vla_chunk* chunk);

#ifdef __cplusplus
}
#endif

#endif /* VLA_VLA_H_ */
