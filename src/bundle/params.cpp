// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/params.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

namespace vla {
namespace {

constexpr std::size_t kMaxLines = 50;  // problems in a report; more mean the wrong bundle

std::string shape_text(const std::vector<std::int64_t>& shape) { return fmt::format("[{}]", fmt::join(shape, ", ")); }

/// The dtypes that the bundle's tensor may have, as text for an error.
const char* dtypes_of(const Param& param) {
  if (!is_float(param.encoding.type)) return dtype_name(param.stored_type());
  return param.storage == Storage::vector  ? "f32"
         : param.storage == Storage::table ? "f32, bf16 or f16"
                                           : "f32, bf16, f16 or i8";
}

/// Whether the bundle's tensor may have this dtype for a parameter that the policy declares as floats.
bool allows(const Param& param, DType type) {
  if (param.storage == Storage::vector) return type == DType::f32;
  return is_float(type) || (param.storage == Storage::matrix && type == DType::i8);
}

/// Whether a byte is not a valid code: 3 for ternary, -128 for int8, 0 for int4.
bool has_wrong_code(DType type, std::span<const std::byte> codes) {
  std::byte wrong = {};
  if (type == DType::ternary) {
    for (const std::byte four : codes) wrong |= four & four >> 1 & std::byte{0x55};
  } else if (type == DType::int4) {
    const std::span blocks(reinterpret_cast<const Int4Block*>(codes.data()), codes.size() / sizeof(Int4Block));
    return std::ranges::any_of(blocks, [](const Int4Block& block) {
      return block.step > Int4Block::kMaxStep ||
             std::ranges::any_of(block.codes, [](int two) { return (two & 15) == 0 || two >> 4 == 0; });
    });
  } else {
    for (const std::byte code : codes) wrong |= static_cast<std::byte>(code == std::byte{0x80});
  }
  return wrong != std::byte{};
}

/// The same check for a tensor of a bundle, which is read in parts.
Result<bool> has_wrong_code(const Bundle& bundle, DType type, std::span<const std::byte> codes) {
  constexpr std::size_t kPart = sizeof(Int4Block) << 15;
  ReadBuffer buffer;
  for (std::size_t i = 0; i < codes.size(); i += kPart) {
    VLA_TRY(const auto part, bundle.read(codes.subspan(i, std::min(kPart, codes.size() - i)), buffer));
    if (has_wrong_code(type, part)) return true;
  }
  return false;
}

const char* codes_text(DType type) {
  return type == DType::ternary ? "0, 1 or 2, file has 3"
         : type == DType::int4  ? "steps of 0 to 17 and codes of 1 to 15, file has others"
                                : "-127 to 127, file has -128";
}

/// The encoding of the bundle's tensor for a matrix that may be quantized; codes have one scale per row. A row with as
/// many bytes as elements is int8, even if it has 33 or 66 bytes, which is also a size of int4 rows.
Encoding encoding_of(const TensorInfo& tensor, const std::vector<std::int64_t>& shape) {
  if (tensor.type != DType::i8) return {tensor.type};
  const bool is_int4 = !tensor.shape.empty() && tensor.shape[0] != shape[0] &&
                       tensor.shape[0] == static_cast<std::int64_t>(dtype_size(DType::int4, shape[0]));
  return {is_int4 ? DType::int4 : DType::i8, shape[0]};
}

}  // namespace

const char* Param::storage_text() const {
  constexpr const char* kNames[] = {"matrix", "table", "vector"};
  return is_float(encoding.type) ? kNames[static_cast<int>(storage)] : dtype_name(encoding.type);
}

/// The name of a parameter's scales. A module has one ternary matrix, whose scale BitLinear calls `scale`. Other
/// matrices may share a module, so their scales are named `<matrix>_scale`.
std::string scales_name(const std::string& param, const Encoding& encoding) {
  if (encoding.type != DType::ternary) return param + "_scale";
  return param.substr(0, param.rfind('.') + 1) + "scale";
}

std::int64_t Param::count() const {
  std::int64_t product = 1;
  for (std::int64_t dim : shape) product *= dim;
  return product;
}

std::vector<std::int64_t> Param::stored_shape() const {
  std::vector<std::int64_t> stored = shape;
  if (is_packed()) stored[0] = static_cast<std::int64_t>(dtype_size(encoding.type, stored[0]));
  return stored;
}

/// The parameter that already uses this tensor of the file, or null.
const Param* ParamList::find(const std::string& name, Storage storage, const std::vector<std::int64_t>& shape) const {
  const TensorInfo* tensor = bundle_ != nullptr ? bundle_->find(name) : nullptr;
  if (tensor == nullptr) return nullptr;
  const auto found = declared_->by_source.find(tensor->data.data());
  if (found == declared_->by_source.end()) return nullptr;
  const Param& param = *found->second;
  if (param.name != name || param.storage != storage || param.shape != shape) return nullptr;
  const Param* scales = param.scales;
  return scales == nullptr || find(scales->name, scales->storage, scales->shape) == scales ? &param : nullptr;
}

const Param& ParamList::declare(std::string name, Storage storage, std::vector<std::int64_t> shape, Encoding encoding) {
  names_.insert(name);
  if (const Param* param = find(name, storage, shape)) {
    if (param->scales != nullptr) names_.insert(param->scales->name);
    return *param;
  }
  Param& param = declared_->params.emplace_back();
  param.id = static_cast<int>(declared_->params.size()) - 1;
  param.name = std::move(name);
  param.storage = storage;
  param.shape = std::move(shape);
  param.encoding = encoding;
  if (bundle_ != nullptr) look_up(param);
  if (const std::int64_t n = param.encoding.n_scale(param.count()); n > 0)
    param.scales = &declare(scales_name(param.name, param.encoding), Storage::vector, {n});
  return param;
}

void ParamList::look_up(Param& param) {
  const TensorInfo* tensor = bundle_->find(param.name);
  if (tensor == nullptr)
    return problem(fmt::format("missing tensor  {:<40} expected {} {}", param.name, shape_text(param.stored_shape()),
                               param.storage_text()));
  if (is_float(param.encoding.type) && allows(param, tensor->type)) param.encoding = encoding_of(*tensor, param.shape);
  if (tensor->shape != param.stored_shape())
    return problem(fmt::format("wrong shape     {:<40} expected {}, file has {}", param.name,
                               shape_text(param.stored_shape()), shape_text(tensor->shape)));
  if (tensor->type != param.stored_type())
    return problem(fmt::format("wrong dtype     {:<40} expected {}, file has {}", param.name, dtypes_of(param),
                               dtype_name(tensor->type)));
  if (!is_float(param.encoding.type)) {
    const Result<bool> wrong = has_wrong_code(*bundle_, param.encoding.type, tensor->data);
    if (!wrong) return problem(wrong.error());
    if (*wrong)
      return problem(fmt::format("wrong code      {:<40} expected {}", param.name, codes_text(param.encoding.type)));
  }
  param.source = tensor;
  declared_->by_source.emplace(tensor->data.data(), &param);
}

void ParamList::problem(const Error& error) {
  problem(fmt::format("{:<15} {:<40} expected {}", error.found == "no such key" ? "missing key" : "wrong key",
                      error.where,
                      error.found == "no such key" ? error.expected : error.expected + ", file has " + error.found));
}

Status ParamList::report(const std::string& policy, const std::function<bool(const std::string&)>& is_used) const {
  std::vector<std::string> lines = problems_;
  std::size_t n_line = lines.size();
  if (bundle_ != nullptr)
    for (const TensorInfo& tensor : bundle_->tensors())
      if (names_.count(tensor.name) == 0 && !is_used(tensor.name) && ++n_line <= kMaxLines)
        lines.push_back(fmt::format("unused tensor   {:<40} no module of {} declares it", tensor.name, policy));
  if (n_line == 0) return {};
  if (n_line > kMaxLines) {
    lines.resize(kMaxLines);
    lines.push_back(fmt::format("and {} more", n_line - kMaxLines));
  }
  return Error{Code::bad_bundle, bundle_ != nullptr ? bundle_->path() : policy, "",
               fmt::format("does not fit policy {}: {} problem{}\n  {}", policy, n_line, n_line == 1 ? "" : "s",
                           fmt::join(lines, "\n  ")),
               "convert the checkpoint again with the vla-convert of this version"};
}

template <class T>
T Scope::take(Result<T> result, T otherwise) const {
  if (result) return std::move(*result);
  list_->problem(result.error());
  return otherwise;
}

int Scope::dim(const std::string& key, int max) const {
  return take(list_->keys().integer(key_of(key), {1, static_cast<double>(max)}), 1);
}

double Scope::precise(const std::string& key, Range range) const {
  return take(list_->keys().number(key_of(key), range), range.low);
}

std::string Scope::string(const std::string& key) const {
  return take(list_->keys().string(key_of(key)), std::string());
}
std::vector<std::string> Scope::strings(const std::string& key) const {
  return take(list_->keys().strings(key_of(key)), std::vector<std::string>());
}

std::vector<int> Scope::integers(const std::string& key, Range range) const {
  return take(list_->keys().integers(key_of(key), range), std::vector<int>());
}

bool Scope::has(const std::string& key) const { return list_->keys().has(key_of(key)); }

int Scope::index(const std::string& key, int count) const {
  return take(list_->keys().integer(key_of(key), {0, count - 1.0}), 0);
}

int Scope::choice(const std::string& key, std::initializer_list<std::string> words) const {
  const std::string word = string(key);
  const auto found = std::find(words.begin(), words.end(), word);
  require(found != words.end(), key, fmt::format("{}", fmt::join(words, ", ")), word);
  return found != words.end() ? static_cast<int>(found - words.begin()) : 0;
}

void Scope::require(bool holds, const std::string& key, const std::string& expected, const std::string& found) const {
  if (!holds) list_->problem(Error{Code::bad_bundle, key_of(key), expected, found});
}

const Param* Scope::matrix(const std::string& name, int d_in, int d_out) const {
  return &list_->declare((*this / name).path(), Storage::matrix, {d_in, d_out});
}

const Param* Scope::ternary(const std::string& name, int d_in, int d_out) const {
  if (d_in % 4 != 0)
    list_->problem(
        fmt::format("wrong size      {:<40} expected rows of whole bytes, four numbers each, "
                    "there are {}",
                    (*this / name).path(), d_in));
  const Encoding one_scale = {DType::ternary, std::int64_t{d_in} * d_out};
  return &list_->declare((*this / name).path(), Storage::matrix, {d_in, d_out}, one_scale);
}

const Param* Scope::table(const std::string& name, int d_model, int n_row) const {
  return &list_->declare((*this / name).path(), Storage::table, {d_model, n_row});
}

const Param* Scope::vector(const std::string& name, int size) const {
  return &list_->declare((*this / name).path(), Storage::vector, {size});
}

}  // namespace vla
