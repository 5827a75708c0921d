/* SPDX-FileCopyrightText: The vla.cpp authors */
/* SPDX-License-Identifier: Apache-2.0 */
/*
 * One observation in, one action chunk out, in C99:
 *
 *   act policy.gguf "open the drawer" 0.1,0.2,0.3 1 camera1=top.png camera2=
 *
 * The arguments are the bundle, the instruction, the state, the seed of the noise, and a file per view (PNG or JPEG;
 * nothing after the = declares the view absent). Prints a line per control step, with digits enough for the same float.
 */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <vla/vla.h>

enum { MAX_VIEW = 16, MAX_STATE = 256 };

static int fail(const vla_policy* policy) {
  const vla_error* error = vla_last_error(policy);
  fprintf(stderr, "error: %s: %s\n", error->code_name, error->message);
  return error->code;
}

static int misused(const char* what) {
  fprintf(stderr, "error: usage: %s: act BUNDLE TEXT STATE SEED NAME=FILE ...\n", what);
  return VLA_USAGE;
}

/* "0.1,0.2" as floats; 0 where it is not a list of numbers. */
static size_t read_state(const char* text, float* values) {
  size_t n = 0;
  char* end;
  for (;; text = end + 1) {
    if (n == MAX_STATE) return 0;
    values[n++] = (float)strtod(text, &end);
    if (end == text || (*end != ',' && *end != '\0')) return 0;
    if (*end == '\0') return n;
  }
}

/* The bytes of a file, to be freed; NULL where it cannot be read. */
static void* read_file(const char* path, size_t* size) {
  FILE* file = fopen(path, "rb");
  long end = -1;
  void* data = NULL;
  if (file == NULL) return NULL;
  if (fseek(file, 0, SEEK_END) == 0 && (end = ftell(file)) > 0 && fseek(file, 0, SEEK_SET) == 0)
    data = malloc((size_t)end);
  if (data != NULL && fread(data, 1, (size_t)end, file) != (size_t)end) {
    free(data);
    data = NULL;
  }
  fclose(file);
  *size = (size_t)end;
  return data;
}

/* NAME=FILE as a view whose `data` is to be freed. Cuts the argument at its =. */
static int read_view(char* argument, vla_view* view) {
  const vla_view empty = VLA_VIEW_INIT;
  char* file = strchr(argument, '=');
  *view = empty;
  if (file == NULL) return misused(argument);
  *file++ = '\0';
  view->name = argument;
  view->kind = *file == '\0' ? VLA_IMAGE_ABSENT : VLA_IMAGE_FILE;
  if (view->kind == VLA_IMAGE_ABSENT) return VLA_OK;
  view->data = read_file(file, &view->size);
  if (view->data != NULL) return VLA_OK;
  fprintf(stderr, "error: io: %s: cannot be read\n", file);
  return VLA_IO;
}

static void print_chunk(const vla_chunk* chunk) {
  const size_t d_action = vla_chunk_d_action(chunk), count = vla_chunk_horizon(chunk) * d_action;
  const float* actions = vla_chunk_actions(chunk);
  size_t i;
  for (i = 0; i < vla_chunk_n_note(chunk); ++i) fprintf(stderr, "note: %s\n", vla_chunk_note(chunk, i));
  for (i = 0; i < count; ++i) printf("%.9g%c", (double)actions[i], (i + 1) % d_action == 0 ? '\n' : ' ');
}

static int act(const char* bundle, const vla_observation* observation) {
  vla_policy* policy = NULL;
  vla_chunk* chunk = NULL;
  int status;
  if (vla_open(bundle, NULL, &policy) != VLA_OK) return fail(NULL);
  status = vla_act(policy, observation, &chunk) == VLA_OK ? VLA_OK : fail(policy);
  if (status == VLA_OK) print_chunk(chunk);
  vla_chunk_close(chunk);
  vla_policy_close(policy);
  return status;
}

int main(int argc, char** argv) {
  vla_observation observation = VLA_OBSERVATION_INIT;
  vla_state state = VLA_STATE_INIT;
  vla_view views[MAX_VIEW];
  float values[MAX_STATE];
  char* end;
  size_t n_view = 0;
  int i, status = VLA_OK;

  if (argc < 6 || argc - 5 > MAX_VIEW) return misused("wrong number of arguments");
  observation.text = argv[2];
  observation.text_size = strlen(argv[2]);
  state.values = values;
  state.n_value = read_state(argv[3], values);
  if (state.n_value == 0) return misused("STATE");
  observation.states = &state;
  observation.n_state = 1;
  errno = 0;
  observation.has_seed = 1;
  observation.seed = strtoull(argv[4], &end, 10);
  if (end == argv[4] || *end != '\0' || *argv[4] == '-' || errno != 0) return misused("SEED");
  for (i = 5; i < argc && status == VLA_OK; ++i) status = read_view(argv[i], &views[n_view++]);
  observation.views = views;
  observation.n_view = n_view;

  if (status == VLA_OK) status = act(argv[1], &observation);
  while (n_view > 0) free((void*)views[--n_view].data);
  return status;
}
