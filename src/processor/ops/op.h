// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "bundle/bundle.h"
#include "processor/image.h"
#include "processor/names.h"

/// The kinds of ops of a recipe. An op is read from its fields, checked against the bundle once, and applied to every
/// observation or chunk. Each file of this folder holds an op, or a few that are closely related, and names them
/// in a function `<file>_ops()`; the build puts these functions into one table (src/CMakeLists.txt).
namespace vla {

class JsonFields;

struct Recipe;

/// A line of the table.
struct OpEntry {
  const char* list;  // image, text, state or action
  const char* name;
  /// Reads the op and appends it to its list. Errors: bad_bundle, also for a place where the op has no meaning.
  Status (*parse)(JsonFields& fields, Recipe& recipe);
};
using Ops = std::vector<OpEntry>;

/// The size of a camera's frames.
struct CameraSize {
  int width = 0;
  int height = 0;
};

/// Makes planes of the network's size from a frame of any size.
class Fit {
 public:
  virtual ~Fit() = default;
  virtual const char* described() const = 0;
  /// The only frames that are taken, where the recipe says so.
  virtual std::optional<CameraSize> camera_size() const { return {}; }
  /// What it computes beside making the planes, for a frame of this size, in pixels of about 10 ns.
  virtual std::int64_t work(int /*width*/, int /*height*/) const { return 0; }
  /// Writes (3, height, width) float32 in [0, 1]. Errors: bad_observation, at `where`.
  virtual Status apply(const Frame& frame, std::span<float> planes, const std::string& where) const = 0;
};

/// A fit by one function of what the recipe says.
template <class Op>
class OneFit : public Fit {
 public:
  using Run = Status(const Frame& frame, const Op& op, std::span<float> planes, const std::string& where);

  OneFit(const char* described, Run* run, Op given = {}) : op(std::move(given)), described_(described), run_(run) {}
  const char* described() const override { return described_; }
  Status apply(const Frame& frame, std::span<float> planes, const std::string& where) const override {
    return run_(frame, op, planes, where);
  }

  Op op;

 private:
  const char* described_;
  Run* run_;
};

/// Works on planes (3, height, width).
class PlaneOp {
 public:
  static constexpr int kEveryView = -1;

  virtual ~PlaneOp() = default;
  /// Which view's planes it is for: an index into the bundle's views, or kEveryView.
  virtual int view() const { return kEveryView; }
  virtual void apply(std::span<float> planes) const = 0;
};

class TextOp {
 public:
  virtual ~TextOp() = default;
  /// `state`: the discretized state, where the prompt has a place for it. Errors: bad_observation.
  virtual Result<std::string> apply(std::string text, std::span<const int> state) const = 0;
};

/// The layout of a state.
struct StateLayout {
  const Bundle& bundle;
  const FeatureNames& features;
  std::span<const int> dims;  // of each feature
  std::size_t n_state;        // values of all features together
  std::size_t width;          // what the ops so far leave of them
  std::size_t n_unmoved;      // the first values, which ops that widen a state leave at their places
};

class StateOp {
 public:
  /// The order in which the kinds of ops may follow each other; only the last op is of kind `end`.
  enum class Stage { convention, normalized, clipped, widened, end };

  virtual ~StateOp() = default;
  virtual Stage stage() const = 0;
  /// Reads statistics, checks sizes, and changes the layout's width where the op does. `where` is the op's place in the
  /// recipe. Errors: bad_bundle.
  virtual Status bind(StateLayout&, const std::string& /*where*/) { return {}; }
  virtual void apply(std::span<float> /*state*/) const {}
  /// Whether `apply` has normalized this value by statistics.
  virtual bool normalizes(std::size_t /*column*/) const { return false; }
  /// For kinds `widened` and `end`: makes the state that the network sees, and what goes into the prompt. Errors:
  /// bad_observation.
  virtual Status finish(std::vector<float>& /*state*/, std::vector<int>& /*discretized*/) const { return {}; }
  virtual bool reads(const std::string& /*tensor*/) const { return false; }
};

/// The layout of a chunk after the ops so far.
struct ActionLayout {
  const Bundle& bundle;
  std::size_t n_state;
  int width;                        // columns
  int n_row = 0;                    // rows, 0: all
  bool relative = false;            // to the state
  std::set<int> unnormalized = {};  // columns
};

/// A row's place in a chunk, and the state that it belongs to.
struct RowPlace {
  std::size_t index;                 // in the chunk
  std::span<const float> raw_state;  // the state before its normalization
};

class ActionOp {
 public:
  virtual ~ActionOp() = default;
  /// Reads statistics, checks sizes, and changes the layout where the op does. Errors: bad_bundle.
  virtual Status bind(ActionLayout& layout, const std::string& where) = 0;
  /// One row, in place. Its values are float32, but for those of an op that says otherwise; the last are rounded.
  virtual void apply(std::vector<double>& row, const RowPlace& place) const = 0;
  /// Whether `apply` takes this column from the network's units by statistics.
  virtual bool unnormalizes(std::size_t /*column*/) const { return false; }
  virtual bool reads(const std::string& /*tensor*/) const { return false; }
};

/// Largest image side and vector that a recipe may ask for: a damaged number must not ask for all memory.
inline constexpr int kMaxImageSide = 8192;
inline constexpr int kMaxVector = 65536;
inline constexpr int kMaxViews = 32;
inline constexpr std::size_t kMaxOpText = 1 << 12;     // bytes of a text that an op looks for or writes
inline constexpr std::size_t kMaxViewsText = 1 << 20;  // bytes that a views op adds

/// Values of pixels, states and actions: far beyond any of them, and far from the end of float32.
inline constexpr Range kPlain = {-1e9, 1e9};

inline Error misfit(std::string where, std::string expected, std::string found) {
  return {Code::bad_bundle, std::move(where), std::move(expected), std::move(found), "convert the checkpoint again"};
}

}  // namespace vla
