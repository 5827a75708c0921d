// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// libvla-vulkan.so: ggml's Vulkan backend.
#include <ggml-vulkan.h>
#include <vulkan/vulkan.h>

#include <cstdint>
#include <string>
#include <vector>

#include "ggml/ggml_library.h"

namespace {

/// The driver's name and version. Makes a Vulkan instance, because ggml does not export its own.
std::string driver(ggml_backend_dev_t device) {
  std::string text = "driver unknown";
  const VkApplicationInfo application = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = VK_API_VERSION_1_2};
  const VkInstanceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO, .pApplicationInfo = &application};
  VkInstance instance = nullptr;
  if (vkCreateInstance(&info, nullptr, &instance) != VK_SUCCESS) return text;
  std::uint32_t n = 0;
  vkEnumeratePhysicalDevices(instance, &n, nullptr);
  std::vector<VkPhysicalDevice> all(n);
  vkEnumeratePhysicalDevices(instance, &n, all.data());
  for (VkPhysicalDevice physical : all) {
    VkPhysicalDeviceDriverProperties of = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_DRIVER_PROPERTIES};
    VkPhysicalDeviceProperties2 properties = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_PROPERTIES_2, .pNext = &of};
    vkGetPhysicalDeviceProperties2(physical, &properties);
    if (std::string(properties.properties.deviceName) != ggml_backend_dev_description(device)) continue;
    const std::uint32_t api = properties.properties.apiVersion;
    text = std::string("driver ") + of.driverName + " " + of.driverInfo + ", Vulkan " +
           std::to_string(VK_API_VERSION_MAJOR(api)) + "." + std::to_string(VK_API_VERSION_MINOR(api)) + "." +
           std::to_string(VK_API_VERSION_PATCH(api));
  }
  vkDestroyInstance(instance, nullptr);
  return text;
}

constexpr vla::GgmlBackend kVulkan = {"vulkan", ggml_backend_vk_reg, driver, true};

}  // namespace

const vla::DeviceLibrary* vla_device_library() {
  static const vla::DeviceLibrary library = vla::library_of<kVulkan>();
  return &library;
}
