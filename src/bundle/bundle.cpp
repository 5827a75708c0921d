// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/bundle.h"

#include <fmt/format.h>
#include <fmt/ranges.h>
#include <xxhash.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <set>
#include <utility>

#include "bundle/gguf_reader.h"

namespace vla {
namespace {

constexpr int kBundleVersion = 1;
constexpr std::string_view kChecksumKey = "vla.checksum";
constexpr std::string_view kChecksumPrefix = "xxh3:";
constexpr std::size_t kDigits = 16;
constexpr std::string_view kEmbodimentsKey = "embodiments", kEmbodimentPrefix = "embodiment.";

constexpr std::size_t kMaxRobots = 64;  // published checkpoints use up to 32
constexpr std::size_t kMaxTag = 256;    // bytes; the longest tag that a request can carry

/// XXH3-64 of a file that arrives in parts. The checksum's own digits, at byte `digits`, count as '0'.
class Checksum {
 public:
  explicit Checksum(std::size_t digits) : digits_(digits), state_(XXH3_createState(), XXH3_freeState) {
    XXH3_64bits_reset(state_.get());
  }
  void add(std::span<const std::byte> part) {
    take(part, digits_, false);
    take(part, digits_ + kDigits, true);
    take(part, std::string::npos, false);
  }
  std::string text() const { return fmt::format("{:016x}", XXH3_64bits_digest(state_.get())); }

 private:
  /// Hashes the bytes of `part` up to the file's byte `end`, or as many characters '0', and removes them from `part`.
  void take(std::span<const std::byte>& part, std::size_t end, bool as_zeros) {
    constexpr char kZeros[kDigits + 1] = "0000000000000000";
    const std::size_t size = done_ < end ? std::min(part.size(), end - done_) : 0;
    XXH3_64bits_update(state_.get(), as_zeros ? static_cast<const void*>(kZeros) : part.data(), size);
    part = part.subspan(size), done_ += size;
  }

