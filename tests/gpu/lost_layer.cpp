// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A Vulkan layer between loader and driver that loses the device: from submission VLA_LOST_AT (from 1) on, whatever is
// submitted or waited for is answered with VK_ERROR_DEVICE_LOST. VLA_LOST_COUNTS names a file that gets a byte for
// each. For one driver in a process.
#include <vulkan/vk_layer.h>
#include <vulkan/vulkan.h>

#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <cstring>

namespace {

PFN_vkGetInstanceProcAddr next_instance = nullptr;
PFN_vkGetDeviceProcAddr next_device = nullptr;
PFN_vkQueueSubmit next_submit = nullptr;
PFN_vkQueueWaitIdle next_idle = nullptr;
PFN_vkWaitForFences next_wait = nullptr;
PFN_vkGetFenceStatus next_status = nullptr;
std::atomic<long> n_submit = 0;
std::FILE* counts = nullptr;

long lost_at() {
  static const char* text = std::getenv("VLA_LOST_AT");
  static const long n = text != nullptr ? std::atol(text) : 0;
  return n;
}
bool is_lost() { return lost_at() > 0 && n_submit >= lost_at(); }

/// Where the loader says what comes after this layer. The next layer finds its own place in the chain.
template <class Link>
Link* take_link(const void* chain, VkStructureType type) {
  for (auto* info = static_cast<const VkBaseInStructure*>(chain); info != nullptr; info = info->pNext) {
    auto* link = const_cast<Link*>(reinterpret_cast<const Link*>(info));
    if (info->sType == type && link->function == VK_LAYER_LINK_INFO) return link;
  }
  return nullptr;
}

VKAPI_ATTR VkResult VKAPI_CALL create_instance(const VkInstanceCreateInfo* info, const VkAllocationCallbacks* memory,
                                               VkInstance* instance) {
  auto* link = take_link<VkLayerInstanceCreateInfo>(info->pNext, VK_STRUCTURE_TYPE_LOADER_INSTANCE_CREATE_INFO);
  if (link == nullptr) return VK_ERROR_INITIALIZATION_FAILED;
  next_instance = link->u.pLayerInfo->pfnNextGetInstanceProcAddr;
  link->u.pLayerInfo = link->u.pLayerInfo->pNext;
  if (const char* file = std::getenv("VLA_LOST_COUNTS")) counts = std::fopen(file, "w");
  return reinterpret_cast<PFN_vkCreateInstance>(next_instance(nullptr, "vkCreateInstance"))(info, memory, instance);
}

VKAPI_ATTR VkResult VKAPI_CALL create_device(VkPhysicalDevice physical, const VkDeviceCreateInfo* info,
                                             const VkAllocationCallbacks* memory, VkDevice* device) {
  auto* link = take_link<VkLayerDeviceCreateInfo>(info->pNext, VK_STRUCTURE_TYPE_LOADER_DEVICE_CREATE_INFO);
  if (link == nullptr) return VK_ERROR_INITIALIZATION_FAILED;
  const auto instance = link->u.pLayerInfo->pfnNextGetInstanceProcAddr;
  next_device = link->u.pLayerInfo->pfnNextGetDeviceProcAddr;
  link->u.pLayerInfo = link->u.pLayerInfo->pNext;
  const VkResult made =
      reinterpret_cast<PFN_vkCreateDevice>(instance(nullptr, "vkCreateDevice"))(physical, info, memory, device);
  if (made != VK_SUCCESS) return made;
  next_submit = reinterpret_cast<PFN_vkQueueSubmit>(next_device(*device, "vkQueueSubmit"));
  next_idle = reinterpret_cast<PFN_vkQueueWaitIdle>(next_device(*device, "vkQueueWaitIdle"));
  next_wait = reinterpret_cast<PFN_vkWaitForFences>(next_device(*device, "vkWaitForFences"));
  next_status = reinterpret_cast<PFN_vkGetFenceStatus>(next_device(*device, "vkGetFenceStatus"));
  return made;
}

VKAPI_ATTR VkResult VKAPI_CALL submit(VkQueue queue, std::uint32_t n, const VkSubmitInfo* infos, VkFence fence) {
  ++n_submit;
  if (counts != nullptr) std::fputc('.', counts), std::fflush(counts);
  if (!is_lost()) return next_submit(queue, n, infos, fence);
  // A lost device has stopped. Mesa's threads still compute, and would read memory that the caller frees now.
  next_idle(queue);
  return VK_ERROR_DEVICE_LOST;
}
VKAPI_ATTR VkResult VKAPI_CALL wait(VkDevice device, std::uint32_t n, const VkFence* fences, VkBool32 all,
                                    std::uint64_t limit) {
  return is_lost() ? VK_ERROR_DEVICE_LOST : next_wait(device, n, fences, all, limit);
}
VKAPI_ATTR VkResult VKAPI_CALL status(VkDevice device, VkFence fence) {
  return is_lost() ? VK_ERROR_DEVICE_LOST : next_status(device, fence);
}

VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL device_function(VkDevice device, const char* name) {
  if (std::strcmp(name, "vkQueueSubmit") == 0) return reinterpret_cast<PFN_vkVoidFunction>(submit);
  if (std::strcmp(name, "vkWaitForFences") == 0) return reinterpret_cast<PFN_vkVoidFunction>(wait);
  if (std::strcmp(name, "vkGetFenceStatus") == 0) return reinterpret_cast<PFN_vkVoidFunction>(status);
  if (std::strcmp(name, "vkGetDeviceProcAddr") == 0) return reinterpret_cast<PFN_vkVoidFunction>(device_function);
  return next_device(device, name);
}

VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL instance_function(VkInstance instance, const char* name) {
  if (std::strcmp(name, "vkCreateInstance") == 0) return reinterpret_cast<PFN_vkVoidFunction>(create_instance);
  if (std::strcmp(name, "vkCreateDevice") == 0) return reinterpret_cast<PFN_vkVoidFunction>(create_device);
  if (std::strcmp(name, "vkGetDeviceProcAddr") == 0) return reinterpret_cast<PFN_vkVoidFunction>(device_function);
  return instance != nullptr ? next_instance(instance, name) : nullptr;
}

}  // namespace

extern "C" VK_LAYER_EXPORT VkResult vkNegotiateLoaderLayerInterfaceVersion(VkNegotiateLayerInterface* asked) {
  asked->loaderLayerInterfaceVersion = 2;
  asked->pfnGetInstanceProcAddr = instance_function;
  asked->pfnGetDeviceProcAddr = device_function;
  asked->pfnGetPhysicalDeviceProcAddr = nullptr;
  return VK_SUCCESS;
}
