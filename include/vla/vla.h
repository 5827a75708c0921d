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
 * Ownership. What a function returns through `out` is the caller's to close. What is passed in is read during the call
 * and not kept. A description and its strings live as long as their policy; numbers and strings of a chunk as long as
 * the chunk, which may outlive its policy.
 *
 * Threads. Every function may be called from any thread. Calls of vla_act with one policy are done one after the other;
 * different policies run at the same time. Nobody may use a policy or chunk while or after it is closed.
 *
 * Errors. Nothing is thrown and nothing is guessed: a bad argument is a status and an error that says where it was,
 * what was expected and what was found.
 *
 * Versions. Structs grow at their end. The caller states the size that it was compiled with, so that it works with
 * every later library of the same VLA_ABI_VERSION; bytes that a library does not know must be zero.
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

/* Changes when programs must be compiled again; the library's file name carries it too. */
#define VLA_ABI_VERSION 1

/* The VLA_ABI_VERSION that the library was built with: for programs that load it with dlopen. */
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
  VLA_BAD_OBSERVATION = 4, /* a view, state, text or noise that the bundle does not take */
  VLA_BAD_ACTION = 5,      /* the network computed a number that is not finite */
  VLA_UNSUPPORTED = 6,     /* sound, but not known to this library */
  VLA_OUT_OF_MEMORY = 7,
  VLA_DEVICE = 8,
  VLA_IO = 9 /* a file cannot be read */
};

typedef struct vla_policy vla_policy; /* a loaded bundle */
typedef struct vla_chunk vla_chunk;   /* what a policy answered to one observation */

/* The strings are never NULL; they are empty where there is nothing to say. */
typedef struct vla_error {
  size_t struct_size;
  vla_status code;
  const char* code_name; /* "bad_observation", ...; "ok" when nothing failed */
  const char* where;     /* a file, key, feature or argument */
  const char* expected;
  const char* found;
  const char* hint;    /* the next move, if there is one */
  const char* message; /* all of the above in one line */
} vla_error;

/* Why the last call of this thread that failed with `policy` failed; pass NULL for a call that had no policy, as
 * vla_open. Never NULL. Valid until the next call of this thread that fails, or until the thread ends. */
VLA_API const vla_error* vla_last_error(const vla_policy* policy);

typedef struct vla_options {
  size_t struct_size;
  int32_t n_thread;     /* CPU threads, at most 512; 0: every core that the process may use */
  const char* kernels;  /* "ggml", "portable", "neon", "neon_bf16", "avx2", "avx512", "avx512_bf16", "amx", or
                           "float32": the best that does not round to bf16, or "bf16": the best that does, with large
                           matrices rounded to it, or "int8": the best, with large matrices quantized, faster and less
                           exact.
                           NULL: on the CPU the best for the bundle's dtype, which rounds to bf16 if the bundle and the
                           machine have it. Other devices take "float32", as NULL does, and "bf16" */
  int32_t strict_state; /* 1: an observation whose state is far beyond what the policy has seen is refused with
                           VLA_BAD_OBSERVATION; 0: it is answered with a note */
  const char* device;   /* "cpu", "vulkan", "vulkan:1", "cuda", ...; NULL: "cpu". There is no fallback: an absent device
                           fails with VLA_DEVICE, and `expected` lists what is there */
  const char* embodiment; /* of a bundle for several robots: tag of the one that is loaded; NULL: all of them. A tag
                             that the bundle does not have fails with VLA_USAGE, and `expected` lists them */
  uint64_t memory;        /* bytes that the process may take, or on a GPU the policy of its memory; 0: no limit.
                             Matrices that do not fit stay in the file and are read in every act; actions are the same
                             to the bit. Too few fail with VLA_OUT_OF_MEMORY, and `expected` tells how many would do */
} vla_options;
#define VLA_OPTIONS_INIT \
  { sizeof(vla_options), 0, NULL, 0, NULL, NULL, 0 }

/* Opens, checks and loads a bundle. `options` may be NULL: then they are as VLA_OPTIONS_INIT has them. On failure *out
 * is NULL. */
VLA_API vla_status vla_open(const char* path, const vla_options* options, vla_policy** out);
/* Frees a policy; NULL is allowed. */
VLA_API void vla_policy_close(vla_policy* policy);

/* A camera of the policy. */
typedef struct vla_view_info {
  size_t struct_size;
  const char* name;      /* in full: "observation.images.top"; the last part, "top", is understood too */
  const char* alias;     /* a second name, or empty */
  int32_t optional;      /* 1: leaving it out of an observation declares it absent */
  int32_t width, height; /* pixels of the network; frames of any size are fitted into it */
} vla_view_info;

/* A state vector of the policy. */
typedef struct vla_state_info {
  size_t struct_size;
  const char* name;                /* in full: "observation.state" */
  size_t width;                    /* how many values */
  const char* const* number_names; /* one per number */
  const char* const* units;        /* one per number, empty where the bundle does not state it */
} vla_state_info;

/* What a policy takes and gives. */
typedef struct vla_description vla_description;
struct vla_description {
  size_t struct_size;

  size_t n_view, min_views;          /* at least min_views of the views must be present in an observation */
  const vla_view_info* const* views; /* in the order in which the network sees them */
  size_t n_state;
  const vla_state_info* const* states;
  size_t max_text_tokens; /* longer instructions are truncated, which a note of the chunk says; 0: none is read */

  size_t horizon, d_action;        /* a chunk has `horizon` rows of d_action numbers */
  const char* const* action_names; /* d_action of each */
  const char* const* action_units; /* empty where the bundle does not state it */
  double rate_hz;                  /* rows a second; 0 where the bundle does not state it */
  size_t d_noise;                  /* noise has `noise_rows` rows, see below, of d_noise numbers */
  const char* noise;               /* how a seed draws them: "normal" or "uniform" */

