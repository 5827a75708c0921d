// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/bundle.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#include <xxhash.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <utility>

#include "bundle/gguf_reader.h"

namespace vla {
namespace {

constexpr int kBundleVersion = 1;
constexpr std::string_view kChecksumKey = "vla.checksum";
constexpr std::string_view kChecksumPrefix = "xxh3:";
constexpr std::size_t kDigits = 16;

Error io_error(const std::string& path, const char* what) { return {Code::io, path, what, std::strerror(errno)}; }

/// Bytes of an opened file, and what keeps them in memory.
struct Content {
  std::shared_ptr<const void> owner;
  std::span<const std::byte> bytes;
};

struct File {
  int descriptor;
  std::size_t size = 0;

  explicit File(int fd) : descriptor(fd) {}
  File(File&& other) noexcept : descriptor(std::exchange(other.descriptor, -1)), size(other.size) {}
  ~File() {
    if (descriptor >= 0) ::close(descriptor);
  }
};

Result<File> open_file(const std::string& path) {
  // O_NONBLOCK: opening a pipe would wait for its writer; a file is not affected.
  File file(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  if (file.descriptor < 0) return io_error(path, "a readable bundle");
  struct stat info = {};
  if (::fstat(file.descriptor, &info) != 0 || !S_ISREG(info.st_mode))
    return Error{Code::io, path, "a file", "something that is not a regular file"};
  file.size = static_cast<std::size_t>(info.st_size);
  if (file.size > 0) return file;
  return Error{Code::bad_bundle, path, "a GGUF file", "an empty file", "copy or convert it again"};
}

/// `file` -1: memory without a file, to be written.
Result<Content> map(int file, std::size_t size, const std::string& path) {
  const int protection = file < 0 ? PROT_READ | PROT_WRITE : PROT_READ;
  void* memory = ::mmap(nullptr, size, protection, file < 0 ? MAP_PRIVATE | MAP_ANONYMOUS : MAP_PRIVATE, file, 0);
  if (memory == MAP_FAILED) {
    if (errno != ENOMEM) return io_error(path, "a file that can be mapped");
    return Error{Code::out_of_memory, path, fmt::format("{} bytes of memory", size), "less",
                 "free memory or use a smaller model"};
  }
  return Content{{memory, [size](void* pointer) { ::munmap(pointer, size); }},
                 {static_cast<const std::byte*>(memory), size}};
}

Result<Content> copy(const File& file, const std::string& path) {
  VLA_TRY(Content content, map(-1, file.size, path));
  auto* bytes = const_cast<std::byte*>(content.bytes.data());
  for (std::size_t done = 0; done < file.size;) {
    const ssize_t got = ::read(file.descriptor, bytes + done, file.size - done);
    if (got < 0 && errno == EINTR) continue;
    if (got < 0) return io_error(path, "a readable bundle");
    if (got == 0)
      return Error{Code::bad_bundle, path, fmt::format("a file of {} bytes", file.size),
                   fmt::format("one that ended at {} while it was read", done),
                   "replace a bundle by renaming a new file over it"};
    done += static_cast<std::size_t>(got);
  }
  return content;
}

/// XXH3-64 of the file with the digits at `digits` read as zeros.
std::string file_checksum(std::span<const std::byte> bytes, std::size_t digits) {
  constexpr char kZeros[kDigits + 1] = "0000000000000000";
  const std::unique_ptr<XXH3_state_t, decltype(&XXH3_freeState)> state(XXH3_createState(), XXH3_freeState);
  XXH3_64bits_reset(state.get());
  XXH3_64bits_update(state.get(), bytes.data(), digits);
  XXH3_64bits_update(state.get(), kZeros, kDigits);
  XXH3_64bits_update(state.get(), bytes.data() + digits + kDigits, bytes.size() - digits - kDigits);
  return fmt::format("{:016x}", XXH3_64bits_digest(state.get()));
}

Status check_sum(std::span<const std::byte> bytes, const Keys& keys, const std::string& name) {
  VLA_TRY(const std::string stated, keys.string(kChecksumKey));
  if (stated.size() != kChecksumPrefix.size() + kDigits || !stated.starts_with(kChecksumPrefix))
    return Error{Code::bad_bundle, name + ": " + std::string(kChecksumKey), "xxh3: and 16 hex digits", stated};
  // The digits are found by their key, whose text occurs once before them: any other place would not hash to them.
  const std::string_view text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  const std::size_t key = text.find(kChecksumKey);
  const std::size_t digits = text.find(stated, key) + kChecksumPrefix.size();
  const std::string found = file_checksum(bytes, digits);
  if (stated.ends_with(found)) return {};
  return Error{Code::bad_bundle, name, "content with checksum " + stated, std::string(kChecksumPrefix) + found,
               "the file was damaged or edited: copy or convert it again"};
}

Status check_version(const Keys& keys, const std::string& name) {
  VLA_TRY(const int version, keys.integer("vla.bundle_version", kAnySize));
  if (version == kBundleVersion) return {};
  return Error{Code::bad_bundle, name + ": vla.bundle_version", std::to_string(kBundleVersion), std::to_string(version),
               version < kBundleVersion ? "run vla-convert again" : "this bundle needs a newer vla"};
}

/// Every answer and every report names where the weights come from.
Status check_identity(const Keys& keys) {
  for (const char* key : {"vla.arch", "vla.source.name", "vla.source.revision", "vla.source.converter"})
    if (const auto text = keys.string(key); !text) return text.error();
  VLA_TRY(const std::string dtype, keys.string("vla.dtype"));
  if (dtype == "f32" || dtype == "bf16" || dtype == "f16") return {};
  return Error{Code::bad_bundle, "vla.dtype", "f32, bf16 or f16", dtype};
}

}  // namespace

const char* dtype_name(DType type) {
  constexpr const char* kNames[] = {"f32", "f16", "bf16", "i32", "i8", "f64"};
  return kNames[static_cast<int>(type)];
}

std::size_t dtype_size(DType type) {
  constexpr std::size_t kSizes[] = {4, 2, 2, 4, 1, 8};
  return kSizes[static_cast<int>(type)];
}

std::int64_t TensorInfo::count() const {
  std::int64_t product = 1;
  for (std::int64_t dim : shape) product *= dim;
  return product;
}

Result<Bundle> Bundle::open(const std::string& path, Access access) {
  VLA_TRY(const File file, open_file(path));
  VLA_TRY(Content content, access == Access::map ? map(file.descriptor, file.size, path) : copy(file, path));
  VLA_TRY(Bundle bundle, parse(content.bytes, path));
  bundle.access_ = access;
  bundle.mapping_ = std::move(content.owner);
  if (access == Access::map) bundle.release_pages(bundle.bytes_);  // the checksum has read them all
  return bundle;
}

Result<Bundle> Bundle::parse(std::span<const std::byte> bytes, std::string name) {
  VLA_TRY(GgufContent content, read_gguf(bytes, name));
  if (!content.keys.has("vla.bundle_version"))
    return Error{Code::bad_bundle, name, "a vla bundle", "a GGUF file of another kind",
                 "make a bundle with vla-convert"};
  VLA_CHECK(check_version(content.keys, name));
  VLA_CHECK(check_sum(bytes, content.keys, name));
  VLA_CHECK(check_identity(content.keys));
  Bundle bundle;
  bundle.path_ = std::move(name);
  bundle.bytes_ = bytes;
  bundle.keys_ = std::move(content.keys);
  bundle.tensors_ = std::move(content.tensors);
  for (std::size_t i = 0; i < bundle.tensors_.size(); ++i) bundle.index_.emplace(bundle.tensors_[i].name, i);
  return bundle;
}

void Bundle::release_pages(std::span<const std::byte> part) const {
  if (!mapping_ || part.empty()) return;
  const auto page = static_cast<std::size_t>(::sysconf(_SC_PAGESIZE));
  const auto offset = static_cast<std::size_t>(part.data() - bytes_.data()), first = (offset + page - 1) / page * page;
  const std::size_t last = (offset + part.size()) / page * page;
  if (first >= last) return;
  std::byte* start = const_cast<std::byte*>(bytes_.data()) + first;
  ::madvise(start, last - first, MADV_DONTNEED);
  if (access_ == Access::copy) ::mprotect(start, last - first, PROT_NONE);  // zeros would pass for weights
}

void Bundle::keep_pages(std::span<const std::byte> part) const {
  if (!mapping_ || part.empty() || access_ == Access::copy) return;
  const auto page = static_cast<std::size_t>(::sysconf(_SC_PAGESIZE));
  const std::size_t first = static_cast<std::size_t>(part.data() - bytes_.data()) / page * page;
  const std::size_t last = static_cast<std::size_t>(part.data() - bytes_.data()) + part.size();
#ifdef MADV_POPULATE_READ
  if (::madvise(const_cast<std::byte*>(bytes_.data()) + first, last - first, MADV_POPULATE_READ) == 0) return;
#endif
  for (std::size_t i = first; i < last; i += page)
    static_cast<void>(*static_cast<const volatile std::byte*>(&bytes_[i]));
}

const TensorInfo* Bundle::find(std::string_view name) const {
  const auto found = index_.find(std::string(name));
  return found != index_.end() ? &tensors_[found->second] : nullptr;
}

Result<std::vector<double>> Bundle::stats(std::string_view name) const {
  const std::string where = path_ + ": tensor " + std::string(name);
  const TensorInfo* tensor = find(name);
  if (tensor == nullptr)
    return Error{Code::bad_bundle, where, "statistics", "no such tensor", "convert the checkpoint again"};
  const bool is_wide = tensor->type == DType::f64;
  if ((tensor->type != DType::f32 && !is_wide) || tensor->shape.empty() || tensor->shape.size() > 2)
    return Error{Code::bad_bundle, where, "a one- or two-dimensional f32 or f64 tensor",
                 fmt::format("{} dimensions of {}", tensor->shape.size(), dtype_name(tensor->type))};
  std::vector<double> values(static_cast<std::size_t>(tensor->count()));
  std::vector<float> narrow(is_wide ? 0 : values.size());
  std::memcpy(is_wide ? static_cast<void*>(values.data()) : narrow.data(), tensor->data.data(), tensor->data.size());
  std::copy(narrow.begin(), narrow.end(), values.begin());
  for (const double value : values)
    if (!std::isfinite(value)) return Error{Code::bad_bundle, where, "finite numbers", fmt::format("{}", value)};
  return values;
}

}  // namespace vla
