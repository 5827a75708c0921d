// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// One observation in, one action chunk out, in C++17 over the C interface:
//
//   act policy.gguf "open the drawer" 0.1,0.2,0.3 1 camera1=top.png camera2=
//
// The arguments are those of examples/c/act.c. Here handles close themselves and a status becomes an exception.
#include <vla/vla.h>

#include <cstdio>
#include <fstream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

struct Close {
  void operator()(vla_policy* policy) const { vla_policy_close(policy); }
  void operator()(vla_chunk* chunk) const { vla_chunk_close(chunk); }
};
using Policy = std::unique_ptr<vla_policy, Close>;
using Chunk = std::unique_ptr<vla_chunk, Close>;

void check(vla_status status, const vla_policy* policy = nullptr) {
  if (status == VLA_OK) return;
  const vla_error* error = vla_last_error(policy);
  throw std::runtime_error(std::string(error->code_name) + ": " + error->message);
}

Policy open(const std::string& bundle) {
  vla_policy* policy = nullptr;
  check(vla_open(bundle.c_str(), nullptr, &policy));
  return Policy(policy);
}

Chunk act(const Policy& policy, const vla_observation& observation) {
  vla_chunk* chunk = nullptr;
  check(vla_act(policy.get(), &observation, &chunk), policy.get());
  return Chunk(chunk);
}

std::vector<float> read_state(const std::string& text) {
  std::vector<float> values;
  std::size_t used = 0;
  for (std::size_t at = 0; at <= text.size(); at += used + 1) {
    values.push_back(static_cast<float>(std::stod(text.substr(at), &used)));
    if (at + used < text.size() && text[at + used] != ',') throw std::runtime_error("state: not numbers: " + text);
  }
  return values;
}

/// A named camera image, or the declaration that there is none.
struct View {
  std::string name;
  std::vector<char> file;

  explicit View(const std::string& argument) : name(argument.substr(0, argument.find('='))) {
    if (name.size() + 1 >= argument.size()) return;
    const std::string path = argument.substr(name.size() + 1);
    std::ifstream stream(path, std::ios::binary);
    file.assign(std::istreambuf_iterator<char>(stream), {});
    if (file.empty()) throw std::runtime_error(path + ": cannot be read");
  }
  vla_view get() const {
    vla_view view = VLA_VIEW_INIT;
    view.name = name.c_str();
    view.kind = file.empty() ? VLA_IMAGE_ABSENT : VLA_IMAGE_FILE;
    view.data = file.empty() ? nullptr : file.data();
    view.size = file.size();
    return view;
  }
};

void run(const std::vector<std::string>& arguments) {
  if (arguments.size() < 5) throw std::runtime_error("usage: act BUNDLE TEXT STATE SEED NAME=FILE ...");
  const std::string& text = arguments[1];
  const std::vector<float> values = read_state(arguments[2]);
  const std::vector<View> files(arguments.begin() + 4, arguments.end());
  std::vector<vla_view> views;
  for (const View& file : files) views.push_back(file.get());
  vla_state state = VLA_STATE_INIT;
  state.values = values.data(), state.n_value = values.size();

  vla_observation observation = VLA_OBSERVATION_INIT;
  observation.text = text.data(), observation.text_size = text.size();
  observation.states = &state, observation.n_state = 1;
  observation.views = views.data(), observation.n_view = views.size();
  observation.has_seed = 1, observation.seed = std::stoull(arguments[3]);

  const Policy policy = open(arguments[0]);
  const vla_description& description = *vla_describe(policy.get());
  std::fprintf(stderr, "%s, %zu rows of %zu numbers\n", description.arch, description.horizon, description.d_action);
  const Chunk chunk = act(policy, observation);
  const float* action = vla_chunk_actions(chunk.get());
  for (std::size_t row = 0; row < description.horizon; ++row)
    for (std::size_t i = 0; i < description.d_action; ++i)
      std::printf("%.9g%c", static_cast<double>(*action++), i + 1 == description.d_action ? '\n' : ' ');
}

}  // namespace

int main(int argc, char** argv) {
  try {
    run({argv + 1, argv + argc});
    return 0;
  } catch (const std::exception& exception) {
    std::fprintf(stderr, "error: %s\n", exception.what());
    return 1;
  }
}
