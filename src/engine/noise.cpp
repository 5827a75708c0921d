// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// The build compiles this file with -ffp-contract=off, so every operation rounds once on every machine.
#include "engine/noise.h"

#include <array>
#include <cmath>

namespace vla {
namespace {

/// Philox 4x32-10: four random words for each (counter, key). Source: Salmon et al., Parallel random numbers: as easy
/// as 1, 2, 3 (SC 2011); constants as published there.
std::array<std::uint32_t, 4> philox(std::uint64_t counter, std::uint64_t key) {
  std::array<std::uint32_t, 4> x = {static_cast<std::uint32_t>(counter), static_cast<std::uint32_t>(counter >> 32), 0,
                                    0};
  std::uint32_t k0 = static_cast<std::uint32_t>(key), k1 = static_cast<std::uint32_t>(key >> 32);
  for (int round = 0; round < 10; ++round) {
    const std::uint64_t a = std::uint64_t{0xD2511F53} * x[0], b = std::uint64_t{0xCD9E8D57} * x[2];
    x = {static_cast<std::uint32_t>(b >> 32) ^ x[1] ^ k0, static_cast<std::uint32_t>(b),
         static_cast<std::uint32_t>(a >> 32) ^ x[3] ^ k1, static_cast<std::uint32_t>(a)};
    k0 += 0x9E3779B9;
    k1 += 0xBB67AE85;
  }
  return x;
}

/// A number in (0, 1) from 52 random bits; never 0 or 1.
double open_unit(std::uint64_t seed, std::size_t index) {
  const auto words = philox(index, seed);
  const std::uint64_t bits = (std::uint64_t{words[0]} << 20) | (words[1] >> 12);
  return (static_cast<double>(bits) + 0.5) * 0x1p-52;
}

/// Natural logarithm by its series in (m - 1) / (m + 1). It uses only additions, products and quotients, which round
/// the same way on every machine.
double portable_log(double x) {
  int exponent;
  double m = std::frexp(x, &exponent);  // exact
  if (m < 0.70710678118654752) {
    m *= 2;
    --exponent;
  }
  const double z = (m - 1) / (m + 1), z2 = z * z;
  double sum = 0;
  for (int k = 25; k >= 1; k -= 2) sum = sum * z2 + 1.0 / k;
  return 2 * z * sum + exponent * 0.69314718055994531;
}

double ratio(const double (&p)[8], const double (&q)[8], double x) {
  double above = p[7], below = q[7];
  for (int i = 6; i >= 0; --i) {
    above = above * x + p[i];
    below = below * x + q[i];
  }
  return above / below;
}

/// The quantile of the standard normal distribution. Source: Wichura, Algorithm AS 241 (1988), routine PPND16.
double normal_quantile(double p) {
  constexpr double a[8] = {3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3,
                           1.3731693765509461125e4, 4.5921953931549871457e4, 6.7265770927008700853e4,
                           3.3430575583588128105e4, 2.5090809287301226727e3};
  constexpr double b[8] = {1.0,
                           4.2313330701600911252e1,
                           6.8718700749205790830e2,
                           5.3941960214247511077e3,
                           2.1213794301586595867e4,
                           3.9307895800092710610e4,
                           2.8729085735721942674e4,
                           5.2264952788528545610e3};
  constexpr double c[8] = {1.42343711074968357734e0,  4.63033784615654529590e0, 5.76949722146069140550e0,
                           3.64784832476320460504e0,  1.27045825245236838258e0, 2.41780725177450611770e-1,
                           2.27238449892691845833e-2, 7.74545014278341407640e-4};
  constexpr double d[8] = {1.0,
                           2.05319162663775882187e0,
                           1.67638483018380384940e0,
                           6.89767334985100004550e-1,
                           1.48103976427480074590e-1,
                           1.51986665636164571966e-2,
                           5.47593808499534494600e-4,
                           1.05075007164441684324e-9};
  constexpr double e[8] = {6.65790464350110377720e0,  5.46378491116411436990e0,  1.78482653991729133580e0,
                           2.96560571828504891230e-1, 2.65321895265761230930e-2, 1.24266094738807843860e-3,
                           2.71155556874348757815e-5, 2.01033439929228813265e-7};
  constexpr double f[8] = {1.0,
                           5.99832206555887937690e-1,
                           1.36929880922735805310e-1,
                           1.48753612908506148525e-2,
                           7.86869131145613259100e-4,
                           1.84631831751005468180e-5,
                           1.42151175831644588870e-7,
                           2.04426310338993978564e-15};
  const double q = p - 0.5;
  if (std::abs(q) <= 0.425) return q * ratio(a, b, 0.180625 - q * q);
  const double r = std::sqrt(-portable_log(q < 0 ? p : 1 - p));
  const double x = r <= 5 ? ratio(c, d, r - 1.6) : ratio(e, f, r - 5);
  return q < 0 ? -x : x;
}

}  // namespace

Result<std::vector<float>> draw_noise(const std::string& kind, std::uint64_t seed, std::size_t count) {
  if (kind == "none") return std::vector<float>(count, 0.0f);  // the network does not read the start
  if (kind != "normal" && kind != "uniform") return Error{Code::bad_bundle, "solver.noise", "normal or uniform", kind};
  std::vector<float> values(count);
  for (std::size_t i = 0; i < count; ++i) {
    const double u = open_unit(seed, i);
    values[i] = static_cast<float>(kind == "normal" ? normal_quantile(u) : 2 * u - 1);
  }
  return values;
}

}  // namespace vla
