// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/backends.h"

#include <dlfcn.h>
#include <fmt/format.h>
#include <link.h>

#include <algorithm>
#include <charconv>
#include <filesystem>
#include <map>
#include <mutex>

#include "ggml/backend_library.h"
#include "ggml/guard.h"

namespace vla {
namespace {

namespace fs = std::filesystem;

constexpr const char* kKinds[] = {"vulkan", "cuda"};

/// The program or library that this code was linked into.
fs::path own_file() {
  Dl_info info = {};
  link_map* map = nullptr;
  const bool found =
      dladdr1(reinterpret_cast<void*>(&own_file), &info, reinterpret_cast<void**>(&map), RTLD_DL_LINKMAP) != 0;
  std::error_code error;  // a program has no name in the linker's list
  return fs::canonical(found && map->l_name[0] != '\0' ? map->l_name : "/proc/self/exe", error);
}

std::vector<fs::path> library_folders() {
  const fs::path own = own_file().parent_path();
  std::vector<fs::path> folders = {own};
  for (const char* beside : {"../" VLA_LIBRARY_FOLDER, "../lib"}) {
    const fs::path folder = (own / beside).lexically_normal();
    if (std::find(folders.begin(), folders.end(), folder) == folders.end()) folders.push_back(folder);
  }
  return folders;
}

/// A library that was looked for once: what it registers, or why it does not.
struct Backend {
  ggml_backend_reg_t devices = nullptr;
  std::string absent;
  const BackendLibrary* library = nullptr;
};

Backend open_library(const fs::path& file) {
  void* library = dlopen(file.c_str(), RTLD_NOW | RTLD_LOCAL);  // never closed: drivers leave threads behind
  if (library == nullptr) return {nullptr, dlerror()};
  using Entry = const BackendLibrary* (*)();
  const auto entry = reinterpret_cast<Entry>(dlsym(library, kBackendSymbol));
  const BackendLibrary* found = entry != nullptr ? entry() : nullptr;
  if (found == nullptr || std::string(found->build) != VLA_BACKEND_BUILD)
    return {nullptr, fmt::format("{} was built for {}, not for {}", file.string(),
                                 found != nullptr ? found->build : "something else", VLA_BACKEND_BUILD)};
  set_guard(found->set_log, found->set_abort);
  Backend backend;
  if (const Status opened = guarded(file.string(), [&] { backend.devices = found->open(); }); !opened)
    return {nullptr, opened.error().found};
  backend.library = found;
  if (backend.devices == nullptr)
    backend.absent = "no driver of it on this machine";
  else if (ggml_backend_reg_dev_count(backend.devices) == 0)
    backend = {nullptr, "its driver shows no device"};
  return backend;
}

Backend look_for(const std::string& kind) {
  const std::string name = fmt::format("libvla-{}.so", kind);
  std::string places;
  for (const fs::path& folder : library_folders()) {
    std::error_code error;
    if (fs::exists(folder / name, error)) return open_library(folder / name);
    places += (places.empty() ? "" : " or ") + folder.string();
  }
  return {nullptr, fmt::format("no {} in {}", name, places)};
}

const Backend& backend(const std::string& kind) {
  static std::mutex mutex;
  static std::map<std::string, Backend> found;
  const std::lock_guard<std::mutex> lock(mutex);
  if (found.count(kind) == 0) found[kind] = look_for(kind);
  return found[kind];
}

/// With driver and version, which a question about wrong numbers starts from.
DeviceInfo describe(const Backend& found, const DeviceName& name) {
  ggml_backend_dev_t device = ggml_backend_reg_dev_get(found.devices, static_cast<std::size_t>(name.index));
  DeviceInfo info = {name.text(), ggml_backend_dev_description(device), 0, 0, "f32, bf16"};
  const Status told = guarded(info.name, [&] {
    info.description += fmt::format("; {}", found.library->driver(device));
    ggml_backend_dev_memory(device, &info.free, &info.memory);
  });
  if (!told) info.description += "; " + told.error().found;
  return info;
}

Error absent(const DeviceName& name) {
  const DeviceList list = backend_devices();
  std::string here = "cpu", why;
  for (const DeviceInfo& device : list.devices) here += fmt::format(", {} ({})", device.name, device.description);
  for (const auto& [kind, reason] : list.absent)
    if (kind == name.kind) why = reason;
  return {Code::device, name.text(), "one of " + here, why.empty() ? "none with this number" : why,
          "vla inspect --devices lists them; docs/gpu.md says what each needs"};
}

}  // namespace

Result<DeviceName> DeviceName::parse(const std::string& text) {
  if (text.empty() || text == "cpu") return DeviceName{"cpu"};
  const std::size_t colon = std::min(text.find(':'), text.size());
  DeviceName name = {text.substr(0, colon)};
  const bool known = std::find(std::begin(kKinds), std::end(kKinds), name.kind) != std::end(kKinds);
  const char *at = text.data() + std::min(colon + 1, text.size()), *end = text.data() + text.size();
  const auto [next, error] = std::from_chars(at, end, name.index);
  const bool counts = colon == text.size() || (error == std::errc() && next == end && name.index >= 0);
  if (known && counts) return name;
  return Error{Code::usage, "device", "cpu, vulkan, vulkan:N, cuda or cuda:N", text};
}

DeviceList backend_devices() {
  DeviceList list;
  for (const char* kind : kKinds) {
    const Backend& found = backend(kind);
    if (found.devices == nullptr) {
      list.absent.emplace_back(kind, found.absent);
      continue;
    }
    const std::size_t n = ggml_backend_reg_dev_count(found.devices);
    for (std::size_t i = 0; i < n; ++i) list.devices.push_back(describe(found, {kind, static_cast<int>(i)}));
  }
  return list;
}

Result<ggml_backend_dev_t> find_device(const DeviceName& name) {
  const Backend& found = backend(name.kind);
  const auto index = static_cast<std::size_t>(name.index);
  if (found.devices == nullptr || index >= ggml_backend_reg_dev_count(found.devices)) return absent(name);
  return ggml_backend_reg_dev_get(found.devices, index);
}

}  // namespace vla