  const char* bundle_path;
  const char* arch;      /* "smolvla" */
  const char* checksum;  /* "xxh3:..." */
  const char* source;    /* the checkpoint that the bundle was made of */
  const char* revision;  /* its revision, or empty */
  const char* converter; /* the program that made the bundle, and its version */
  const char* dtype;     /* how matrices are stored: "f32", "bf16" or "f16" */
  const char* precision; /* of the large products: "f32", "bf16" with sums in float32, or "int8" */
  const char* kernels;   /* what computes them: "ggml", "portable", "neon", "avx2", ... */
  const char* device;    /* "cpu, 8 threads", "vulkan:0, " and the name that its driver gives it */
  uint64_t memory_weights, memory_plan, memory_working; /* bytes */

  size_t noise_rows; /* `horizon`, or more where the robot gets some rows only of what the network computes, or where
                        steps of the solver draw: the start's rows, then as many of each such step */
  const char* real_time_chunking; /* what the leftover of an observation does: "guided", "inpainted", or empty where
                                     there must be none */
  const char* embodiment;         /* tag of the robot; empty where the bundle is for one, which it does not name */
  /* Of a policy with several robots: a description of each, with its tag. Views, states, actions, horizon, noise and
   * leftover are then theirs alone: here they are 0 and empty. */
  size_t n_embodiment;
  const vla_description* const* embodiments;
  size_t n_action_steps; /* rows of a chunk that the checkpoint executes before it looks again; 0 where the bundle does
                            not state it */
};

/* NULL only when `policy` is NULL. */
VLA_API const vla_description* vla_describe(const vla_policy* policy);

enum {
  VLA_IMAGE_ABSENT = 1, /* there is no such frame now; `data` is NULL */
  VLA_IMAGE_RGB8 = 2,   /* rows from top to bottom, red green blue, 8 bits each */
  VLA_IMAGE_FILE = 3    /* the bytes of a JPEG, PNG or NumPy file, recognized by their content */
};

typedef struct vla_view {
  size_t struct_size;
  const char* name;
  uint32_t kind;         /* VLA_IMAGE_...; there is no default */
  int32_t width, height; /* of RGB8, in pixels; else 0 */
  size_t stride;         /* of RGB8: bytes from row to row; 0: rows follow each other without a gap */
  const void* data;
  size_t size; /* bytes; of RGB8 stride * height, or without what follows the last pixel */
} vla_view;
#define VLA_VIEW_INIT \
  { sizeof(vla_view), NULL, 0, 0, 0, 0, NULL, 0 }

typedef struct vla_state {
  size_t struct_size;
  const char* name;    /* NULL: the only state that the bundle has */
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
                         NULL: none is given, as for a policy that reads none, with max_text_tokens 0 */
  size_t text_size;   /* bytes */
  const float* noise; /* what the solver draws, (noise_rows, d_noise) row by row, or NULL */
  size_t n_noise;     /* noise_rows * d_noise */
  uint32_t has_seed;  /* 1: the noise is drawn from `seed`, the same bytes on every machine */
  uint64_t seed;
  /* Real-time chunking: the next chunk goes on from rows of the chunk before that are not executed yet. NULL: none. */
  const float* leftover;  /* the last rows of its vla_chunk_normalized */
  size_t n_leftover;      /* rows * d_action */
  int32_t leftover_delay; /* how many of these rows will have been executed when the next chunk is there */
  const char* schedule;   /* of a "guided" policy, and only there: how the weight of the rows after the delay falls,
                             "zeros", "ones", "linear" or "exp" */
  double max_guidance;    /* the same: the largest weight of the guidance, above 0 */
  const char* embodiment; /* tag of the robot that the observation is of; NULL where the policy has one */
} vla_observation;
#define VLA_OBSERVATION_INIT \
  { sizeof(vla_observation), NULL, 0, NULL, 0, NULL, 0, NULL, 0, 0, 0, NULL, 0, 0, NULL, 0, NULL }

/* Answers one observation. On failure *out is NULL, and the policy goes on to answer the next. */
VLA_API vla_status vla_act(vla_policy* policy, const vla_observation* observation, vla_chunk** out);
/* Frees a chunk; NULL is allowed. */
VLA_API void vla_chunk_close(vla_chunk* chunk);

/* The actions, (horizon, d_action) row by row, in the units of the robot; all of them are finite. For a chunk of NULL
 * this and what follows is NULL or 0. */
VLA_API const float* vla_chunk_actions(const vla_chunk* chunk);
/* The network's output before unnormalization: what the leftover of an observation takes. */
VLA_API const float* vla_chunk_normalized(const vla_chunk* chunk);
VLA_API size_t vla_chunk_horizon(const vla_chunk* chunk);
VLA_API size_t vla_chunk_d_action(const vla_chunk* chunk);
/* Warnings about this answer, e.g. that the instruction was truncated. NULL beyond the last. */
VLA_API size_t vla_chunk_n_note(const vla_chunk* chunk);
VLA_API const char* vla_chunk_note(const vla_chunk* chunk, size_t i);
/* Milliseconds per stage, in the order in which the stages ran; NULL and 0 beyond the last. */
VLA_API size_t vla_chunk_n_stage(const vla_chunk* chunk);
VLA_API const char* vla_chunk_stage_name(const vla_chunk* chunk, size_t i);
VLA_API double vla_chunk_stage_ms(const vla_chunk* chunk, size_t i);
/* Milliseconds that the call waited for other calls with the same policy. */
VLA_API double vla_chunk_queue_ms(const vla_chunk* chunk);

#ifdef __cplusplus
}
#endif

#endif /* VLA_VLA_H_ */
