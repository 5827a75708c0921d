// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cmath>
#include <map>

#include "cli/commands.h"
#include "cli/json.h"
#include "cli/say.h"
#include "engine/description.h"
#include "processor/constant_actions.h"

namespace vla::cli {
namespace {

struct InspectOptions {
  std::string bundle, manifest, graph, kernels, device, embodiment;
  std::size_t memory = 0;
  bool json = false, devices = false;
};

std::string human_size(double bytes) {
  constexpr const char* kUnits[] = {"B", "kB", "MB", "GB", "TB"};
  int unit = 0;
  for (; bytes >= 1000 && unit < 4; ++unit) bytes /= 1000;
  return fmt::format("{:.{}f} {}", bytes, unit == 0 ? 0 : 1, kUnits[unit]);
}

/// The size of one module, by the first part of its parameters' names: `vision`, `lm`, `expert`, `action_in`, ...
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

Json shape_json(const Param& param) {  // torch's order, slowest dimension first
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
    row["storage"] = param.storage_text();
    root["parameters"].push_back(std::move(row));
  }
  say_lines(stdout, text_of(root, 2) + "\n");
  return {};
}

/// The statistics `stats.<feature>.*` of a feature, one column for each.
struct StatsColumns {
  std::vector<std::string> names;
  std::vector<std::vector<double>> values;
};

StatsColumns read_stats(const Bundle& bundle, const std::string& feature) {
  StatsColumns columns;
  const std::string prefix = "stats." + feature + ".";
  for (const TensorInfo& tensor : bundle.tensors())
    if (tensor.name.starts_with(prefix))
      if (auto values = bundle.stats(tensor.name)) {
        columns.names.push_back(tensor.name.substr(prefix.size()) + (tensor.shape.size() > 1 ? " (row 0)" : ""));
        columns.values.push_back(*values);
      }
  return columns;
}

void print_numbers(const std::vector<Description::Number>& numbers, const StatsColumns& stats) {
  std::size_t width = 4;
  for (const auto& number : numbers) width = std::max(width, number.name.size());
  say(stdout, "    {:<{}}  {:<10}", "name", width, "unit");
  for (const std::string& column : stats.names) say(stdout, "  {:>12}", column);
  say(stdout, "\n");
  for (std::size_t i = 0; i < numbers.size(); ++i) {
    say(stdout, "    {:<{}}  {:<10}", numbers[i].name, width, numbers[i].unit.empty() ? "unstated" : numbers[i].unit);
    for (const auto& column : stats.values) say(stdout, "  {:>12.6g}", i < column.size() ? column[i] : 0.0);
    say(stdout, "\n");
  }
}

void print_features(const Description& d, const Robot& robot) {
  const Recipe& recipe = robot.processor().recipe();
  if (d.views.empty())
    say(stdout, "views        none\n");
  else
    say(stdout, "views        any size, {} to {} x {}; at least {} of {} must be present\n", recipe.fit->described(),
        recipe.width, recipe.height, d.min_views, d.views.size());
  for (const auto& view : d.views)
    say(stdout, "    {}{}{}\n", view.name, view.alias.empty() ? "" : fmt::format("  (also {})", view.alias),
        view.camera_width > 0 ? fmt::format("  the checkpoint's is {} x {}", view.camera_width, view.camera_height)
                              : "");
  for (const auto& state : d.states) {
    say(stdout, "state        {}, {} numbers\n", state.name, state.numbers.size());
    print_numbers(state.numbers, read_stats(robot.bundle(), state.name));
  }
  say(stdout, "action       {} rows of {} numbers{}\n", d.horizon, d.actions.size(),
      d.rate_hz > 0 ? fmt::format(", {:g} rows a second", d.rate_hz) : ", control rate unstated");
  print_numbers(d.actions, read_stats(robot.bundle(), "action"));
  if (d.n_action_steps > 0)
    say(stdout, "executed     {} rows of a chunk before the next look (n_action_steps of the checkpoint)\n",
        d.n_action_steps);
  if (d.max_text_tokens > 0)
    say(stdout, "instruction  at most {} tokens\n", d.max_text_tokens);
  else
    say(stdout, "instruction  not read: the policy knows one task\n");
}

void print_modules(const Engine& engine) {
  say(stdout, "modules      {:<18}  {:>14}  {:>10}\n", "path", "parameters", "stored");
  std::int64_t n_param = 0;
  for (const auto& [path, size] : module_sizes(engine.params())) {
    say(stdout, "             {:<18}  {:>14}  {:>10}\n", path, fmt::format("{}", size.n_param),
        human_size(static_cast<double>(size.stored)));
    n_param += size.n_param;
  }
  say(stdout, "             {:<18}  {:>14}\n", "all", n_param);
}

void print_budget(const Engine& engine) {
  const MemoryBudget& budget = engine.budget();
  const auto size = [](std::size_t bytes) { return human_size(static_cast<double>(bytes)); };
  const std::size_t file = engine.robot().bundle().file_size();
  say(stdout, "budget       {}{}; {:.0f} MB is the least that does\n", size(budget.size),
      engine.device().is_host() ? ", of which the process itself takes " + size(budget.process)
                                : " of the device's memory",
      std::ceil(1e-6 * static_cast<double>(budget.smallest)));
  if (budget.n_read == 0) return say(stdout, "             all matrices stay in memory\n");
  const double rate = engine.robot().bundle().content()->read_rate();
  say(stdout,
      "             every act reads {} of the file's {}: {:.2f} s at the {}/s of opening it, while others are "
      "multiplied\n",
      size(budget.n_read), size(file), static_cast<double>(budget.n_read) / rate, human_size(rate));
}

void print_human(const Engine& engine) {
  const Robot& robot = engine.robot();
  const Description d = describe(engine, robot);
  const auto size = [](std::size_t bytes) { return human_size(static_cast<double>(bytes)); };
  say(stdout, "bundle       {}\n", d.path);
  say(stdout, "policy       {}, stored as {}, {}\n", d.arch, d.dtype, size(robot.bundle().file_size()));
  if (!d.embodiment.empty())
    say(stdout, "embodiment   {}, one of {}\n", d.embodiment,
        fmt::format("{}", fmt::join(robot.bundle().embodiments(), ", ")));
  for (const std::string& feature : robot.processor().degraded())
    say(stdout, "DEGRADED     {} passes unnormalized, as --identity-stats allowed when converting\n", feature);
  for (const std::string& action : constant_actions(robot.processor(), robot.solver_horizon(), robot.d_action_padded()))
    say(stdout, "CONSTANT     {} has no spread in its statistics: it is the same whatever the network says\n", action);
  say(stdout, "source       {}{}, converted by {}\n", d.source, d.revision.empty() ? "" : " at " + d.revision,
      d.converter);
  if (const auto backbone = robot.bundle().keys().string("vla.source.backbone"))
    say(stdout, "backbone     {}\n", *backbone);
  if (const auto chosen = robot.bundle().keys().string("vla.quantization")) say(stdout, "quantized    {}\n", *chosen);
  say(stdout, "checksum     {}\n", d.checksum);
  print_features(d, robot);
  if (const Solver& solver = robot.solver(); solver.decodes)
    say(stdout, "answer       at most {} tokens, each the likeliest, up to token {}\n", d.n_step, solver.stop_token);
  else
    say(stdout, "solver       {}, {} steps from {:g}, {} noise\n", d.solver, d.n_step, d.t_start, d.noise);
  say(stdout, "leftover     {}\n",
      d.real_time_chunking.empty() ? "refused: no real-time chunking" : d.real_time_chunking);
  if (d.rtc.execution_horizon > 0)
    say(stdout, "rtc          the checkpoint executes {} rows, schedule {}, max guidance {:g}\n",
        d.rtc.execution_horizon, d.rtc.schedule, d.rtc.max_guidance);
  const Json recipe = Json::parse(*robot.bundle().keys().string("processor.recipe"), nullptr, false);
  for (const auto& [list, ops] : recipe.items()) {
    say(stdout, "recipe       {}\n", list);
    for (const Json& op : ops) say(stdout, "    {}\n", text_of(op));
  }
  print_modules(engine);
  say(stdout, "device       {}\n", d.device);
  say(stdout, "products     {}: {}\n", engine.linear_kernels(), engine.arithmetic());
  say(stdout, "memory       {} in all: weights {}, inputs and cache {}, working memory {}\n", size(d.memory.total()),
      size(d.memory.weights), size(d.memory.plan), size(d.memory.working));
  if (const MemoryBudget& budget = engine.budget(); budget.size > 0) print_budget(engine);
}

void print_json(const Engine& engine) {
  const Bundle& bundle = engine.robot().bundle();
  Json root;
  root["bundle"] = identity_json(bundle);
  if (!bundle.embodiment().empty()) root["embodiments"] = bundle.embodiments();
  root["keys"] = Json::object();
  for (const auto& [key, value] : bundle.keys().all())
    if (!key.starts_with("tokenizer."))  // tens of thousands of tokens serve no reader
      std::visit([&, &name = key](const auto& v) { root["keys"][name] = v; }, value);
  root["stats"] = Json::object();
  for (const TensorInfo& tensor : bundle.tensors())
    if (tensor.name.starts_with("stats."))
      if (auto values = bundle.stats(tensor.name)) root["stats"][tensor.name] = *values;
  root["modules"] = Json::object();
  for (const auto& [path, size] : module_sizes(engine.params()))
    root["modules"][path] = {{"parameters", size.n_param}, {"stored_bytes", size.stored}};
  root["device"] = engine.device().name();
  root["linear_kernels"] = engine.linear_kernels();
  root["precision"] = precision_name(engine.precision());
  root["real_time_chunking"] = kind_name(engine.robot().real_time_chunking().kind);
  const MemoryUse memory = engine.memory();
  root["memory_bytes"] = {
      {"weights", memory.weights}, {"plan", memory.plan}, {"working", memory.working}, {"total", memory.total()}};
  if (const MemoryBudget& budget = engine.budget(); budget.size > 0)
    root["memory_budget_bytes"] = {{"size", budget.size},
                                   {"process", budget.process},
                                   {"smallest", budget.smallest},
                                   {"read_in_every_act", budget.n_read}};
  auto exact = nlohmann::ordered_json::parse(text_of(root));  // its numbers are double
  for (const TensorInfo& tensor : bundle.tensors())
    if (tensor.name.starts_with("stats.") && tensor.type == DType::f64)
      exact["stats"][tensor.name] = *bundle.stats(tensor.name);
  say_lines(stdout, exact.dump(2, ' ', true, Json::error_handler_t::replace) + "\n");
}

Status print_devices() {
  const DeviceList list = list_devices();
  say(stdout, "{:<9}  {:>10}  {:>10}  {:<9}  {}\n", "device", "memory", "free", "products", "description");
  const auto size = [](std::size_t bytes) { return human_size(static_cast<double>(bytes)); };
  for (const DeviceInfo& device : list.devices)
    say(stdout, "{:<9}  {:>10}  {:>10}  {:<9}  {}\n", device.name, size(device.memory),
        device.free > 0 ? size(device.free) : "not told", device.precision, device.description);
  for (const auto& [kind, reason] : list.absent) say(stdout, "no {}: {}\n", kind, reason);
  return {};
}

Status print_devices_json() {
  const DeviceList list = list_devices();
  Json root = {{"devices", Json::array()}, {"absent", Json::object()}};
  for (const DeviceInfo& device : list.devices)
    root["devices"].push_back({{"name", device.name},
                               {"description", device.description},
                               {"memory_bytes", device.memory},
                               {"free_bytes", device.free > 0 ? Json(device.free) : Json()},
                               {"products", device.precision}});
  for (const auto& [kind, reason] : list.absent) root["absent"][kind] = reason;
  say_lines(stdout, text_of(root, 2) + "\n");
  return {};
}

Status print_graph(Engine& engine, const std::string& part) {
  VLA_TRY(const std::string text, engine.program_text(part == "prefix" ? Engine::Part::prefix : Engine::Part::step));
  fmt::print("phase kernel        MFLOP        MB  operation: operand -> results\n{}", text);
  return {};
}

Status inspect(const InspectOptions& options) {
  const int n_asked = !options.manifest.empty() + !options.bundle.empty() + options.devices;
  if (n_asked != 1)
    return Error{Code::usage, "inspect", "one of BUNDLE, --manifest ARCH and --devices",
                 n_asked == 0 ? "none" : "several"};
  if (options.devices) return options.json ? print_devices_json() : print_devices();
  if (!options.manifest.empty()) return print_manifest(options.manifest);
  // A dry load checks everything that a run would check and reserves the memory that it would take, without filling it.
  VLA_TRY(const std::unique_ptr<Engine> engine, Engine::load(options.bundle, {.kernels = options.kernels,
                                                                              .device = options.device,
                                                                              .dry = true,
                                                                              .embodiment = options.embodiment,
                                                                              .memory = options.memory}));
  if (!options.graph.empty()) return print_graph(*engine, options.graph);
  options.json ? print_json(*engine) : print_human(*engine);
  return {};
}

}  // namespace

