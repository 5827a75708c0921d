// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <utility>

#include "bundle/params.h"
#include "graph/graph.h"

namespace vla {

/// Calling a module gives its result the module's path, which makes it a tap; `Self` implements `forward`.
template <class Self>
class Module {
 public:
  template <class... Args>
  Tensor operator()(Graph& g, Args&&... args) const {
    return g.name(path_, static_cast<const Self*>(this)->forward(g, std::forward<Args>(args)...));
  }
  const std::string& path() const { return path_; }

 protected:
  explicit Module(const Scope& s) : path_(s.path()) {}

 private:
  std::string path_;
};

}  // namespace vla
