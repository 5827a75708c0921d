// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <deque>
#include <functional>
#include <initializer_list>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "bundle/bundle.h"

namespace vla {

/// How a parameter is used. A matrix or a table may have any float dtype of the bundle, a vector f32 only. A
/// matrix of floats may also be quantized: int8 codes from -127 to 127 or int4 blocks, with one scale per row.
enum class Storage { matrix, table, vector };

/// One declared weight. `shape` follows ggml, fastest first: a matrix is [d_in, d_out].
struct Param {
  int id = 0;
  std::string name;
  Storage storage = Storage::matrix;
  std::vector<std::int64_t> shape;
  Encoding encoding;                   // encoding in the file; without a bundle float32 stands for any float dtype
  const TensorInfo* source = nullptr;  // set if the bundle has a tensor that fits
  const Param* scales = nullptr;       // a vector of scales, if the encoding has scales

  std::int64_t count() const;
  /// The shape of the bundle's tensor. Elements smaller than a byte are stored as bytes.
  std::vector<std::int64_t> stored_shape() const;
  DType stored_type() const { return is_packed() ? DType::i8 : encoding.type; }
  bool is_packed() const { return dtype_bits(encoding.type) < 8; }
  /// What `vla inspect` prints: the kind of storage, or the dtype of codes.
  const char* storage_text() const;
};

/// The name of a parameter's scales, if its encoding has scales.
std::string scales_name(const std::string& param, const Encoding& encoding);

/// All parameters that a policy's constructors declare, and all problems found. Constructors cannot fail: they record
/// problems, and `report` returns all of them in one error, so one attempt shows everything that is wrong with a
/// bundle.
class ParamList {
 public:
  /// `bundle` may be null: then the list is a manifest of the parameters that the keys require, without tensors. Both
  /// arguments must outlive the list.
  ParamList(const Keys& keys, const Bundle* bundle)
      : keys_(&keys), bundle_(bundle), declared_(std::make_shared<Declared>()) {}
  /// The list of another robot of the same file. Robots share parameters: one that was declared for another robot is
  /// not declared again.
  ParamList(const Bundle& bundle, const ParamList& other)
      : keys_(&bundle.keys()), bundle_(&bundle), declared_(other.declared_) {}

  const Keys& keys() const { return *keys_; }
  /// The parameters of all robots.
  const std::deque<Param>& params() const { return declared_->params; }
  const Bundle* bundle() const { return bundle_; }

  /// Declares a parameter and, if it is encoded with scales, the vector of its scales.
  const Param& declare(std::string name, Storage storage, std::vector<std::int64_t> shape, Encoding encoding = {});
  void problem(std::string line) { problems_.push_back(std::move(line)); }
  void problem(const Error& error);

  /// Returns all problems, including every tensor of the bundle that is neither declared nor accepted by `is_used`. The
  /// error lists the first 50 and the number of the rest. Errors: bad_bundle.
  Status report(const std::string& policy, const std::function<bool(const std::string&)>& is_used) const;

 private:
  struct Declared {
    std::deque<Param> params;  // a deque: modules keep pointers to their parameters
    std::map<const std::byte*, const Param*> by_source;
  };
  void look_up(Param& param);
  const Param* find(const std::string& name, Storage storage, const std::vector<std::int64_t>& shape) const;

  const Keys* keys_;
  const Bundle* bundle_;
  std::shared_ptr<Declared> declared_;
  std::set<std::string> names_;  // tensors that this robot declares
  std::vector<std::string> problems_;
};

/// A place in the module tree. Its path is the prefix of its config keys, tensors, taps and error messages.
class Scope {
 public:
  Scope(ParamList& list, std::string path) : list_(&list), path_(std::move(path)) {}

  Scope operator/(const std::string& child) const { return {*list_, path_.empty() ? child : path_ + "." + child}; }
  Scope operator/(int index) const { return *this / std::to_string(index); }
  const std::string& path() const { return path_; }

  /// A size or count from the configuration, from 1 to `max`, which is small enough for products of two sizes. Records
  /// a problem and returns 1 if it is out of range.
  int dim(const std::string& key, int max = 1 << 16) const;
  /// A number of layers or blocks, from 1 to 512, so that a damaged bundle cannot ask for endless work.
  int n_layer(const std::string& key) const { return dim(key, 512); }
  /// A number in `range`. Records a problem and returns the lower end if it is outside.
  float number(const std::string& key, Range range) const { return static_cast<float>(precise(key, range)); }
  double precise(const std::string& key, Range range) const;
  std::string string(const std::string& key) const;
  std::vector<std::string> strings(const std::string& key) const;
  std::vector<int> integers(const std::string& key, Range range) const;
  bool has(const std::string& key) const;
  /// An index from 0 to count - 1.
  int index(const std::string& key, int count) const;
  /// The index of the key's word among `words`.
  int choice(const std::string& key, std::initializer_list<std::string> words) const;
  /// Records a problem at `key` of this scope unless `holds`.
  void require(bool holds, const std::string& key, const std::string& expected, const std::string& found) const;

  const Param* matrix(const std::string& name, int d_in, int d_out) const;
  /// A matrix of -1, 0 and 1 with one scale. d_in must be a multiple of 4.
  const Param* ternary(const std::string& name, int d_in, int d_out) const;
  const Param* table(const std::string& name, int d_model, int n_row) const;
  const Param* vector(const std::string& name, int size) const;

 private:
  std::string key_of(const std::string& key) const { return path_.empty() ? "policy." + key : path_ + "." + key; }
  template <class T>
  T take(Result<T> result, T otherwise) const;

  ParamList* list_;
  std::string path_;
};

}  // namespace vla
