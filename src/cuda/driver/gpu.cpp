// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/driver/gpu.h"

#include <algorithm>
#include <array>
#include <cstdlib>

#include "base/printable.h"

namespace vla::cuda {
namespace {

// Values of CUDA Driver API 13.0.
constexpr int kOutOfMemory = 2, kInvalidImage = 200, kNoBinary = 209;
constexpr int kCapabilityMajor = 75, kCapabilityMinor = 76, kCountSm = 16, kMaxDynamicShared = 8;
constexpr unsigned kNonBlocking = 1, kNoTiming = 2;
constexpr int kThreadLocal = 1;
constexpr int kCluster = 4, kOverlaps = 6;       // attributes of a launch: cluster, programmatic stream serialization
constexpr int kErrorLog = 5, kErrorLogSize = 6;  // options of module_load

std::string version_text(int version) {
  return std::to_string(version / 1000) + "." + std::to_string(version % 1000 / 10);
}

/// The target architecture of PTX, such as "90", or "90a" if no other architecture runs it; empty if PTX names none.
std::string target_of(const std::string& ptx) {
  constexpr std::string_view kTarget = ".target sm_";
  const std::size_t at = ptx.find(kTarget);
  if (at == std::string::npos) return "";
  const std::size_t first = at + kTarget.size();
  return ptx.substr(first, ptx.find_first_not_of("0123456789a", first) - first);
}

/// Whether to load PTX for this target on a device of this capability. An empty target fits every device.
bool is_for(const std::string& target, int capability) {
  return target.empty() || target == (capability < 90 ? "80" : "90") || target == std::to_string(capability) + "a";
}

bool is_machine_code(const std::string& image) { return image.starts_with("\177ELF"); }

/// The names of a module's kernels.
std::vector<std::string> kernels_of(const std::string& ptx) {
  constexpr std::string_view kEntry = ".entry ";
  std::vector<std::string> names;
  for (std::size_t at = ptx.find(kEntry); at != std::string::npos; at = ptx.find(kEntry, at)) {
    at += kEntry.size();
    names.push_back(ptx.substr(at, ptx.find('(', at) - at));
  }
  return names;
}

}  // namespace

#define CALL(name, ...) check(#name, driver_.name(__VA_ARGS__))

namespace {

Status check_call(const Driver& driver, const char* call, int result) {
  if (result == 0) return {};
  const char *name = nullptr, *text = nullptr;
  driver.error_name(result, &name), driver.error_text(result, &text);
  return Error{result == kOutOfMemory ? Code::out_of_memory : Code::device, std::string("cuda ") + call, "",
               (name ? name : "error " + std::to_string(result)) + (text ? std::string(", ") + text : "")};
}

/// Initializes the driver and returns the number of devices. Errors: device, also if the driver is too old.
Result<int> start_driver(const Driver& driver) {
  int version = 0, n_device = 0;
  VLA_CHECK(check_call(driver, "init", driver.init(0)));
  VLA_CHECK(check_call(driver, "driver_version", driver.driver_version(&version)));
  if (version < Gpu::kMinDriver)
    return Error{Code::device, "cuda", "a driver for CUDA " + version_text(Gpu::kMinDriver) + " or newer",
                 "one for CUDA " + version_text(version)};
  VLA_CHECK(check_call(driver, "device_count", driver.device_count(&n_device)));
  return n_device;
}

}  // namespace

Result<std::vector<GpuInfo>> list_gpus(const Driver& driver) {
  VLA_TRY(const int n_device, start_driver(driver));
  if (n_device == 0) return Error{Code::device, "cuda", "a device", "its driver shows no device"};
  int version = 0;
  VLA_CHECK(check_call(driver, "driver_version", driver.driver_version(&version)));
  std::vector<GpuInfo> all;
  for (int i = 0; i < n_device; ++i) {
    int device = 0;
    char name[256] = {};
    std::size_t memory = 0;
    VLA_CHECK(check_call(driver, "device_get", driver.device_get(&device, i)));
    VLA_CHECK(check_call(driver, "device_name", driver.device_name(name, sizeof(name) - 1, device)));
    VLA_CHECK(check_call(driver, "memory_size", driver.memory_size(&memory, device)));
    all.push_back({name, "driver for CUDA " + version_text(version), memory});
  }
  return all;
}

namespace {

/// Encodes a map of bf16 whose boxes are swizzled over their rows. Strides are in elements and begin with the second
/// dimension's.
template <unsigned kDimensions>
Status encode_map(const Driver& driver, const void* data, const std::int64_t (&sizes)[kDimensions],
                  const std::int64_t (&strides)[kDimensions - 1], const int (&box)[kDimensions], TensorMap& map) {
  constexpr int kBf16 = 9, kNoInterleave = 0, kSwizzle32 = 1, kSwizzle128 = 3, kPromote256 = 3, kZeros = 0;
  std::uint64_t size[kDimensions], stride[kDimensions - 1];
  unsigned box_size[kDimensions], steps[kDimensions];
  for (unsigned i = 0; i < kDimensions; ++i) {
    size[i] = static_cast<std::uint64_t>(sizes[i]), box_size[i] = static_cast<unsigned>(box[i]), steps[i] = 1;
    if (i > 0) stride[i - 1] = static_cast<std::uint64_t>(strides[i - 1]) * sizeof(std::uint16_t);
  }
  return check_call(driver, "tensor_map",
                    driver.tensor_map(&map, kBf16, kDimensions, const_cast<void*>(data), size, stride, box_size, steps,
                                      kNoInterleave, box[0] == 16 ? kSwizzle32 : kSwizzle128, kPromote256, kZeros));
}

}  // namespace

Status map_rows(const Driver& driver, const MappedRows& of, TensorMap& map) {
  constexpr int kBoxDepth = 64;  // 128 bytes
  return encode_map<2>(driver, of.rows, {of.depth, of.n_row}, {of.stride}, {kBoxDepth, of.box_rows}, map);
}

Status map_heads(const Driver& driver, const MappedHeads& of, TensorMap& map) {
  return encode_map<4>(driver, of.data, {of.d_head, of.n_head, of.n_token, of.n_batch}, {of.head, of.token, of.batch},
                       {of.box_columns, 1, of.box_tokens, 1}, map);
}

Status Gpu::check(const char* call, int result) const { return check_call(driver_, call, result); }

Result<Owned> Gpu::own(const char* call, int result, Handle handle, Owned::Release release) const {
  VLA_CHECK(check(call, result));
  return Owned(handle, release);
}

Result<std::unique_ptr<Gpu>> Gpu::open(const Driver& driver, int device, const std::vector<std::string>& modules) {
  std::unique_ptr<Gpu> gpu(new Gpu(driver));
  VLA_CHECK(gpu->start(device, modules));
  return gpu;
}

Status Gpu::start(int device, const std::vector<std::string>& modules) {
  VLA_TRY(const int n_device, start_driver(driver_));
  int major = 0, minor = 0;
  if (device < 0 || device >= n_device)
    return Error{Code::device, "cuda:" + std::to_string(device), "a device below " + std::to_string(n_device),
                 "none of this number"};
  VLA_CHECK(CALL(device_get, &device_, device));
  VLA_CHECK(CALL(device_attribute, &major, kCapabilityMajor, device_));
  VLA_CHECK(CALL(device_attribute, &minor, kCapabilityMinor, device_));
  VLA_CHECK(CALL(device_attribute, &n_sm_, kCountSm, device_));
  capability_ = major * 10 + minor;
  if (capability_ < kMinCapability)
    return Error{Code::device, "cuda:" + std::to_string(device), "compute capability 8.0 or newer (Ampere)",
                 std::to_string(major) + "." + std::to_string(minor)};
  char name[256] = {};
  VLA_CHECK(CALL(device_name, name, sizeof(name) - 1, device_));
  name_ = name;
  VLA_CHECK(CALL(context_retain, &context_, device_));
  VLA_CHECK(use());
  int version = 0;
  VLA_CHECK(CALL(driver_version, &version));
  for (std::size_t i = 0; i < modules.size(); ++i) {
    const std::string target = target_of(modules[i]);
    if (is_machine_code(modules[i]) || !is_for(target, capability_)) continue;
    const bool has_code = i + 1 < modules.size() && is_machine_code(modules[i + 1]) && version >= kCodeDriver &&
                          target.starts_with(std::to_string(capability_));
    VLA_TRY(Owned loaded, load(modules[i], has_code ? &modules[i + 1] : nullptr));
    const std::vector<std::string> kernels = kernels_of(modules[i]);
    for (const std::string& kernel : kernels) functions_[kernel].module = loaded.get();
    if (kernels.empty()) unlisted_ = loaded.get();
    modules_.push_back(std::move(loaded));
  }
  return {};
}

/// Loads a module from its machine code, or from PTX if there is no machine code or the driver refuses it. If the
/// driver's compiler refuses the PTX, the error contains the compiler's message.
Result<Owned> Gpu::load(const std::string& ptx, const std::string* machine_code) const {
  std::array<char, 4096> log = {};
  int options[] = {kErrorLog, kErrorLogSize};
  void* values[] = {log.data(), reinterpret_cast<void*>(log.size() - 1)};
  Handle loaded = nullptr;
  int result = kNoBinary;
  if (machine_code != nullptr) result = driver_.module_load(&loaded, machine_code->data(), 2, options, values);
  if (result == kNoBinary || result == kInvalidImage)
    result = driver_.module_load(&loaded, ptx.c_str(), 2, options, values);
  Result<Owned> owned = own("module_load", result, loaded, driver_.module_unload);
  if (owned || log[0] == '\0') return owned;
  std::string said = log.data();
  std::replace(said.begin(), said.end(), '\n', ' ');
  Error error = owned.error();
  error.found += ": " + printable(said.substr(0, said.find_last_not_of(' ') + 1));
  return error;
}

Gpu::~Gpu() {
  if (context_ == nullptr) return;
  driver_.context_use(context_);
  modules_.clear();
  driver_.context_release(device_);
}

Status Gpu::use() const { return CALL(context_use, context_); }

Buffer::~Buffer() {
  if (gpu_ == nullptr || address_ == 0) return;
  gpu_->driver_.context_use(gpu_->context_);
  gpu_->driver_.release(address_);
}

Result<Buffer> Gpu::allocate(std::size_t size, const std::string& what) {
  VLA_CHECK(use());
  Address address = 0;
  const int result = driver_.allocate(&address, size);
  if (result == kOutOfMemory) {
    VLA_TRY(const std::size_t free, free_memory());
    return Error{Code::out_of_memory, what, std::to_string(size) + " bytes of device memory",
                 std::to_string(free) + " free"};
  }
  VLA_CHECK(check("allocate", result));
  return Buffer(this, address, size);
}

Result<std::size_t> Gpu::free_memory() const {
  VLA_CHECK(use());
  std::size_t free = 0, total = 0;
  VLA_CHECK(CALL(memory_info, &free, &total));
  return free;
}

Result<Owned> Gpu::allocate_host(std::size_t size) {
  VLA_CHECK(use());
  void* memory = nullptr;
  const int result = driver_.host_allocate(&memory, size, 0);
  return own("host_allocate", result, memory, driver_.host_release);
}

Result<Stream> Gpu::stream() {
  Handle stream = nullptr;
  const int made = driver_.stream_create(&stream, kNonBlocking);
  VLA_TRY(Owned owned, own("stream_create", made, stream, driver_.stream_destroy));
  VLA_TRY(Owned ending, event(false));
  return Stream(*this, std::move(owned), std::move(ending));
}

Result<Owned> Gpu::event(bool has_time) {
  Handle event = nullptr;
  const int made = driver_.event_create(&event, has_time ? 0 : kNoTiming);
  return own("event_create", made, event, driver_.event_destroy);
}

Result<float> Gpu::elapsed(const Owned& first, const Owned& second) const {
  float ms = 0;
  VLA_CHECK(CALL(event_elapsed, &ms, first.get(), second.get()));
  return ms;
}

Status Gpu::prepare(const Launch& how) {
  VLA_TRY([[maybe_unused]] const Handle function, kernel(how));
  return {};
}

/// Returns a kernel's function and permits it the launch's amount of shared memory.
Result<Handle> Gpu::kernel(const Launch& how) {
  Function& function = functions_[how.kernel];
  if (function.module == nullptr) function.module = unlisted_;
  if (function.module == nullptr) return Error{Code::internal, how.kernel, "a kernel of a loaded module", "none"};
  if (function.handle == nullptr) VLA_CHECK(CALL(module_function, &function.handle, function.module, how.kernel));
  if (how.shared > function.shared) {
    VLA_CHECK(CALL(function_attribute, function.handle, kMaxDynamicShared, static_cast<int>(how.shared)));
    function.shared = how.shared;
  }
  return function.handle;
}

#undef CALL
#define CALL(name, ...) gpu_->check(#name, gpu_->driver_.name(__VA_ARGS__))

Status Stream::fill(Address to, unsigned char value, std::size_t size) {
  follows_kernel_ = false;
  return CALL(fill, to, value, size, stream_.get());
}
Status Stream::upload(Address to, const void* from, std::size_t size) {
  follows_kernel_ = false;
  return CALL(upload, to, from, size, stream_.get());
}
Status Stream::download(void* to, Address from, std::size_t size) {
  follows_kernel_ = false;
  return CALL(download, to, from, size, stream_.get());
}
Status Stream::copy(Address to, Address from, std::size_t size) {
  follows_kernel_ = false;
  return CALL(copy, to, from, size, stream_.get());
}
Status Stream::wait() { return CALL(stream_wait, stream_.get()); }

Status Stream::after(Stream& other) {
  VLA_CHECK(other.record(other.event_));
  return after(other.event_);
}
Status Stream::record(const Owned& event) { return CALL(event_record, event.get(), stream_.get()); }
Status Stream::after(const Owned& event) {
  follows_kernel_ = false;
  return CALL(stream_wait_event, stream_.get(), event.get(), 0);
}

Status Stream::note_time(const Owned& event) {
  follows_kernel_ = false;
  constexpr unsigned kExternal = 1;  // records at a node of the graph, not at a point for other streams to wait for
  return CALL(event_record_flags, event.get(), stream_.get(), kExternal);
}

Status Stream::launch_job(const Launch& how, const void* job) {
  VLA_TRY(Handle function, gpu_->kernel(how));
  if (how.cluster > 1 && !gpu_->is_hopper())
    return Error{Code::internal, how.kernel, "a Hopper", "a cluster elsewhere"};
  void* parameters[] = {const_cast<void*>(job)};  // the driver copies the job
  LaunchAttribute attributes[2] = {};
  unsigned n_attribute = 0;
  if (follows_kernel_ && gpu_->capability_ >= 90) attributes[n_attribute++] = {kOverlaps, 0, {1}};
  if (how.cluster > 1) attributes[n_attribute++] = {kCluster, 0, {std::uint64_t{1} << 32 | 1, how.cluster}};
  const LaunchConfig config = {.grid_x = how.grid.x,
                               .grid_y = how.grid.y,
                               .grid_z = how.grid.z,
                               .block_x = how.n_thread,
                               .block_y = 1,
                               .block_z = 1,
                               .shared = how.shared,
                               .stream = stream_.get(),
                               .attributes = attributes,
                               .n_attribute = n_attribute};
  follows_kernel_ = true;
  return CALL(launch, &config, function, parameters, nullptr);
}

Status Stream::begin_capture() {
  follows_kernel_ = false;
  return CALL(capture_begin, stream_.get(), kThreadLocal);
}

Result<Owned> Stream::end_capture() {
  follows_kernel_ = false;
  Handle graph = nullptr, executable = nullptr;
  const int ended = gpu_->driver_.capture_end(stream_.get(), &graph);
  VLA_TRY(const Owned recorded, gpu_->own("capture_end", ended, graph, gpu_->driver_.graph_destroy));
  const int made = gpu_->driver_.graph_instantiate(&executable, recorded.get(), 0);
  return gpu_->own("graph_instantiate", made, executable, gpu_->driver_.executable_destroy);
}

Status Stream::launch(const Owned& graph) {
  follows_kernel_ = false;
  return CALL(graph_launch, graph.get(), stream_.get());
}

#undef CALL

}  // namespace vla::cuda
