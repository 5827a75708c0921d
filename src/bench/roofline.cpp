// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bench/roofline.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

namespace vla::bench {
namespace {

/// Sizes of the image and of the plot in it, in pixels.
constexpr double kWidth = 1000, kHeight = 640, kLeft = 84, kRight = 690, kTop = 84, kBottom = 566;
/// Colours that colour-blind readers can tell apart. Source: Okabe and Ito, Color Universal Design.
constexpr const char* kColours[] = {"#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"};

std::string escape(const std::string& text) {
  std::string safe;
  for (char c : text) {
    if (c == '&')
      safe += "&amp;";
    else if (c == '<')
      safe += "&lt;";
    else if (c == '>')
      safe += "&gt;";
    else
      safe += c;
  }
  return safe;
}

/// A logarithmic axis from `low` to `high`, drawn between pixels `begin` and `end`.
struct Axis {
  double low, high, begin, end;
  double at(double value) const {
    return begin + (end - begin) * (std::log10(value) - std::log10(low)) / (std::log10(high) - std::log10(low));
  }
};

struct Box {
  double left, top, right, bottom;
  bool meets(const Box& other) const {
    return left < other.right && other.left < right && top < other.bottom && other.top < bottom;
  }
};

class Drawing {
 public:
  explicit Drawing(const Report& report) : report_(report) {
    for (const StageRow& row : report.stages)
      if (row.work.flop > 0 && row.name != "total") rows_.push_back(&row);
    double x_low = report.ridge(), x_high = x_low, y_low = report.peak(), y_high = y_low;
    for (const StageRow* row : rows_) {
      x_low = std::min(x_low, row->intensity()), x_high = std::max(x_high, row->intensity());
      y_low = std::min(y_low, row->flop_rate), y_high = std::max(y_high, row->flop_rate);
    }
    for (const Roofs::Peak& peak : report.before.peaks) y_high = std::max(y_high, report.peak(peak.name));
    x_ = {x_low / 6, x_high * 6, kLeft, kRight};
    y_ = {y_low / 4, y_high * 2.2, kBottom, kTop};
    for (const StageRow* row : rows_) {  // keeps texts off the points
      const double x = x_.at(row->intensity()), y = y_.at(row->flop_rate);
      taken_.push_back({x - 8, y - 8, x + 8, y + 8});
    }
  }

  std::string svg() {
    svg_ = fmt::format(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{0}\" height=\"{1}\" viewBox=\"0 0 {0} {1}\" "
        "font-family=\"Helvetica, Arial, sans-serif\" font-size=\"13\">\n"
        "<rect width=\"{0}\" height=\"{1}\" fill=\"white\"/>\n",
        kWidth, kHeight);
    title();
    grid();
    roofs();
    points();
    legend();
    return svg_ + "</svg>\n";
  }

 private:
  void text(double x, double y, const std::string& what, const std::string& style = "") {
    svg_ += fmt::format("<text x=\"{:.1f}\" y=\"{:.1f}\" {}>{}</text>\n", x, y, style, escape(what));
  }
  void line(double x1, double y1, double x2, double y2, const std::string& style) {
    svg_ += fmt::format("<line x1=\"{:.1f}\" y1=\"{:.1f}\" x2=\"{:.1f}\" y2=\"{:.1f}\" {}/>\n", x1, y1, x2, y2, style);
  }

  void title() {
    const Conditions& c = report_.conditions;
    text(kLeft, 32, fmt::format("Roofline of {} on {}", c.policy, report_.cpu),
         "font-size=\"18\" font-weight=\"bold\"");
    text(kLeft, 54,
         fmt::format("{} thread{}, kernels {}; {} weights, {} view{}, {} tokens, {} steps", c.n_thread,
                     c.n_thread == 1 ? "" : "s", c.kernels, c.weights, c.n_view, c.n_view == 1 ? "" : "s", c.n_text,
                     c.n_step),
         "fill=\"#444\"");
  }

  void grid() {
    const std::string thin = "stroke=\"#e4e4e4\"";
    for (double decade = 1e-3; decade < 1e15; decade *= 10)
      for (double digit : {1.0, 2.0, 5.0}) {
        const double value = decade * digit;
        if (value >= x_.low && value <= x_.high) {
          line(x_.at(value), kTop, x_.at(value), kBottom, thin);
          text(x_.at(value), kBottom + 18, fmt::format("{:g}", value), "text-anchor=\"middle\"");
        }
        if (value >= y_.low && value <= y_.high) {
          line(kLeft, y_.at(value), kRight, y_.at(value), thin);
          text(kLeft - 8, y_.at(value) + 4, fmt::format("{:g}", 1e-9 * value), "text-anchor=\"end\"");
        }
      }
    svg_ += fmt::format("<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"#666\"/>\n", kLeft,
                        kTop, kRight - kLeft, kBottom - kTop);
    text((kLeft + kRight) / 2, kBottom + 44, "operational intensity, FLOP per byte moved", "text-anchor=\"middle\"");
    const double middle = (kTop + kBottom) / 2;
    text(24, middle, "GFLOP per second", fmt::format("text-anchor=\"middle\" transform=\"rotate(-90 24 {})\"", middle));
  }

