// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Included before ggml-vulkan.cpp by the compiler's command line, so that ggml stays as it is.
#pragma once

#include <vulkan/vulkan_core.h>

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <initializer_list>

/// Replaces the environment that ggml reads. Settings that change results are fixed here: products are computed in
/// float32. By default ggml's shaders round operands to float16 where the device has it.
inline char* vla_vulkan_setting(const char* name) {
  static char yes[] = "1";
  for (const char* ours : {"GGML_VK_DISABLE_F16", "GGML_VK_DISABLE_BFLOAT16", "GGML_VK_DISABLE_COOPMAT",
                           "GGML_VK_DISABLE_COOPMAT2", "GGML_VK_DISABLE_DOT2"})
    if (std::strcmp(name, ours) == 0) return yes;
  return std::getenv(name);
}
#define getenv(name) vla_vulkan_setting(name)

// Vulkan's headers define debug-layer settings since 1.3.272. ggml names their types in code that a release build never
// runs. For older headers these types have the extension's layout and set nothing.
#ifndef VK_EXT_LAYER_SETTINGS_EXTENSION_NAME
namespace vk {
enum class LayerSettingTypeEXT : int { eBool32 };
struct LayerSettingEXT {
  const char *layer, *setting;
  LayerSettingTypeEXT type;
  std::uint32_t n_value;
  const void* values;
};
struct LayerSettingsCreateInfoEXT {
  template <class Settings>
  explicit LayerSettingsCreateInfoEXT(const Settings&) {}
  VkStructureType sType = static_cast<VkStructureType>(1000496000);
  const void* pNext = nullptr;
  std::uint32_t n_setting = 0;
  const LayerSettingEXT* settings = nullptr;
};
}  // namespace vk
#endif
