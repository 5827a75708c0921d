// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/fake_driver.h"

#include <algorithm>
#include <chrono>
#include <cstring>
#include <functional>
#include <memory>
#include <mutex>
#include <random>
#include <set>
#include <thread>
#include <vector>

#include "cuda/emulation.h"
#include "cuda/fault.h"
#include "cuda/machine.h"
#include "cuda/ptx.h"
#include "cuda/tensor_map.h"

namespace vla::test::cuda {
namespace {

using vla::cuda::Address;
using vla::cuda::Handle;

/// Something that is done after what it depends on: places of nodes in the same list.
struct Node {
  std::function<void()> run;
  std::vector<std::size_t> after;
};
using Nodes = std::vector<Node>;

struct Module {
  std::shared_ptr<const PtxModule> ptx;  // null: the host's
};
struct Function {
  const PtxKernel* ptx = nullptr;
  const Entry* entry = nullptr;
  unsigned max_shared = 48 << 10;
};
/// The nodes that what comes next in a stream comes after.
struct Stream {
  std::vector<std::size_t> last;
  bool captures = false, begins_capture = false;
  std::vector<std::size_t> kept;  // `last` of what waits, while it captures

  void begin_capture() { captures = true, kept = std::move(last), last.clear(); }
  void end_capture() { captures = begins_capture = false, last = std::move(kept), kept.clear(); }
};
struct Event {
  std::vector<std::size_t> nodes;
  bool captured = false;
  using Time = std::chrono::steady_clock::time_point;
  std::shared_ptr<Time> time;  // of events that note it
};

struct State {
  FakeDriver driver;
  bool is_lost = false;
  std::set<std::thread::id> users;  // threads that have the context
  std::thread::id capturing;        // the last that began
  std::map<Address, std::size_t> memory;
  std::map<Handle, std::unique_ptr<Stream>> streams;
  std::map<Handle, std::unique_ptr<Event>> events;
  std::map<Handle, std::unique_ptr<Module>> modules;
  std::map<Handle, std::unique_ptr<Function>> functions;
  std::map<Handle, std::shared_ptr<Nodes>> graphs;
  std::set<void*> host;
  Nodes waiting, captured;
  std::vector<bool> was_run;  // of those that wait: what others still come after
  std::minstd_rand random;
};
State state;
std::mutex calls;  // one at a time

/// Some nodes one after the other, in any order that their dependencies allow; what they depend on beside was run.
void run_some(const Nodes& nodes, const std::vector<bool>& some) {
  std::vector<std::size_t> n_before(nodes.size());
  std::vector<std::vector<std::size_t>> next(nodes.size());
  std::vector<std::size_t> ready;
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    if (!some[i]) continue;
    for (std::size_t before : nodes[i].after)
      if (some[before]) next[before].push_back(i), ++n_before[i];
    if (n_before[i] == 0) ready.push_back(i);
  }
  while (!ready.empty()) {
    std::swap(ready.back(), ready[state.random() % ready.size()]);
    const std::size_t i = ready.back();
    ready.pop_back();
    nodes[i].run();
    for (std::size_t after : next[i])
      if (--n_before[after] == 0) ready.push_back(after);
  }
}

void run_all(const Nodes& nodes) { run_some(nodes, std::vector<bool>(nodes.size(), true)); }

/// Takes everything that waits away from its streams.
Nodes take_waiting() {
  Nodes nodes;
  nodes.swap(state.waiting), state.was_run.clear();
  for (auto& [handle, stream] : state.streams) stream->captures ? stream->kept.clear() : stream->last.clear();
  for (auto& [handle, event] : state.events)
    if (!event->captured) event->nodes.clear();
  return nodes;
}
/// Runs those of it, and what they come after.
int run_waiting(std::vector<bool> wanted) {
  state.was_run.resize(state.waiting.size(), false);
  for (std::size_t i = wanted.size(); i-- > 0;) {
    for (std::size_t before : state.waiting[i].after)
      if (wanted[i]) wanted[before] = true;
    if (state.was_run[i]) wanted[i] = false;
  }
  try {
    run_some(state.waiting, wanted);
    for (std::size_t i = 0; i < wanted.size(); ++i)
      if (wanted[i]) state.was_run[i] = true;
    if (std::find(state.was_run.begin(), state.was_run.end(), false) == state.was_run.end()) take_waiting();
  } catch (const Fault& fault) {
    take_waiting();
    state.driver.fault = fault.what();
    state.is_lost = true, state.driver.failure = kLaunchFailed;
    return kLaunchFailed;
  }
  return 0;
}
int run_waiting() { return run_waiting(std::vector<bool>(state.waiting.size(), true)); }

/// A module's text is read once.
std::shared_ptr<const PtxModule> parsed(const std::string& text) {
  static std::map<std::string, std::shared_ptr<const PtxModule>> all;
  std::shared_ptr<const PtxModule>& module = all[text];
  if (!module) module = std::make_shared<const PtxModule>(text);
  return module;
}

template <class T>
T* find(std::map<Handle, std::unique_ptr<T>>& all, Handle handle) {
  const auto found = all.find(handle);
  return found == all.end() ? nullptr : found->second.get();
}
template <class T>
void give(std::map<Handle, std::unique_ptr<T>>& all, Handle* to, std::unique_ptr<T> object) {
  *to = object.get();
  all[*to] = std::move(object);
  ++state.driver.n_handle;
}
template <class Map>
int take_back(Map& all, Handle handle) {
  if (all.erase(handle) == 0) return kInvalidHandle;
  --state.driver.n_handle;
  return 0;
}

/// An operation of a stream: recorded where it captures, else it waits.
int enqueue(Handle handle, std::function<void()> run) {
  Stream* stream = find(state.streams, handle);
  if (stream == nullptr) return kInvalidHandle;
  Nodes& nodes = stream->captures ? state.captured : state.waiting;
  nodes.push_back({std::move(run), stream->last});
  stream->last = {nodes.size() - 1};
  return 0;
}
/// Whether this thread does: others may call what those that capture may not.
bool captures() {
  return state.capturing == std::this_thread::get_id() &&
         std::any_of(state.streams.begin(), state.streams.end(), [](const auto& one) { return one.second->captures; });
}
/// Whether [address, address + size) lies in one allocation.
bool is_allocated(Address address, std::size_t size) {
  auto found = state.memory.upper_bound(address);
  if (found == state.memory.begin()) return false;
  --found;
  return address + size <= found->first + found->second;
}

/// Functions of the driver, by the names of the table.
struct Calls {
  static int init(unsigned) { return 0; }
  static int error_name(int error, const char** name) {
    *name = error == kOutOfMemory      ? "CUDA_ERROR_OUT_OF_MEMORY"
            : error == kLaunchFailed   ? "CUDA_ERROR_LAUNCH_FAILED"
            : error == kInvalidCluster ? "CUDA_ERROR_INVALID_CLUSTER_SIZE"
            : error == kInvalidValue   ? "CUDA_ERROR_INVALID_VALUE"
                                       : nullptr;
    return *name ? 0 : kInvalidValue;
  }
  static int error_text(int, const char** text) { return *text = "as the test wants it", 0; }
  static int driver_version(int* version) { return *version = state.driver.version, 0; }
  static int device_count(int* count) { return *count = state.driver.n_device, 0; }
  static int device_get(int* device, int ordinal) { return *device = ordinal, 0; }
  static int device_attribute(int* value, int attribute, int) {
    if (attribute != 16 && attribute != 75 && attribute != 76) return kInvalidValue;
    *value = attribute == 16 ? state.driver.n_sm : attribute == 75 ? state.driver.major : state.driver.minor;
    return 0;
  }
  static int context_retain(Handle* context, int) { return *context = &state, ++state.driver.n_handle, 0; }
  static int context_release(int) { return --state.driver.n_handle, 0; }
  static int context_use(Handle context) {
    if (context != &state) return kInvalidContext;
    return state.users.insert(std::this_thread::get_id()), 0;
  }
  static int device_name(char* name, int size, int) {
    std::snprintf(name, static_cast<std::size_t>(size), "a GPU of tests");
    return 0;
  }
  static int memory_size(std::size_t* size, int) { return *size = state.driver.memory, 0; }

