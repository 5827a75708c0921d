// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/vla.h>

#include <deque>

#include "engine/engine.h"

namespace vla::capi {

/// What `vla_describe` returns, with the memory that its pointers point into; therefore it stays where it was made.
class Description {
 public:
  explicit Description(const Engine& engine);
  Description(const Description&) = delete;
  Description& operator=(const Description&) = delete;

  const vla_description* get() const { return &description_; }

 private:
  /// Strings and the array of their pointers.
  struct Texts {
    std::vector<std::string> strings;
    std::vector<const char*> pointers;
    explicit Texts(std::vector<std::string> given);
  };

  void add_views(const Engine& engine);
  void add_states(const Engine& engine);
  const char* keep(std::string text);

  // Filled once, in the constructor; pointers into a deque stay valid while it grows.
  std::deque<std::string> kept_;
  std::vector<Texts> state_names_, state_units_;
  std::vector<vla_view_info> view_infos_;
  std::vector<vla_state_info> state_infos_;
  std::vector<const vla_view_info*> views_;
  std::vector<const vla_state_info*> states_;
  Texts action_names_, action_units_;
  vla_description description_{};
};

}  // namespace vla::capi
