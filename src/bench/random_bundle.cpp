// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/random_bundle.h"

#include <fmt/format.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>

#include "base/file.h"
#include "base/process.h"
#include "bundle/gguf_writer.h"
#include "policies/policy.h"

namespace vla::bench {
namespace {

constexpr int kRobot = 7;  // joints of the robot in the features

std::vector<std::string> numbered(const std::string& name, int count) {
  std::vector<std::string> names;
  for (int i = 0; i < count; ++i) names.push_back(fmt::format("{}{}", name, i));
  return names;
}

/// The positions of the views' tokens in a prompt, for networks that read them among text.
struct ViewPlaces {
  int count = 0;   // 0: the network takes images separately
  int repeat = 0;  // tokens per view
  bool behind = false;

  static constexpr const char *kStarts = "policy.view_starts", *kStartsFromEnd = "policy.view_starts_from_end";

  static constexpr std::string_view kOpen = "View {i}: ", kToken = "<view>", kClose = "\n";

  /// Tokens of `kOpen`. Every byte is a token and there are at most nine places, so `{i}` is one token.
  int open_size() const { return static_cast<int>(kOpen.size()) - 2; }
  int size() const { return open_size() + repeat + static_cast<int>(kClose.size()); }
  std::vector<std::int64_t> starts() const {
    std::vector<std::int64_t> starts;
    for (int i = 0; i < count; ++i)
      starts.push_back(behind ? (count - i) * size() - open_size() : i * size() + open_size());
    return starts;
  }
};

/// Pixels of a view.
struct ImageSize {
  int width = 0, height = 0;
};

/// Errors: bad_bundle.
Result<ImageSize> image_size(const Keys& keys) {
  const bool two_sides = keys.has("vision.image_width");
  const char* side = keys.has("dino.image_size") ? "dino.image_size" : "vision.image_size";
  ImageSize size;
  VLA_TRY(size.width, keys.integer(two_sides ? "vision.image_width" : side, kAnySize));
  VLA_TRY(size.height, keys.integer(two_sides ? "vision.image_height" : side, kAnySize));
  return size;
}

/// Errors: bad_bundle.
Result<ViewPlaces> view_places(const Keys& keys, const ImageSize& image) {
  ViewPlaces places;
  if (!keys.has("policy.max_views")) return places;
  VLA_TRY(const int patch_size, keys.integer("vision.patch_size", kAnySize));
  int factor = 1;
  for (const char* key : {"vision.merge", "connector.factor"})
    if (keys.has(key)) {
      VLA_TRY(factor, keys.integer(key, kAnySize));
    }
  VLA_TRY(places.count, keys.integer("policy.max_views", kAnySize));
  places.behind = keys.has(ViewPlaces::kStartsFromEnd);
  places.repeat = (image.width / patch_size / factor) * (image.height / patch_size / factor);
  return places;
}

std::string recipe(const ImageSize& image, const ViewPlaces& places, int max_tokens, int d_state, int d_robot) {
  using Json = nlohmann::ordered_json;
  const Json letterbox = {{"op", "letterbox"},    {"width", image.width}, {"height", image.height},
                          {"filter", "bilinear"}, {"antialias", false},   {"align", "bottom_right"},
                          {"fill", 0.0}};
  const Json affine = {{"op", "affine"}, {"scale", 2.0}, {"shift", -1.0}};
  const Json views = {{"op", "views"},
                      {"count", places.count},
                      {"open", places.kOpen},
                      {"token", places.kToken},
                      {"repeat", places.repeat},
                      {"close", places.kClose},
                      {"place", places.behind ? "back" : "front"}};
  const Json tokenize = {{"op", "tokenize"}, {"max_tokens", max_tokens}, {"truncate", "right"}};
  // A network without a state vector drops the state that a robot sends.
  const Json state = d_state > 0 ? Json::object({{"op", "pad"}, {"size", d_state}}) : Json::object({{"op", "drop"}});
  const Json take = {{"op", "take"}, {"size", d_robot}};
  Json root;
  root["image"] = Json::array({letterbox, affine});
  root["text"] = max_tokens == 0    ? Json::array()
                 : places.count > 0 ? Json::array({views, tokenize})
                                    : Json::array({tokenize});
  root["state"] = Json::array({state});
  root["action"] = Json::array({take});
  return root.dump();
}

/// The byte-level alphabet without merges, so that every byte of a text is a token: Latin-1, with unprintable
/// characters moved to U+0100 and after.
std::vector<std::string> byte_tokens() {
  std::vector<std::string> tokens;
  for (unsigned code = '!'; code < 0x100 + 68; ++code) {
    const bool printable = code <= '~' || (code >= 0xA1 && code != 0xAD);
    if (!printable) continue;
    tokens.push_back(code < 0x80
                         ? std::string(1, static_cast<char>(code))
                         : std::string{static_cast<char>(0xC0 | code >> 6), static_cast<char>(0x80 | (code & 0x3F))});
  }
  return tokens;
}

/// An added token, found anywhere in a text.
std::string added_token(std::string_view content, std::size_t id) {
  const nlohmann::ordered_json token = {{"id", id},        {"content", content}, {"single_word", false},
                                        {"lstrip", false}, {"rstrip", false},    {"normalized", false},
                                        {"special", true}};
  return nlohmann::ordered_json::array({token}).dump();
}

/// Adds action tokens for a policy that decodes tokens: every sequence of tokens stands for a chunk.
void add_action_tokens(Keys& keys) {
  const Keys added({{"action_tokens.kind", "fast"},
                    {"action_tokens.vocab", std::vector<std::string>{"a"}},
                    {"action_tokens.min_token", 0.0},
                    {"action_tokens.scale", 1.0},
                    {"action_tokens.first_id", std::int64_t{0}},
                    {"action_tokens.prefix_ids", std::vector<std::int64_t>{0}},
                    {"action_tokens.required_ids", std::vector<std::int64_t>()}});
  for (const auto& [key, value] : added.all()) keys.set(key, value);
}

Status add_keys(Keys& keys, const std::string& arch, const RandomSizes& sizes) {
  VLA_TRY(const ImageSize image, image_size(keys));
  VLA_TRY(const int d_state, keys.integer("policy.d_state", kAnySize));
  VLA_TRY(const int d_action, keys.integer("policy.d_action", kAnySize));
  VLA_TRY(const ViewPlaces places, view_places(keys, image));
  const int d_robot = std::min({kRobot, d_state > 0 ? d_state : kRobot, d_action});
  int n_row = sizes.max_tokens;  // most tokens of a text
  if (keys.has("policy.n_row")) {
    VLA_TRY(n_row, keys.integer("policy.n_row", kAnySize));
    if (n_row == 0) n_row = sizes.max_tokens;  // 0: no limit
  }
  // A policy without a vocabulary reads no instruction.
  const int max_tokens = keys.has("lm.n_vocab") ? places.count * places.size() + std::min(sizes.max_tokens, n_row) : 0;
  std::vector<std::string> tokens = byte_tokens();
  if (places.count > 0) tokens.emplace_back(ViewPlaces::kToken);
  const std::vector<std::string> views = numbered("observation.images.view", sizes.n_view);
  const std::vector<std::string> nothing(static_cast<std::size_t>(d_robot));
  const Keys added({
      {"general.architecture", "vla"},
      {"vla.arch", arch},
      {"vla.bundle_version", std::int64_t{1}},
      {"vla.checksum", std::string(kNoChecksum)},
      {"vla.dtype", dtype_name(sizes.dtype)},
      {"vla.source.name", fmt::format("random weights, seed {}", sizes.seed)},
      {"vla.source.revision", ""},
      {"vla.source.converter", "vla bench"},
      {"observation.views", views},
      {"observation.view_aliases", std::vector<std::string>(views.size())},
      {"observation.view_optional", std::vector<std::int64_t>(views.size(), 0)},
      {"observation.min_views", std::int64_t{1}},
      {"observation.states", std::vector<std::string>{"observation.state"}},
      {"observation.state_dims", std::vector<std::int64_t>{d_robot}},
      {"observation.state_names", numbered("state.", d_robot)},
      {"observation.state_units", nothing},
      {"observation.max_text_tokens", std::int64_t{max_tokens}},
      {"action.names", numbered("action.", d_robot)},
      {"action.units", nothing},
      {"action.rate_hz", 0.0},
      {"solver.kind", "euler"},
      {"solver.steps", std::int64_t{sizes.n_step}},
      {"solver.t_start", 1.0},
      {"solver.t_end", 0.0},
      {"solver.noise", "normal"},
      {"tokenizer.kind", "byte_level_bpe"},
      {"tokenizer.tokens", tokens},
      {"tokenizer.merges", std::vector<std::string>()},
      {"tokenizer.pre", R"([{"type":"byte_level","add_prefix_space":false,"use_regex":true}])"},
      {"tokenizer.added", places.count > 0 ? added_token(ViewPlaces::kToken, tokens.size() - 1) : "[]"},
      {"tokenizer.ignore_merges", false},
      {"processor.recipe", recipe(image, places, max_tokens, d_state, d_robot)},
  });
  for (const auto& [key, value] : added.all())
    if (!keys.has(key)) keys.set(key, value);
  if (*keys.string("solver.kind") == "greedy") add_action_tokens(keys);
  if (places.count > 0) keys.set(places.behind ? ViewPlaces::kStartsFromEnd : ViewPlaces::kStarts, places.starts());
  return {};
}

/// SplitMix64. Source: Steele, Lea and Flood, Fast splittable pseudorandom number generators (OOPSLA 2014).
std::uint64_t next_random(std::uint64_t& state) {
  std::uint64_t z = (state += 0x9E3779B97F4A7C15);
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EB;
  return z ^ (z >> 31);
}

/// Truncates a value to 16 bits. This is exact enough for random values of ordinary size; values below f16's normal
/// range become zero.
std::uint16_t to_16_bits(float value, DType type) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof(bits));
  if (type == DType::bf16) return static_cast<std::uint16_t>(bits >> 16);
  const std::uint32_t exponent = bits >> 23 & 0xFF;
  if (exponent <= 112) return 0;
  return static_cast<std::uint16_t>((bits >> 16 & 0x8000) | (exponent - 112) << 10 | (bits >> 13 & 0x3FF));
}