  static int memory_info(std::size_t* free, std::size_t* total) {
    *total = state.driver.memory, *free = state.driver.memory - state.driver.used;
    return 0;
  }
  static int allocate(Address* address, std::size_t size) {
    if (captures()) return kCaptureUnsupported;
    if (size == 0) return kInvalidValue;
    if (size > state.driver.memory - state.driver.used) return kOutOfMemory;
    *address = reinterpret_cast<Address>(device_memory().allocate(size));
    if (!state.driver.computes) std::memset(reinterpret_cast<void*>(*address), 0, size);
    state.memory[*address] = size, state.driver.used += size;
    return 0;
  }
  static int release(Address address) {
    const auto found = state.memory.find(address);
    if (found == state.memory.end()) return kInvalidValue;
    run_waiting();  // as the driver does: nothing that runs loses its memory
    device_memory().release(reinterpret_cast<void*>(address));
    state.driver.used -= found->second;
    state.memory.erase(found);
    return 0;
  }
  static int host_allocate(void** memory, std::size_t size, unsigned) {
    *memory = std::malloc(size);
    state.host.insert(*memory), ++state.driver.n_handle;
    return 0;
  }
  static int host_release(void* memory) {
    if (state.host.erase(memory) == 0) return kInvalidValue;
    run_waiting();  // as for memory of the device
    std::free(memory);
    return --state.driver.n_handle, 0;
  }
  static int fill(Address to, unsigned char value, std::size_t size, Handle stream) {
    if (!is_allocated(to, size)) return kInvalidValue;
    return enqueue(stream, [=] { std::memset(reinterpret_cast<void*>(to), value, size); });
  }
  static int upload(Address to, const void* from, std::size_t size, Handle stream) {
    if (!is_allocated(to, size)) return kInvalidValue;
    return enqueue(stream, [=] { std::memcpy(reinterpret_cast<void*>(to), from, size); });
  }
  static int download(void* to, Address from, std::size_t size, Handle stream) {
    if (!is_allocated(from, size)) return kInvalidValue;
    return enqueue(stream, [=] { std::memcpy(to, reinterpret_cast<const void*>(from), size); });
  }

