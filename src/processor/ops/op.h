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

/// The interfaces of a recipe's ops. An op is parsed from its fields, checked against the bundle once, and applied to
/// every observation or chunk. Each file of this folder has one op or a few related ones, and lists them in a function
/// `<file>_ops()`; the build collects these functions in a table (src/CMakeLists.txt).
namespace vla {

class JsonFields;

struct Recipe;
struct FloatResizes;

/// An entry of the table.
struct OpEntry {
  const char* list;  // image, text, state or action
  const char* name;
  /// Parses the op and appends it to its list. Errors: bad_bundle, also if the op is not allowed there.
  Status (*parse)(JsonFields& fields, Recipe& recipe);
};
using Ops = std::vector<OpEntry>;

/// The size of a camera's frames.
struct CameraSize {
  int width = 0;
  int height = 0;
};

/// The rows `first` to `end` - 1 of an image.
struct Rows {
  int first, end;
};

/// Makes planes of the network's size from a frame of any size.
class Fit {
 public:
  virtual ~Fit() = default;
  virtual const char* described() const = 0;
  /// The only frame size that is accepted for a view, if the recipe states one.
  virtual std::optional<CameraSize> camera_size(int /*view*/) const { return {}; }
  /// One more than the index of the last view that the recipe names, 0 if it names none.
  virtual int n_view() const { return 0; }
  /// The list of float resizes, to which later ops may append; null if this is another kind of fit.
  virtual FloatResizes* float_resizes() { return nullptr; }
  /// The work besides writing the planes, for a frame of this size, in units of about 10 ns (one pixel).
  virtual std::int64_t work(int /*width*/, int /*height*/) const { return 0; }
  /// Writes (3, height, width) float32 in [0, 1] for this view. Errors: bad_observation, at `where`.
  virtual Status apply(const Frame& frame, int view, std::span<float> planes, const std::string& where) const = 0;
  /// Whether `apply_rows` writes some rows alone, for any view, at no extra cost per row.
  virtual bool makes_rows() const { return false; }
  /// Writes these rows of `planes`; only called if `makes_rows`. Errors: those of `apply`.
  virtual Status apply_rows(const Frame& frame, Rows /*rows*/, std::span<float> planes,
                            const std::string& where) const {
    return apply(frame, 0, planes, where);
  }
};

/// A fit that calls one function with the op's parameters.
template <class Op>
class OneFit : public Fit {
 public:
  using Run = Status(const Frame& frame, const Op& op, std::span<float> planes, const std::string& where);

  OneFit(const char* described, Run* run, Op given = {}) : op(std::move(given)), described_(described), run_(run) {}
  const char* described() const override { return described_; }
  Status apply(const Frame& frame, int /*view*/, std::span<float> planes, const std::string& where) const override {
    return run_(frame, op, planes, where);
  }

  Op op;

 private:
  const char* described_;
  Run* run_;
};

/// An op that changes each value of an image independently of the others, depending on its channel.
class PlaneOp {
 public:
  static constexpr int kEveryView = -1;

  virtual ~PlaneOp() = default;
  /// The view to which the op applies: an index into the bundle's views, or kEveryView.
  virtual int view() const { return kEveryView; }
  virtual void apply(std::span<float> values, std::size_t channel) const = 0;
};

class TextOp {
 public:
  virtual ~TextOp() = default;
  /// Whether the op only refuses instructions and never changes one.
  virtual bool refuses() const { return false; }
  /// `state`: the discretized state, for prompts that include it. Errors: bad_observation.
  virtual Result<std::string> apply(std::string text, std::span<const int> state) const = 0;
};

/// The layout of a state.
struct StateLayout {
  const Bundle& bundle;
  const FeatureNames& features;
  std::span<const int> dims;  // widths of the features
  std::size_t n_state;        // values of all features together
  std::size_t width;          // values after the ops so far
  std::size_t n_unmoved;      // leading values that no earlier op has moved by widening the state
};

class StateOp {
 public:
  /// The order in which kinds of ops may follow each other. Only the last op is of kind `end`.
  enum class Stage { convention, normalized, clipped, widened, end };

  virtual ~StateOp() = default;
  virtual Stage stage() const = 0;
  /// Reads statistics, checks sizes, and updates the layout's width. `where` is the op's place in the recipe. Errors:
  /// bad_bundle.
  virtual Status bind(StateLayout&, const std::string& /*where*/) { return {}; }
  virtual void apply(std::span<float> /*state*/) const {}
  /// Whether `apply` normalizes this value with statistics.
  virtual bool normalizes(std::size_t /*column*/) const { return false; }
  /// For the stages `widened` and `end`: computes the network's state and the prompt's discretized state. Errors:
  /// bad_observation.
  virtual Status finish(std::vector<float>& /*state*/, std::vector<int>& /*discretized*/) const { return {}; }
  virtual bool reads(const std::string& /*tensor*/) const { return false; }
};

/// The layout of a chunk after the ops so far.
struct ActionLayout {
  const Bundle& bundle;
  std::size_t n_state;
  int width;  // columns
  int first_row = 0;
  int n_row = 0;                    // rows, 0: all
  bool relative = false;            // whether actions are relative to the state
  std::set<int> unnormalized = {};  // columns
};

/// A row's index in its chunk, and the observation's state.
struct RowPlace {
  std::size_t index;                 // index of the row in the chunk
  std::span<const float> raw_state;  // the state before normalization
};

class ActionOp {
 public:
  virtual ~ActionOp() = default;
  /// Reads statistics, checks sizes, and updates the layout. Errors: bad_bundle.
  virtual Status bind(ActionLayout& layout, const std::string& where) = 0;
  /// Changes one row in place. Values are float32 unless an op documents otherwise; the final values are rounded.
  virtual void apply(std::vector<double>& row, const RowPlace& place) const = 0;
  /// Whether `apply` unnormalizes this column by statistics.
  virtual bool unnormalizes(std::size_t /*column*/) const { return false; }
  virtual bool reads(const std::string& /*tensor*/) const { return false; }
};

/// Largest image side and vector size that a recipe may state, so that a damaged number cannot exhaust the memory.
inline constexpr int kMaxImageSide = 8192;
inline constexpr int kMaxVector = 65536;
inline constexpr int kMaxViews = 64;                   // the number of bits in Inputs::views
inline constexpr std::size_t kMaxOpText = 1 << 12;     // bytes of a text that an op searches for or writes
inline constexpr std::size_t kMaxViewsText = 1 << 20;  // bytes that a views op adds

/// Limits of pixels, states and actions: far above real values, far below float32's.
inline constexpr Range kPlain = {-1e9, 1e9};

inline Error misfit(std::string where, std::string expected, std::string found) {
  return {Code::bad_bundle, std::move(where), std::move(expected), std::move(found), "convert the checkpoint again"};
}

}  // namespace vla
