// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/quantize.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <optional>
#include <set>

#include "base/file.h"
#include "bundle/gguf_writer.h"
#include "graph/rounding.h"
#include "kernels/numbers.h"
#include "policies/policy.h"
#include "quantize/code_maker.h"

namespace vla {
namespace {

/// The tensors to quantize, by the address of their bytes, since the robots of a bundle share tensors. A tensor in
/// `read_otherwise` stays as it is.
struct Matrices {
  std::map<const std::byte*, Encoding> wanted;
  std::set<const std::byte*> read_otherwise;

  void add(const ParamList& list, const Choice& choice) {
    for (const Param& param : list.params()) {
      const Encoding encoding = resident_encoding(param, choice(param.source->name));
      const std::byte* const place = param.source->data.data();
      if (encoding == param.encoding)
        read_otherwise.insert(place);
      else
        wanted.emplace(place, encoding);
    }
  }
  std::optional<Encoding> find(const TensorInfo& tensor) const {
    const auto found = wanted.find(tensor.data.data());
    if (found == wanted.end() || read_otherwise.contains(tensor.data.data())) return std::nullopt;
    return found->second;
  }
};

/// The large matrices that any robot's policy reads. Errors: bad_bundle, unsupported.
Result<Matrices> find_matrices(const Bundle& bundle, const Choice& choice) {
  Matrices matrices;
  std::vector<std::string> tags = bundle.embodiments();
  if (tags.empty()) tags.emplace_back();
  for (const std::string& tag : tags) {
    Bundle robot = bundle;
    VLA_CHECK(robot.choose(tag));
    VLA_TRY(const std::string arch, robot.keys().string("vla.arch"));
    VLA_TRY(const PolicyEntry entry, find_policy(arch));
    ParamList list(robot.keys(), &robot);
    const std::unique_ptr<Policy> policy = entry.make(list);
    VLA_CHECK(list.report(arch, [](const std::string&) { return true; }));
    matrices.add(list, choice);
  }
  return matrices;
}

/// Sums of squares of a matrix, and of its codes' errors.
struct Squares {
  double value = 0, missed = 0;

  void add(DType type, const std::byte* stored, std::span<const float> widened) {
    for (std::size_t i = 0; i < widened.size(); ++i) {
      const float value_i = kernels::stored_number(type, stored, static_cast<std::int64_t>(i));
      value += double{value_i} * value_i;
      missed += double{value_i - widened[i]} * (value_i - widened[i]);
    }
  }
};

/// Writes the tensors in order.
class Writer {
 public:
  Writer(const Bundle& bundle, const CodeSource& source, BundleFile& out,
         const std::function<void(QuantizeProgress)>& report)
      : bundle_(bundle), source_(source), out_(out), report_(report) {}

  Status copy(const TensorInfo& tensor) {
    return out_.copy(bundle_, tensor, [this](std::size_t size) { tell(size); });
  }

  /// Writes two tensors: codes, then scales.
  Result<Squares> quantize(const TensorInfo& tensor, const Encoding& wanted) {
    const std::int64_t d_in = tensor.shape[0], d_out = tensor.shape[1];
    const std::size_t row = tensor.data.size() / static_cast<std::size_t>(d_out);
    std::vector<float> scales(static_cast<std::size_t>(d_out));
    std::vector<float> widened(static_cast<std::size_t>(kPartRows * d_in));
    VLA_TRY(CodeMaker maker, CodeMaker::open(bundle_, tensor, wanted, source_));
    Squares squares;
    for (std::int64_t first = 0; first < d_out; first += kPartRows) {
      const std::int64_t n = std::min(kPartRows, d_out - first);
      VLA_TRY(const auto part,
              read(tensor.data.subspan(static_cast<std::size_t>(first) * row, static_cast<std::size_t>(n) * row)));
      float* const to = scales.data() + first;
      VLA_TRY(const std::byte* const codes, maker.make(part.data(), first, n, to));
      widen_codes(wanted, codes, to, n * d_in, widened.data());
      squares.add(tensor.type, part.data(), std::span(widened).first(static_cast<std::size_t>(n * d_in)));
      out_.put({codes, wanted.size(n * d_in)});
    }
    out_.end_tensor();
    out_.put(std::as_bytes(std::span(scales)));
    out_.end_tensor();
    return squares;
  }

 private:
  Result<std::span<const std::byte>> read(std::span<const std::byte> part) {
    VLA_TRY(const auto bytes, bundle_.read(part, buffer_));
    tell(part.size());
    return bytes;
  }
  void tell(std::size_t size) {
    report_({done_ += static_cast<std::int64_t>(size), static_cast<std::int64_t>(bundle_.file_size())});
  }

