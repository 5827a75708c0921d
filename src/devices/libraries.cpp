// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "devices/libraries.h"

#include <dlfcn.h>
#include <fmt/format.h>
#include <link.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <mutex>
#include <string_view>

namespace vla {
namespace {

namespace fs = std::filesystem;

using Loaded = Result<const DeviceLibrary*>;

/// The program or library that contains this code.
fs::path own_file() {
  Dl_info info = {};
  link_map* map = nullptr;
  const bool found =
      dladdr1(reinterpret_cast<void*>(&own_file), &info, reinterpret_cast<void**>(&map), RTLD_DL_LINKMAP) != 0;
  std::error_code error;  // the dynamic linker lists the program with an empty name
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

Error absent(const std::string& kind, std::string reason) {
  return {Code::device, kind, "a library of its devices", std::move(reason)};
}

Loaded load(const std::string& kind, const fs::path& file) {
  void* library = dlopen(file.c_str(), RTLD_NOW | RTLD_LOCAL);  // never closed: drivers keep threads
  if (library == nullptr) return absent(kind, dlerror());
  const auto entry = reinterpret_cast<decltype(&vla_device_library)>(dlsym(library, kDeviceLibrarySymbol));
  const DeviceLibrary* found = entry != nullptr ? entry() : nullptr;
  if (found != nullptr && std::string_view(found->build) == kDeviceBuild) return found;
  return absent(kind, fmt::format("{} was built for {}, not for {}", file.string(),
                                  found != nullptr ? found->build : "something else", kDeviceBuild));
}

Loaded look_for(const std::string& kind) {
  const std::string name = fmt::format("libvla-{}.so", kind);
  std::string places;
  for (const fs::path& folder : library_folders()) {
    std::error_code error;
    if (fs::exists(folder / name, error)) return load(kind, folder / name);
    places += (places.empty() ? "" : " or ") + folder.string();
  }
  return absent(kind, fmt::format("no {} in {}", name, places));
}

}  // namespace

Loaded device_library(const std::string& kind) {
  static std::mutex mutex;
  static std::map<std::string, Loaded> loaded;
  const std::lock_guard<std::mutex> lock(mutex);
  if (const auto found = loaded.find(kind); found != loaded.end()) return found->second;
  return loaded.emplace(kind, look_for(kind)).first->second;
}

}  // namespace vla