  /// Draws a horizontal roof over all intensities at which memory is fast enough, with its name above or below.
  void flat_roof(double rate, const std::string& label, const std::string& style) {
    const double left = std::max(x_.at(std::max(rate / report_.bandwidth(), x_.low)), kLeft), y = y_.at(rate);
    line(left, y, kRight, y, style);
    const double width = 6.8 * static_cast<double>(label.size());
    const Box box = place(kRight - 6 - width, y, width, {{0, -7}, {0, 16}, {-width - 20, -7}, {-width - 20, 16}});
    text(box.left, box.bottom - 3, label, "fill=\"#222\"");
  }

  void roofs() {
    for (const Roofs::Peak& peak : report_.before.peaks) {
      const bool is_ours = peak.name == report_.peak_name;
      const double rate = report_.peak(peak.name);
      flat_roof(rate, fmt::format("{}, all threads: {:.4g} G/s", peak.name, 1e-9 * rate),
                is_ours ? "stroke=\"#000\" stroke-width=\"2.5\"" : "stroke=\"#888\"");
      if (is_ours && report_.conditions.n_thread > 1)
        flat_roof(peak.one, fmt::format("{}, one thread: {:.4g} G/s", peak.name, 1e-9 * peak.one),
                  "stroke=\"#555\" stroke-dasharray=\"6 4\"");
    }
    slope();
  }

  /// Draws the memory limit: bandwidth times operations per byte, up to the highest roof.
  void slope() {
    double highest = report_.peak();
    for (const Roofs::Peak& peak : report_.before.peaks) highest = std::max(highest, report_.peak(peak.name));
    const double left = std::max(x_.low, y_.low / report_.bandwidth());
    const double right = std::min(x_.high, highest / report_.bandwidth());
    const double x1 = x_.at(left), y1 = y_.at(left * report_.bandwidth());
    const double x2 = x_.at(right), y2 = y_.at(right * report_.bandwidth());
    line(x1, y1, x2, y2, "stroke=\"#000\" stroke-width=\"2.5\"");
    const double angle = std::atan2(y2 - y1, x2 - x1) * 180 / M_PI, x = (x1 + x2) / 2 - 9, y = (y1 + y2) / 2 - 9;
    text(x, y, fmt::format("memory: {:.3g} GB/s", 1e-9 * report_.bandwidth()),
         fmt::format("text-anchor=\"middle\" transform=\"rotate({:.1f} {:.1f} {:.1f})\"", angle, x, y));
  }

  /// The first of several places around (x, y) where a text of this width overlaps nothing placed before.
  Box place(double x, double y, double width, std::initializer_list<std::pair<double, double>> offsets) {
    Box box = {};
    for (const auto& [dx, dy] : offsets) {
      box = {x + dx, y + dy - 12, x + dx + width, y + dy + 3};
      if (std::none_of(taken_.begin(), taken_.end(), [&](const Box& other) { return other.meets(box); })) break;
    }
    taken_.push_back(box);
    return box;
  }

  void points() {
    for (std::size_t i = 0; i < rows_.size(); ++i) {
      const double x = x_.at(rows_[i]->intensity()), y = y_.at(rows_[i]->flop_rate);
      const double width = 8.0 * static_cast<double>(rows_[i]->name.size());
      const Box label = place(x, y, width,
                              {{12, 5},
                               {-12 - width, 5},
                               {-width / 2, 26},
                               {-width / 2, -14},
                               {12, 24},
                               {12, -12},
                               {-width / 2, 42},
                               {-width / 2, 58}});
      svg_ += fmt::format(
          "<circle cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"7\" fill=\"{}\" stroke=\"white\" stroke-width=\"1.5\"/>\n", x, y,
          colour(i));
      // an outline, then the letters
      for (const char* style : {"stroke=\"white\" stroke-width=\"4\"", "fill=\"#111\""})
        text(label.left, label.bottom - 3, rows_[i]->name, std::string("font-weight=\"bold\" ") + style);
    }
  }

  void legend() {
    const double left = kRight + 24;
    double y = kTop + 12;
    text(left, y, "stage", "font-weight=\"bold\"");
    for (std::size_t i = 0; i < rows_.size(); ++i) {
      const StageRow& row = *rows_[i];
      y += 30;
      svg_ += fmt::format("<circle cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"6\" fill=\"{}\"/>\n", left + 6, y - 4, colour(i));
      text(left + 20, y, fmt::format("{}: {:.{}f} ms", row.name, row.p50, row.p50 < 100 ? 2 : 0),
           "font-weight=\"bold\"");
      text(left + 20, y += 18,
           fmt::format("{:.3g} GFLOP at {:.4g} GFLOP/s,", 1e-9 * row.work.flop, 1e-9 * row.flop_rate));
      text(left + 20, y += 18, fmt::format("{:.0f} % of the peak beside it;", 100 * row.share_of_peak_p50));
      text(left + 20, y += 18, fmt::format("{:.3g} GB, bound by {}", 1e-9 * row.work.bytes, report_.regime(row)));
    }
    y += 36;
    for (const char* note : {"Points: medians; bytes are what the", "operations read and write, of which",
                             "caches serve a part.", "Roofs: measured in the same process."}) {
      text(left, y, note, "fill=\"#444\" font-size=\"12\"");
      y += 16;
    }
  }

  static const char* colour(std::size_t i) { return kColours[i % std::size(kColours)]; }

  const Report& report_;
  std::vector<const StageRow*> rows_;
  Axis x_{}, y_{};
  std::vector<Box> taken_;
  std::string svg_;
};

}  // namespace

std::string draw_roofline(const Report& report) { return Drawing(report).svg(); }

}  // namespace vla::bench
