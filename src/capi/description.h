// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/vla.h>

#include <deque>
#include <memory>

#include "engine/description.h"

namespace vla::capi {

/// The result of `vla_describe` and the memory that its pointers refer to. It must not be moved.
class Description {
 public:
  /// Describes one robot or several.
  explicit Description(const std::vector<vla::Description>& robots);
  Description(const Description&) = delete;
  Description& operator=(const Description&) = delete;

  const vla_description* get() const { return &description_; }

 private:
  using Texts = std::vector<const char*>;

  explicit Description(const vla::Description& d) { fill_common(d), fill_robot(d); }
  void fill_common(const vla::Description& d);
  void fill_robot(const vla::Description& d);
  const char* keep(const std::string& text) { return kept_.emplace_back(text).c_str(); }
  /// Names and units of elements as arrays of pointers.
  const char* const* keep_names(const std::vector<vla::Description::Number>& numbers);
  const char* const* keep_units(const std::vector<vla::Description::Number>& numbers);

  // Filled once, in the constructor; a deque keeps pointers to its elements valid while it grows.
  std::deque<std::string> kept_;
  std::deque<Texts> texts_;
  std::vector<vla_view_info> view_infos_;
  std::vector<vla_state_info> state_infos_;
  std::vector<const vla_view_info*> views_;
  std::vector<const vla_state_info*> states_;
  std::vector<std::unique_ptr<Description>> robots_;
  std::vector<const vla_description*> robot_pointers_;
  vla_description description_{};
};

}  // namespace vla::capi