  const Bundle& bundle_;
  const CodeSource& source_;
  BundleFile& out_;
  const std::function<void(QuantizeProgress)>& report_;
  ReadBuffer buffer_;
  std::int64_t done_ = 0;
};

/// Bytes of a matrix's codes and scales.
std::int64_t quantized_size(const TensorInfo& tensor, const Encoding& encoding) {
  const std::size_t scales = static_cast<std::size_t>(tensor.shape[1]) * sizeof(float);
  return static_cast<std::int64_t>(encoding.size(tensor.count()) + scales);
}

/// Lists the tensors of the quantized file; only the sizes of their data are used.
std::vector<TensorInfo> quantized_tensors(const Bundle& bundle, const Matrices& matrices) {
  std::vector<TensorInfo> tensors;
  for (const TensorInfo& tensor : bundle.tensors()) {
    tensors.push_back(tensor);
    const std::optional<Encoding> wanted = matrices.find(tensor);
    if (!wanted) continue;
    TensorInfo& codes = tensors.back();
    codes.type = DType::i8;
    codes.data = tensor.data.first(wanted->size(tensor.count()));
    codes.shape[0] = static_cast<std::int64_t>(dtype_size(wanted->type, codes.shape[0]));
    const std::int64_t d_out = tensor.shape[1];
    // The matrix's bytes serve as the scales' data, of which only the size is used: a row has more bytes than a scale.
    tensors.push_back(
        {scales_name(tensor.name, *wanted), DType::f32, {d_out}, tensor.data.first(dtype_size(DType::f32, d_out))});
  }
  return tensors;
}

Keys quantized_keys(const Bundle& bundle, const Matrices& matrices, const std::string& why) {
  Keys keys = bundle.keys();
  const bool has_int4 = std::ranges::any_of(
      bundle.tensors(), [&](const TensorInfo& t) { return matrices.find(t).value_or(Encoding{}).type == DType::int4; });
  keys.set("vla.checksum", std::string(kNoChecksum));
  keys.set("vla.dtype", std::string(has_int4 ? "int4" : "int8"));
  if (!why.empty()) keys.set("vla.quantization", why);
  return keys;
}

/// One row of the report per module, in file order.
class Report {
 public:
  QuantizedModule& of(const TensorInfo& tensor) {
    std::string path = tensor.name.substr(0, tensor.name.find('.'));
    const auto found = std::ranges::find(rows_, path, &QuantizedModule::path);
    if (found != rows_.end()) return *found;
    squares_.emplace_back();
    return rows_.emplace_back(QuantizedModule{.path = std::move(path)});
  }
  void add(QuantizedModule& row, const Squares& more) {
    Squares& squares = squares_[static_cast<std::size_t>(&row - rows_.data())];
    squares.value += more.value, squares.missed += more.missed;
    ++row.n_matrix;
    row.error = squares.value > 0 ? std::sqrt(squares.missed / squares.value) : 0;
  }
  std::vector<QuantizedModule> take() { return std::move(rows_); }

 private:
  std::vector<QuantizedModule> rows_;
  std::vector<Squares> squares_;
};

Status write_tensors(const Bundle& bundle, const Matrices& matrices, Writer& writer, Report& report) {
  for (const TensorInfo& tensor : bundle.tensors()) {
    QuantizedModule& row = report.of(tensor);
    row.before += static_cast<std::int64_t>(tensor.data.size());
    if (const std::optional<Encoding> wanted = matrices.find(tensor)) {
      VLA_TRY(const Squares squares, writer.quantize(tensor, *wanted));
      report.add(row, squares);
      row.after += quantized_size(tensor, *wanted);
    } else {
      VLA_CHECK(writer.copy(tensor));
      row.after += static_cast<std::int64_t>(tensor.data.size());
    }
  }
  return {};
}

Error nothing_to_quantize(const std::string& path) {
  return {Code::unsupported, path, "large matrices of floats", "none: it is quantized already, or too small"};
}

}  // namespace

Result<std::vector<Quantizable>> quantizable(const std::string& path) {
  VLA_TRY(const Bundle bundle, Bundle::open(path));
  VLA_TRY(const Matrices int8, find_matrices(bundle, all_as(Rounding::int8)));
  VLA_TRY(const Matrices int4, find_matrices(bundle, all_as(Rounding::int4)));
  std::vector<Quantizable> found;
  for (const TensorInfo& tensor : bundle.tensors())
    if (const auto bytes = int8.find(tensor))
      found.push_back({tensor.name, static_cast<std::int64_t>(tensor.data.size()), quantized_size(tensor, *bytes),
                       quantized_size(tensor, *int4.find(tensor))});
  if (found.empty()) return nothing_to_quantize(path);
  return found;
}

Result<std::vector<QuantizedModule>> quantize(const std::string& from, const std::string& to, const Choice& choice,
                                              const std::string& why,
                                              const std::function<void(QuantizeProgress)>& progress,
                                              const CodeSource& source) {
  VLA_TRY(const Bundle bundle, Bundle::open(from));
  VLA_TRY(const Matrices matrices, find_matrices(bundle, choice));
  const std::vector<TensorInfo> tensors = quantized_tensors(bundle, matrices);
  if (tensors.size() == bundle.tensors().size()) return nothing_to_quantize(from);
  Report report;
  Status made;
  const Status written = write_file(to, [&](int file) {
    BundleFile out(file, quantized_keys(bundle, matrices, why), tensors);
    Writer writer(bundle, source, out, progress);
    made = write_tensors(bundle, matrices, writer, report);
    return made && out.seal();
  });
  VLA_CHECK(made);
  VLA_CHECK(written);
  return report.take();
}

}  // namespace vla