  static int copy(Address to, Address from, std::size_t size, Handle stream) {
    if (!is_allocated(to, size) || !is_allocated(from, size)) return kInvalidValue;
    return enqueue(stream,
                   [=] { std::memcpy(reinterpret_cast<void*>(to), reinterpret_cast<const void*>(from), size); });
  }

  static int stream_create(Handle* stream, unsigned) {
    return give(state.streams, stream, std::make_unique<Stream>()), 0;
  }
  static int stream_destroy(Handle stream) { return take_back(state.streams, stream); }
  static int stream_wait(Handle handle) {
    Stream* stream = find(state.streams, handle);
    if (stream == nullptr) return kInvalidHandle;
    if (captures()) return kCaptureUnsupported;
    // A device may be ahead with everything else, or have done nothing of it.
    std::vector<bool> wanted(state.waiting.size(), state.random() % 2 == 0);
    for (std::size_t node : stream->last) wanted[node] = true;
    return run_waiting(std::move(wanted));
  }
  static int stream_wait_event(Handle handle, Handle of, unsigned) {
    Stream* stream = find(state.streams, handle);
    const Event* event = find(state.events, of);
    if (stream == nullptr || event == nullptr) return kInvalidHandle;
    if (event->captured && !stream->captures) stream->begin_capture();
    if (event->captured != stream->captures) return kCaptureUnsupported;
    for (std::size_t node : event->nodes)
      if (std::find(stream->last.begin(), stream->last.end(), node) == stream->last.end()) stream->last.push_back(node);
    return 0;
  }
  static int event_create(Handle* event, unsigned flags) {
    constexpr unsigned kNoTiming = 2;
    auto made = std::make_unique<Event>();
    if (flags != kNoTiming) made->time = std::make_shared<Event::Time>();
    return give(state.events, event, std::move(made)), 0;
  }
  static int event_record(Handle of, Handle handle) {
    Event* event = find(state.events, of);
    const Stream* stream = find(state.streams, handle);
    if (stream == nullptr || event == nullptr) return kInvalidHandle;
    event->nodes = stream->last, event->captured = stream->captures;
    return 0;
  }
  /// As a node of a graph.
  static int event_record_flags(Handle of, Handle handle, unsigned flags) {
    const Event* event = find(state.events, of);
    const Stream* stream = find(state.streams, handle);
    if (event == nullptr || event->time == nullptr || stream == nullptr) return kInvalidHandle;
    if (flags != 1 || !stream->captures) return kInvalidValue;
    return enqueue(handle, [time = event->time] { *time = std::chrono::steady_clock::now(); });
  }
  static int event_elapsed(float* ms, Handle first, Handle second) {
    const Event *from = find(state.events, first), *to = find(state.events, second);
    if (from == nullptr || to == nullptr || from->time == nullptr || to->time == nullptr) return kInvalidHandle;
    if (*from->time == Event::Time() || *to->time == Event::Time()) return kInvalidHandle;  // not noted yet
    return *ms = std::chrono::duration<float, std::milli>(*to->time - *from->time).count(), 0;
  }
  static int event_destroy(Handle event) { return take_back(state.events, event); }