Command add_inspect(CLI::App& app) {
  auto options = std::make_shared<InspectOptions>();
  CLI::App* command =
      app.add_subcommand("inspect", "Show what a bundle is: features, statistics, recipe, sizes, memory");
  command->footer(
      "  vla inspect policy.gguf\n  vla inspect policy.gguf --json\n  vla inspect policy.gguf --graph step    # the "
      "program that runs in every solver step\n  vla inspect --manifest smolvla    # parameters at the published "
      "size\n  vla inspect --devices");
  add_bundle(*command, options->bundle, false);
  add_text(*command, "--manifest", options->manifest, "ARCH",
           "Print the keys and parameters that an architecture declares, as JSON");
  command
      ->add_option(
          "--graph", options->graph,
          "Print the program of the prefix or of a step for the largest observation, a line an operation: the "
          "phase in which it runs (those of one phase run side by side), kernel, work, what was fused, and "
          "shapes with their layout (@slot: outlives a run, @kept: made once per observation, @thread: a block of "
          "rows at a time, in memory of the thread that takes it through both products)")
      ->check(CLI::IsMember({"prefix", "step"}));
  add_text(*command, "--kernels", options->kernels, "NAME", "As for vla run: what the program is made of");
  add_text(*command, "--device", options->device, "NAME", "As for vla run: whose memory and program are shown");
  add_memory(*command, options->memory);
  add_text(*command, "--embodiment", options->embodiment, "TAG", kEmbodimentHelp);
  command->add_flag("--devices", options->devices, "List what --device may name here, and why the others are absent");
  command->add_flag("--json", options->json, "Print JSON for machines");
  return [options] { return inspect(*options); };
}

}  // namespace vla::cli