/// The bytes of `count` elements, uniform in [-0.04, 0.04]: products of any depth keep the magnitude of their input.
std::string random_bytes(std::size_t count, DType type, std::uint64_t seed) {
  const std::size_t size = dtype_size(type, 1);
  std::string bytes(count * size, '\0');
  for (std::size_t i = 0; i < count; ++i) {
    const float value = 0.08f * static_cast<float>(next_random(seed) >> 40) / 16777216.0f - 0.04f;
    const std::uint16_t half = type == DType::f32 ? 0 : to_16_bits(value, type);
    std::memcpy(bytes.data() + i * size, type == DType::f32 ? static_cast<const void*>(&value) : &half, size);
  }
  return bytes;
}

/// Bytes of four random ternary elements each.
std::string random_codes(std::size_t count, std::uint64_t seed) {
  std::string bytes(count, '\0');
  for (char& four : bytes)
    for (int i = 0; i < 4; ++i) four = static_cast<char>(four << 2 | static_cast<int>(next_random(seed) % 3));
  return bytes;
}

/// Values of tensors: random for matrices and tables, ones for norm weights, zeros for biases, so that values stay
/// finite at any depth.
class Values {
 public:
  Values(const ParamList& list, const RandomSizes& sizes) {
    std::size_t longest = 0;
    for (const Param& param : list.params()) longest = std::max(longest, static_cast<std::size_t>(param.count()));
    pool_ = random_bytes(std::min(longest, kPool), sizes.dtype, sizes.seed);
    codes_ = random_codes(std::min(longest, kPool) / 4 + 1, sizes.seed);
    const std::vector<float> one(longest_vector(list), 1.0f);
    ones_.assign(reinterpret_cast<const char*>(one.data()), one.size() * sizeof(float));
    zeros_.assign(ones_.size(), '\0');
  }