  static int module_load(Handle* to, const void* image, unsigned n_option, int* options, void** values) {
    if (captures()) return kCaptureUnsupported;
    auto module = std::make_unique<Module>();
    const std::string text = static_cast<const char*>(image);
    const bool is_machine_code = text.starts_with('\x7f');
    state.driver.images.push_back(text.substr(0, 32));
    if (is_machine_code && !state.driver.takes_machine_code) return kInvalidImage;
    try {
      if (text != kHostModule && !is_machine_code) module->ptx = parsed(text);
    } catch (const Fault& fault) {
      state.driver.fault = fault.what();
      write_log(fault.what(), n_option, options, values);
      return kInvalidPtx;
    }
    return give(state.modules, to, std::move(module)), 0;
  }
  static int module_unload(Handle module) { return take_back(state.modules, module); }
  static int module_function(Handle* to, Handle handle, const char* name) {
    if (captures()) return kCaptureUnsupported;
    const Module* module = find(state.modules, handle);
    if (module == nullptr) return kInvalidHandle;
    auto function = std::make_unique<Function>();
    module->ptx ? void(function->ptx = module->ptx->find(name)) : void(function->entry = find_entry(name));
    if (function->ptx == nullptr && function->entry == nullptr) return kNotFound;
    *to = function.get();
    state.functions[*to] = std::move(function);
    return 0;
  }
  static int function_attribute(Handle handle, int attribute, int value) {
    if (captures()) return kCaptureUnsupported;
    Function* function = find(state.functions, handle);
    if (function == nullptr) return kInvalidHandle;
    if (attribute != 8 || value < 0 || static_cast<unsigned>(value) > vla::cuda::kHopperShared) return kInvalidValue;
    function->max_shared = static_cast<unsigned>(value);
    return 0;
  }
  static int launch(const vla::cuda::LaunchConfig* config, Handle handle, void** parameters, void** extra) {
    const auto [x, y, z, n_thread, block_y, block_z, shared, stream, attributes, n_attribute] = *config;
    const Function* function = find(state.functions, handle);
    if (function == nullptr) return kInvalidHandle;
    const unsigned most = vla::cuda::kMaxGridYZ;
    unsigned cluster = 1;
    if (shared > function->max_shared || block_y != 1 || block_z != 1 || extra != nullptr || x == 0 || y == 0 ||
        z == 0 || y > most || z > most || !are_known(attributes, n_attribute, cluster))
      return kInvalidValue;
    if (cluster == 0 || cluster > vla::cuda::kMaxCluster || z % cluster != 0) return kInvalidCluster;
    const std::string name = function->ptx ? function->ptx->name : function->entry->name;
    state.driver.launched.insert(name);
    if (cluster > 1) state.driver.in_clusters.insert(name);
    const std::size_t size = function->ptx ? function->ptx->param_size : function->entry->job_size;
    if (!state.driver.computes) return enqueue(stream, [] {});
    const auto* from = static_cast<const std::byte*>(parameters[0]);
    const std::vector<std::byte> bytes(from, from + size);
    // A job is aligned as its type is, at most as a tensor map.
    return enqueue(stream, [=] {
      constexpr std::size_t kAlign = alignof(vla::cuda::TensorMap);
      const std::unique_ptr<void, decltype(&std::free)> job(
          std::aligned_alloc(kAlign, (size + kAlign - 1) / kAlign * kAlign), std::free);
      std::copy(bytes.begin(), bytes.end(), static_cast<std::byte*>(job.get()));
      device_memory().begin_launch();
      const Extent grid = {x, y, z, cluster};
      function->ptx ? run_ptx(*function->ptx, grid, n_thread, shared, job.get())
                    : run_entry(*function->entry, grid, n_thread, shared, job.get());
    });
  }