  std::size_t digits_, done_ = 0;
  std::unique_ptr<XXH3_state_t, decltype(&XXH3_freeState)> state_;
};

Status check_sum(Content& content, const Keys& keys, const std::string& name) {
  VLA_TRY(const std::string stated, keys.string(kChecksumKey));
  if (stated.size() != kChecksumPrefix.size() + kDigits || !stated.starts_with(kChecksumPrefix))
    return Error{Code::bad_bundle, name + ": " + std::string(kChecksumKey), "xxh3: and 16 hex digits", stated};
  // Finds the digits by their key. If a copy of them stands earlier in the file, the hash differs and the bundle is
  // refused.
  const std::string_view text(reinterpret_cast<const char*>(content.shown().data()), content.shown().size());
  const std::size_t key = text.find(kChecksumKey);
  Checksum checksum(text.find(stated, key) + kChecksumPrefix.size());
  VLA_CHECK(content.seal([&](std::span<const std::byte> part) { checksum.add(part); }));
  const std::string found = checksum.text();
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

/// Checks the keys that identify the weights; every answer and report contains them.
Status check_identity(const Keys& keys) {
  for (const char* key : {"vla.arch", "vla.source.name", "vla.source.revision", "vla.source.converter"})
    if (const auto text = keys.string(key); !text) return text.error();
  VLA_TRY(const std::string dtype, keys.string("vla.dtype"));
  if (dtype == "f32" || dtype == "bf16" || dtype == "f16" || dtype == "int8" || dtype == "int4") return {};
  return Error{Code::bad_bundle, "vla.dtype", "f32, bf16, f16, int8 or int4", dtype};
}

Status check_tags(const std::vector<std::string>& tags, const std::string& where) {
  const std::set<std::string> unique(tags.begin(), tags.end());
  if (tags.size() < 2 || tags.size() > kMaxRobots)
    return Error{Code::bad_bundle, where, fmt::format("2 to {} tags", kMaxRobots), std::to_string(tags.size())};
  for (const std::string& tag : tags)
    if (tag.empty() || tag.size() > kMaxTag || tag.find('.') != std::string::npos)
      return Error{Code::bad_bundle, where, fmt::format("tags of 1 to {} bytes without a dot", kMaxTag),
                   "\"" + tag.substr(0, kMaxTag) + "\""};
  if (unique.size() == tags.size()) return {};
  return Error{Code::bad_bundle, where, "different tags", fmt::format("{}", fmt::join(tags, ", "))};
}

/// Splits a name of the form embodiment.<tag>.<name> into tag and name. Both are empty for other names.
std::pair<std::string, std::string> split_name(const std::string& name) {
  if (!name.starts_with(kEmbodimentPrefix)) return {};
  const std::size_t first = kEmbodimentPrefix.size(), dot = std::min(name.find('.', first), name.size());
  return {name.substr(first, dot - first), name.substr(std::min(dot + 1, name.size()))};
}

/// Checks a key or tensor of one robot: its tag is listed, and no shared key or tensor has the same name.
Status check_own_name(const std::string& full, const std::vector<std::string>& tags,
                      const std::function<bool(const std::string&)>& is_shared, const std::string& where) {
  if (!full.starts_with(kEmbodimentPrefix)) return {};
  const auto [tag, name] = split_name(full);
  if (std::find(tags.begin(), tags.end(), tag) == tags.end() || name.empty())
    return Error{Code::bad_bundle, where + full,
                 tags.empty() ? "no such name, since there is no key embodiments"
                              : fmt::format("embodiment.<tag>.<name> with a tag of {}", fmt::join(tags, ", ")),
                 name.empty() ? "no name" : "tag " + tag, "convert the checkpoint again"};
  if (!is_shared(name)) return {};
  return Error{Code::bad_bundle, where + full, "a name that is not shared by all robots", "both", "convert it again"};
}

/// Checks the list of robots, and that no robot's own key or tensor has the name of a shared one.
Result<std::vector<std::string>> read_embodiments(const GgufContent& content, const std::string& name) {
  std::vector<std::string> tags;
  if (content.keys.has(kEmbodimentsKey)) {
    VLA_TRY(tags, content.keys.strings(kEmbodimentsKey));
    VLA_CHECK(check_tags(tags, name + ": " + std::string(kEmbodimentsKey)));
  }
  const auto is_key = [&](const std::string& key) { return content.keys.has(key); };
  for (const auto& [key, value] : content.keys.all()) VLA_CHECK(check_own_name(key, tags, is_key, name + ": "));
  std::set<std::string> names;
  for (const TensorInfo& tensor : content.tensors) names.insert(tensor.name);
  const auto is_tensor = [&](const std::string& tensor) { return names.contains(tensor); };
  for (const TensorInfo& tensor : content.tensors)
    VLA_CHECK(check_own_name(tensor.name, tags, is_tensor, name + ": tensor "));
  return tags;
}

}  // namespace

std::int64_t TensorInfo::count() const {
  std::int64_t product = 1;
  for (std::int64_t dim : shape) product *= dim;
  return product;
}

Result<Bundle> Bundle::open(const std::string& path) {
  VLA_TRY(const std::shared_ptr<Content> content, Content::open(path));
  return parse(content, path);
}

Result<Bundle> Bundle::parse(std::span<const std::byte> bytes, std::string name) {
  return parse(std::make_shared<Content>(bytes), std::move(name));
}

Result<Bundle> Bundle::parse(const std::shared_ptr<Content>& content, std::string name) {
  VLA_TRY(GgufContent parsed, read_gguf(content->bytes(), name, [&](std::size_t n) { return content->show(n); }));
  if (!parsed.keys.has("vla.bundle_version"))
    return Error{Code::bad_bundle, name, "a vla bundle", "a GGUF file of another kind",
                 "make a bundle with vla-convert"};
  VLA_CHECK(check_version(parsed.keys, name));
  VLA_CHECK(check_sum(*content, parsed.keys, name));
  VLA_CHECK(check_identity(parsed.keys));
  VLA_TRY(std::vector<std::string> embodiments, read_embodiments(parsed, name));
  Bundle bundle;
  bundle.path_ = std::move(name);
  bundle.content_ = content;
  bundle.keys_ = std::move(parsed.keys);
  bundle.tensors_ = std::move(parsed.tensors);
  bundle.embodiments_ = std::move(embodiments);
  bundle.index();
  return bundle;
}

void Bundle::index() {
  index_.clear();
  for (std::size_t i = 0; i < tensors_.size(); ++i) index_.emplace(tensors_[i].name, i);
}

Status Bundle::choose(const std::string& tag) {
  if (embodiments_.empty()) {
    if (tag.empty()) return {};
    return Error{Code::usage, "embodiment", "none, since " + path_ + " is for one robot, which it does not name", tag,
                 "leave it out"};
  }
  if (std::find(embodiments_.begin(), embodiments_.end(), tag) == embodiments_.end())
    return Error{Code::usage, "embodiment", fmt::format("one of {}", fmt::join(embodiments_, ", ")),
                 tag.empty() ? "none" : tag, path_ + " is for several robots: name yours"};
  embodiment_ = tag;
  std::map<std::string, Value, std::less<>> values;
  for (const auto& [key, value] : keys_.all())
    if (const auto [owner, name] = split_name(key); owner == tag || (owner.empty() && key != kEmbodimentsKey))
      values.emplace(owner.empty() ? key : name, value);
  keys_ = Keys(std::move(values));
  std::vector<TensorInfo> tensors;
  for (TensorInfo& tensor : tensors_) {
    const auto [owner, name] = split_name(tensor.name);
    if (!owner.empty() && owner != tag) continue;
    if (!owner.empty()) tensor.name = name;
    tensors.push_back(std::move(tensor));
  }
  tensors_ = std::move(tensors);
  index();
  return {};
}

Result<std::span<const std::byte>> Bundle::read(std::span<const std::byte> part, ReadBuffer& buffer) const {
  if (const std::byte* bytes = content_->read(part, buffer)) return std::span(bytes, part.size());
  return content_->changed();
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
  ReadBuffer buffer;
  VLA_TRY(const std::span<const std::byte> data, read(tensor->data, buffer));
  std::memcpy(is_wide ? static_cast<void*>(values.data()) : narrow.data(), data.data(), data.size());
  std::copy(narrow.begin(), narrow.end(), values.begin());
  for (const double value : values)
    if (!std::isfinite(value)) return Error{Code::bad_bundle, where, "finite numbers", fmt::format("{}", value)};
  return values;
}

}  // namespace vla