  /// Calls `use` with the bytes of `param`, part by part.
  template <class Use>
  void each_piece(const Param& param, std::size_t size, Use use) const {
    const std::string& source = !is_float(param.encoding.type)     ? codes_
                                : param.storage != Storage::vector ? pool_
                                : is_added(param)                  ? zeros_
                                                                   : ones_;
    for (std::size_t at = 0; at < size; at += source.size())
      use(std::string_view(source).substr(0, std::min(source.size(), size - at)));
  }

 private:
  static constexpr std::size_t kPool = std::size_t{1} << 22;  // random elements before they repeat

  /// Whether a vector is a bias, or the kernel of a depthwise convolution whose result is added to its input.
  static bool is_added(const Param& param) { return param.name.ends_with("bias") || param.name.ends_with("kernel"); }
  static std::size_t longest_vector(const ParamList& list) {
    std::int64_t longest = 1;
    for (const Param& param : list.params())
      if (param.storage == Storage::vector) longest = std::max(longest, param.count());
    return static_cast<std::size_t>(longest);
  }

  std::string pool_, codes_, ones_, zeros_;
};

std::vector<TensorInfo> tensors_of(const ParamList& list, const RandomSizes& sizes) {
  std::vector<TensorInfo> tensors;
  std::vector<std::byte> nothing;
  for (const Param& param : list.params()) {
    const bool is_any_float = param.storage != Storage::vector && is_float(param.encoding.type);
    TensorInfo tensor = {param.name, is_any_float ? sizes.dtype : param.stored_type(), param.stored_shape(), {}};
    tensor.data = {nothing.data(), dtype_size(tensor.type, tensor.count())};
    tensors.push_back(std::move(tensor));
  }
  return tensors;
}

