// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "lower/lowering.h"

namespace vla::lower {
namespace {

/// Prints the type, shape and placement of a value.
std::string layout(const Lowering& l, ValueId id) {
  const Value& value = l.value(id);
  const Value::Placement placement = l.base(id).placement;
  const char* place = placement == Value::Placement::slot     ? "@slot"
                      : placement == Value::Placement::kept   ? "@kept"
                      : placement == Value::Placement::thread ? "@thread"
                                                              : "";
  if (value.node == nullptr && value.size > 0 && value.stride == Shape{1, 1, 1, 1})
    return fmt::format("panels{}", place);
  return fmt::format("{}{}{}{}", dtype_name(value.type), value.form, shape_text(value.shape), place);
}

}  // namespace

std::string path_of(const Node& node) { return node.path.empty() ? fmt::format("%{}", node.id) : node.path; }

std::string line_of(const Lowering& l, const Step& step, const std::string& kernel, const std::string& what,
                    const Work& work) {
  std::vector<std::string> results;
  for (const ValueId id : step.writes) results.push_back(layout(l, id));
  return fmt::format("{:>4} {:<11} {:>10.2f} {:>9.3f}  {}  {} -> {}", step.phase, kernel, 1e-6 * work.flop,
                     1e-6 * work.bytes, what, layout(l, step.reads[0]), fmt::join(results, ", "));
}

}  // namespace vla::lower
