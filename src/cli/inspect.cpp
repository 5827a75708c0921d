// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <map>

#include "cli/commands.h"
#include "cli/json.h"
#include "engine/engine.h"

namespace vla::cli {
namespace {

struct InspectOptions {
  std::string bundle, manifest;
  bool json = false;
};

std::string human_size(double bytes) {
  constexpr const char* kUnits[] = {"B", "kB", "MB", "GB", "TB"};
  int unit = 0;
  for (; bytes >= 1000 && unit < 4; ++unit) bytes /= 1000;
  return fmt::format("{:.{}f} {}", bytes, unit == 0 ? 0 : 1, kUnits[unit]);
}

/// What one module of the first two path levels weighs: `vision`, `lm`, `expert`, `action_in`, ...
struct ModuleSize {
  std::int64_t n_param = 0;
  std::int64_t stored = 0;  // bytes in the file
};

std::map<std::string, ModuleSize> module_sizes(const ParamList& params) {
  std::map<std::string, ModuleSize> sizes;
  for (const Param& param : params.params()) {
    ModuleSize& size = sizes[param.name.substr(0, param.name.find('.'))];
    size.n_param += param.count();
    if (param.source != nullptr) size.stored += static_cast<std::int64_t>(param.source->data.size());
  }
  return sizes;
}

Json shape_json(const Param& param) {  // as torch writes it, slowest dimension first
  return Json(std::vector<std::int64_t>(param.shape.rbegin(), param.shape.rend()));
}

Status print_manifest(const std::string& arch) {
  VLA_TRY(const PolicyEntry entry, find_policy(arch));
  const Keys keys = entry.published();
  ParamList list(keys, nullptr);
  const std::unique_ptr<Policy> policy = entry.make(list);
  VLA_CHECK(list.report(arch, {}));
  Json root;
  root["arch"] = arch;
  root["config"] = Json::object();
  for (const auto& [key, value] : keys.all())
    std::visit([&, &name = key](const auto& v) { root["config"][name] = v; }, value);
  root["parameters"] = Json::array();
  for (const Param& param : list.params()) {
    Json row;
    row["name"] = param.name;
    row["shape"] = shape_json(param);
    row["storage"] = storage_name(param.storage);
    root["parameters"].push_back(std::move(row));
  }
  fmt::print("{}\n", text_of(root, 2));
  return {};
}

/// Values of `stats.<feature>.*` beside the names of a feature's numbers.
struct StatsColumns {
  std::vector<std::string> names;
  std::vector<std::vector<float>> values;
};

StatsColumns read_stats(const Bundle& bundle, const std::string& feature) {
  StatsColumns columns;
  const std::string prefix = "stats." + feature + ".";
  for (const TensorInfo& tensor : bundle.tensors())
    if (tensor.name.starts_with(prefix))
      if (auto values = bundle.stats(tensor.name)) {
        columns.names.push_back(tensor.name.substr(prefix.size()));
        columns.values.push_back(*values);
      }
  return columns;
}

void print_numbers(const std::vector<std::string>& names, const std::vector<std::string>& units,
                   const StatsColumns& stats) {
  std::size_t width = 4;
  for (const std::string& name : names) width = std::max(width, name.size());
  fmt::print("    {:<{}}  {:<10}", "name", width, "unit");
  for (const std::string& column : stats.names) fmt::print("  {:>12}", column);
  fmt::print("\n");
  for (std::size_t i = 0; i < names.size(); ++i) {
    fmt::print("    {:<{}}  {:<10}", names[i], width, i < units.size() && !units[i].empty() ? units[i] : "unstated");
    for (const auto& column : stats.values) fmt::print("  {:>12.6g}", i < column.size() ? column[i] : 0.0f);
    fmt::print("\n");
  }
}

void print_features(const Engine& engine) {
  const Keys& keys = engine.bundle().keys();
  const auto views = *keys.strings("observation.views"), aliases = *keys.strings("observation.view_aliases");
  const Recipe& recipe = engine.processor().recipe();
  constexpr const char* kFits[] = {"letterboxed", "resized", "padded, scaled and cropped as the recipe says"};
  fmt::print("views        any size, {} to {} x {}; at least {} of {} must be present\n", kFits[recipe.fit.index()],
             recipe.width, recipe.height, engine.processor().min_views(), views.size());
  for (std::size_t i = 0; i < views.size(); ++i)
    fmt::print("    {}{}\n", views[i], aliases[i].empty() ? "" : fmt::format("  (also {})", aliases[i]));

  const auto states = *keys.strings("observation.states");
  const auto dims = engine.processor().state_dims();
  const auto names = *keys.strings("observation.state_names"), units = *keys.strings("observation.state_units");
  auto name = names.begin();
  auto unit = units.begin();
  for (std::size_t i = 0; i < states.size(); name += dims[i], unit += dims[i], ++i) {
    fmt::print("state        {}, {} numbers\n", states[i], dims[i]);
    print_numbers({name, name + dims[i]}, {unit, unit + dims[i]}, read_stats(engine.bundle(), states[i]));
  }
  const double rate = *keys.number("action.rate_hz", kRateHz);
  fmt::print("action       {} rows of {} numbers{}\n", engine.n_row(), keys.strings("action.names")->size(),
             rate > 0 ? fmt::format(", {:g} rows a second", rate) : ", control rate unstated");
  print_numbers(*keys.strings("action.names"), *keys.strings("action.units"), read_stats(engine.bundle(), "action"));
  fmt::print("instruction  at most {} tokens\n", engine.processor().recipe().max_tokens);
}

void print_human(const Engine& engine) {
  const Bundle& bundle = engine.bundle();
  const auto text = [&](const char* key) { return *bundle.keys().string(key); };
  fmt::print("bundle       {}\n", bundle.path());
  fmt::print("policy       {}, stored as {}, {}\n", text("vla.arch"), text("vla.dtype"),
             human_size(static_cast<double>(bundle.file_size())));
  fmt::print("source       {}{}, converted by {}\n", text("vla.source.name"),
             text("vla.source.revision").empty() ? "" : " at " + text("vla.source.revision"),
             text("vla.source.converter"));
  fmt::print("checksum     {}\n", text("vla.checksum"));
  print_features(engine);
  fmt::print("solver       {}, {} steps from {:g}, {} noise\n", text("solver.kind"), engine.solver().n_step,
             engine.solver().times.front(), engine.solver().noise);
  const Json recipe = Json::parse(text("processor.recipe"), nullptr, false);
  for (const auto& [list, ops] : recipe.items()) {
    fmt::print("recipe       {}\n", list);
    for (const Json& op : ops) fmt::print("    {}\n", text_of(op));
  }
  fmt::print("modules      {:<18}  {:>14}  {:>10}\n", "path", "parameters", "stored");
  std::int64_t n_param = 0;
  for (const auto& [path, size] : module_sizes(engine.params())) {
    fmt::print("             {:<18}  {:>14}  {:>10}\n", path, fmt::format("{}", size.n_param),
               human_size(static_cast<double>(size.stored)));
    n_param += size.n_param;
  }
  const MemoryUse memory = engine.memory();
  fmt::print("             {:<18}  {:>14}\n", "all", n_param);
  fmt::print("products     {}: {}\n", engine.linear_kernels(), engine.arithmetic());
  fmt::print("memory       {} in all: weights {}, inputs and cache {}, working memory {}\n",
             human_size(static_cast<double>(memory.total())), human_size(static_cast<double>(memory.weights)),
             human_size(static_cast<double>(memory.plan)), human_size(static_cast<double>(memory.working)));
}

void print_json(const Engine& engine) {
  Json root;
  root["bundle"] = identity_json(engine.bundle());
  root["keys"] = Json::object();
  for (const auto& [key, value] : engine.bundle().keys().all())
    if (!key.starts_with("tokenizer."))  // tens of thousands of tokens serve no reader
      std::visit([&, &name = key](const auto& v) { root["keys"][name] = v; }, value);
  root["stats"] = Json::object();
  for (const TensorInfo& tensor : engine.bundle().tensors())
    if (tensor.name.starts_with("stats."))
      if (auto values = engine.bundle().stats(tensor.name)) root["stats"][tensor.name] = *values;
  root["modules"] = Json::object();
  for (const auto& [path, size] : module_sizes(engine.params()))
    root["modules"][path] = {{"parameters", size.n_param}, {"stored_bytes", size.stored}};
  root["linear_kernels"] = engine.linear_kernels();
  root["precision"] = engine.precision();
  const MemoryUse memory = engine.memory();
  root["memory_bytes"] = {
      {"weights", memory.weights}, {"plan", memory.plan}, {"working", memory.working}, {"total", memory.total()}};
  fmt::print("{}\n", text_of(root, 2));
}

Status inspect(const InspectOptions& options) {
  if (options.manifest.empty() == options.bundle.empty())
    return Error{Code::usage, "inspect", "BUNDLE or --manifest ARCH", options.bundle.empty() ? "neither" : "both"};
  if (!options.manifest.empty()) return print_manifest(options.manifest);
  // A dry load checks everything that a run would check and reserves the memory that it would take, without filling it.
  VLA_TRY(const std::unique_ptr<Engine> engine, Engine::load(options.bundle, {.dry = true}));
  options.json ? print_json(*engine) : print_human(*engine);
  return {};
}

}  // namespace

Command add_inspect(CLI::App& app) {
  auto options = std::make_shared<InspectOptions>();
  CLI::App* command =
      app.add_subcommand("inspect", "Show what a bundle is: features, statistics, recipe, sizes, memory");
  command->footer(
      "  vla inspect policy.gguf\n  vla inspect policy.gguf --json\n  vla inspect --manifest smolvla    # parameters "
      "at the published size");
  command->add_option("BUNDLE", options->bundle, "The policy, a .gguf file from vla-convert");
  command->add_option("--manifest", options->manifest,
                      "Print the keys and parameters that an architecture declares, as JSON");
  command->add_flag("--json", options->json, "Print JSON for machines");
  return [options] { return inspect(*options); };
}

}  // namespace vla::cli