  static int capture_begin(Handle handle, int) {
    Stream* stream = find(state.streams, handle);
    if (stream == nullptr) return kInvalidHandle;
    if (captures()) return kCaptureUnsupported;
    state.captured.clear();
    stream->begin_capture();
    stream->begins_capture = true, state.capturing = std::this_thread::get_id();
    return 0;
  }
  static int capture_end(Handle handle, Handle* graph) {
    const Stream* begun = find(state.streams, handle);
    if (begun == nullptr || !begun->begins_capture) return kInvalidHandle;
    // Everything must come before the end of the stream that began.
    std::vector<bool> before(state.captured.size());
    for (std::size_t node : begun->last) before[node] = true;
    for (std::size_t i = state.captured.size(); i-- > 0;)
      for (std::size_t node : state.captured[i].after)
        if (before[i]) before[node] = true;
    const bool joined = std::find(before.begin(), before.end(), false) == before.end();
    for (auto& [other, stream] : state.streams) {
      if (stream->captures) stream->end_capture();
    }
    if (!joined) return *graph = nullptr, kCaptureUnjoined;
    auto nodes = std::make_shared<Nodes>(std::move(state.captured));
    state.captured.clear();
    return keep(graph, nodes);
  }
  static int graph_instantiate(Handle* executable, Handle graph, std::uint64_t) {
    const auto found = state.graphs.find(graph);
    return found == state.graphs.end() ? kInvalidHandle : keep(executable, std::make_shared<Nodes>(*found->second));
  }
  static int graph_launch(Handle executable, Handle stream) {
    const auto found = state.graphs.find(executable);
    if (found == state.graphs.end()) return kInvalidHandle;
    return enqueue(stream, [nodes = found->second] { run_all(*nodes); });
  }
  static int graph_destroy(Handle graph) { return take_back(state.graphs, graph); }
  static int executable_destroy(Handle executable) { return take_back(state.graphs, executable); }
  /// Refuses what the driver refuses, and what a machine of tests does not know.
  static int tensor_map(void* map, int type, unsigned n_dimension, void* address, const std::uint64_t* sizes,
                        const std::uint64_t* strides, const unsigned* box, const unsigned* steps, int interleave,
                        int swizzle, int promotion, int fill) {
    constexpr int kBf16 = 9, kSwizzle32 = 1, kSwizzle128 = 3;
    constexpr std::uint64_t kMostSize = std::uint64_t{1} << 32, kMostStride = std::uint64_t{1} << 40, kElement = 2;
    const auto is_aligned = [](const void* p, std::uintptr_t to) {
      return p != nullptr && reinterpret_cast<std::uintptr_t>(p) % to == 0;
    };
    if (!is_aligned(map, 64) || !is_aligned(address, 16)) return kInvalidValue;
    if (type != kBf16 || (n_dimension != 2 && n_dimension != 4) || interleave != 0 || fill != 0) return kInvalidValue;
    if (promotion < 0 || promotion > 3 || (swizzle != kSwizzle32 && swizzle != kSwizzle128)) return kInvalidValue;
    TensorMapFields of = {.n_dimension = n_dimension, .address = reinterpret_cast<std::uint64_t>(address)};
    of.stride[0] = kElement;
    for (unsigned i = 0; i < n_dimension; ++i) {
      if (sizes[i] == 0 || sizes[i] > kMostSize || box[i] == 0 || box[i] > 256 || steps[i] != 1) return kInvalidValue;
      of.size[i] = sizes[i], of.box[i] = static_cast<std::uint16_t>(box[i]);
      if (i == 0) continue;
      const std::uint64_t before = of.stride[i - 1], stride = of.stride[i] = strides[i - 1];
      if (stride % 16 != 0 || stride >= kMostStride || stride % before != 0) return kInvalidValue;
      if (stride < before * sizes[i - 1]) return kInvalidValue;
    }
    if (box[0] * kElement % 16 != 0 || box[0] * kElement > (swizzle == kSwizzle32 ? 32 : 128)) return kInvalidValue;
    std::memset(map, 0, sizeof(vla::cuda::TensorMap));
    std::memcpy(map, &of, sizeof(of));
    return 0;
  }

