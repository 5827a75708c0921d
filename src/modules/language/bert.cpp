// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "modules/language/bert.h"

#include <fmt/format.h>

namespace vla {

Bert::Bert(const Scope& s) : encoder_(s), sentence_((s / "sentence").vector("weight", encoder_.d_model())) {}

Status Bert::check(int n_text) const {
  if (n_text <= encoder_.n_position()) return {};
  return Error{Code::bad_bundle, "processor.recipe.text",
               fmt::format("at most {} tokens (lm.n_position)", encoder_.n_position()), std::to_string(n_text)};
}

}  // namespace vla