/// Opens a file in memory, or on the disk if memory cannot hold the weights and an engine's copy of them; -1 on
/// failure.
int open_bundle(const std::vector<TensorInfo>& tensors, const RandomSizes& sizes) {
  std::size_t size = 0;
  for (const TensorInfo& tensor : tensors) size += tensor.data.size();
  const bool is_large = sizes.is_filled && size > free_memory() / 5 * 2;
  return is_large ? open_temporary() : ::memfd_create("random bundle", MFD_CLOEXEC);
}

bool write_bundle(int file, const Keys& keys, const ParamList& list, const std::vector<TensorInfo>& tensors,
                  const RandomSizes& sizes) {
  BundleFile out(file, keys, tensors);
  std::optional<Values> values;
  if (sizes.is_filled) values.emplace(list, sizes);
  for (std::size_t i = 0; i < tensors.size(); ++i) {
    if (!values) out.put_zeros(tensors[i].data.size());
    if (values)
      values->each_piece(list.params()[i], tensors[i].data.size(),
                         [&](std::string_view piece) { out.put(std::as_bytes(std::span(piece))); });
    out.end_tensor();
  }
  return out.seal();
}

}  // namespace

Result<RandomBundle> RandomBundle::make(const std::string& arch, const Keys& network, const RandomSizes& sizes) {
  VLA_TRY(const PolicyEntry entry, find_policy(arch));
  Keys keys = network;
  VLA_CHECK(add_keys(keys, arch, sizes));
  ParamList list(keys, nullptr);
  const std::unique_ptr<Policy> policy = entry.make(list);
  VLA_CHECK(list.report(arch, {}));
  const std::vector<TensorInfo> tensors = tensors_of(list, sizes);
  RandomBundle bundle(open_bundle(tensors, sizes));
  if (bundle.file_ < 0 || !write_bundle(bundle.file_, keys, list, tensors, sizes) || ::fdatasync(bundle.file_) != 0)
    return Error{Code::out_of_memory, "random weights", "",
                 "neither memory nor the folder of temporary files has room for a bundle of this size",
                 "use a machine with more memory, a 16-bit --dtype, or a TMPDIR on a larger disk"};
  return bundle;
}

RandomBundle::~RandomBundle() {
  if (file_ >= 0) ::close(file_);
}

}  // namespace vla::bench