 private:
  /// Whether attributes of a launch are known: that it may begin while the kernel before it ends, and its blocks of a
  /// cluster in z, both from Hopper on. Kernels of the machine run one after the other all the same.
  static bool are_known(const vla::cuda::LaunchAttribute* attributes, unsigned n, unsigned& cluster) {
    for (unsigned i = 0; i < n; ++i) {
      const auto& [id, padding, value] = attributes[i];
      if (state.driver.major < 9 || (id != 4 && id != 6)) return false;
      if (id == 4 && (value[0] != (1ULL << 32 | 1) || value[1] >> 32 != 0)) return false;
      if (id == 4) cluster = static_cast<unsigned>(value[1]);
    }
    return true;
  }
  /// What the compiler says, where the options ask for it: 5 the room for its errors, 6 how many bytes that has.
  static void write_log(const char* text, unsigned n_option, const int* options, void* const* values) {
    char* room = nullptr;
    std::size_t size = 0;
    for (unsigned i = 0; i < n_option; ++i) {
      if (options[i] == 5) room = static_cast<char*>(values[i]);
      if (options[i] == 6) size = reinterpret_cast<std::size_t>(values[i]);
    }
    if (room != nullptr) std::snprintf(room, size, "ptxas application ptx input; %s\n", text);
  }
  static int keep(Handle* to, const std::shared_ptr<Nodes>& nodes) {
    *to = nodes.get();
    state.graphs[*to] = nodes, ++state.driver.n_handle;
    return 0;
  }
};

bool has_word(const std::string& symbol, std::initializer_list<const char*> words) {
  return std::any_of(words.begin(), words.end(),
                     [&](const char* word) { return symbol.find(word) != std::string::npos; });
}

/// Counts a call, and fails it where it is told to. What is given back is given back, whatever is answered.
template <auto kCall, class... Args>
int counted(const std::string& symbol, Args... args) {
  const std::lock_guard<std::mutex> lock(calls);
  ++state.driver.n_call[symbol];
  if (state.driver.logs) state.driver.log.push_back(symbol);
  if (state.driver.counts != nullptr)
    std::fprintf(state.driver.counts, "%s\n", symbol.c_str()), std::fflush(state.driver.counts);
  const bool fails = ++state.driver.n_calls == state.driver.fail_at;
  if (fails) state.driver.failed_call = symbol, state.is_lost = state.driver.is_lost_then;
  if (fails || state.is_lost) {
    take_waiting();  // nothing runs on: whoever sees the failure gives back what operations would read
    if (has_word(symbol, {"Free", "Destroy", "Unload", "Release"})) kCall(args...);
    return state.driver.failure;
  }
  if (!has_word(symbol, {"cuInit", "cuDriver", "cuDevice", "cuCtx"}) &&
      !state.users.contains(std::this_thread::get_id()))
    return kInvalidContext;
  const int result = kCall(args...);
  if (result != 0) state.driver.refused.push_back(symbol);
  return result;
}

}  // namespace

FakeDriver& fake_driver() { return state.driver; }

void reset_fake_driver() {
  state.waiting.clear();
  while (!state.memory.empty()) {
    device_memory().release(reinterpret_cast<void*>(state.memory.begin()->first));
    state.memory.erase(state.memory.begin());
  }
  for (void* memory : state.host) std::free(memory);
  state = {};
}

vla::cuda::Driver tensor_map_driver() {
  vla::cuda::Driver table;
  table.tensor_map = Calls::tensor_map, table.error_name = Calls::error_name, table.error_text = Calls::error_text;
  return table;
}

vla::cuda::Driver fake_driver_table() {
  vla::cuda::Driver table;
#define VLA_CUDA_CALL(name, symbol, ...) \
  table.name = [](auto... args) { return counted<&Calls::name>(#symbol, args...); };
  VLA_CUDA_CALLS(VLA_CUDA_CALL)
#undef VLA_CUDA_CALL
  table.error_name = Calls::error_name, table.error_text = Calls::error_text;  // asked about failures, so not counted
  return table;
}

}  // namespace vla::test::cuda
