// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Prints hashes of what must be the same bytes on every machine and that no golden case shows: noise, resized pixels,
// codes of weights. Builds for two machines agree where their outputs do (arm64_test.py).
#include <xxhash.h>

#include <cstdio>

#include "engine/noise.h"
#include "kernels/quantize_weights.h"
#include "processor/resample.h"

using namespace vla;

namespace {

template <class T>
void say(const char* name, const std::vector<T>& all) {
  std::printf("%-28s %016llx %zu\n", name,
              static_cast<unsigned long long>(XXH3_64bits(all.data(), all.size() * sizeof(T))), all.size());
}

class Numbers {
 public:
  double uniform() {  // Source: Knuth's MMIX generator
    state_ = state_ * 6364136223846793005ULL + 1442695040888963407ULL;
    return static_cast<double>(state_ >> 11) * 0x1p-53;
  }

 private:
  std::uint64_t state_ = 1;
};

void say_noise() {
  for (const char* kind : {"normal", "uniform"})
    for (std::uint64_t seed : {0ULL, 77ULL, 0xffffffffffffffffULL}) say(kind, *draw_noise(kind, seed, 50000));
}

void say_pixels(Numbers& numbers) {
  constexpr int kWidth = 173, kHeight = 131;
  std::vector<std::uint8_t> rgb(kWidth * kHeight * 3);
  for (std::uint8_t& byte : rgb) byte = static_cast<std::uint8_t>(numbers.uniform() * 256);
  for (const auto& [w, h] : {std::pair{96, 96}, {224, 224}, {61, 200}, {400, 37}}) {
    std::printf("to %d x %d\n", w, h);
    say("Pillow, bilinear", resample_pillow_bilinear(rgb, kWidth, kHeight, w, h));
    say("Pillow, bicubic", resample_pillow_bicubic(rgb, kWidth, kHeight, w, h));
    say("torch, bicubic of bytes", resample_torch_16bit(rgb, kWidth, kHeight, w, h));
    say("OpenCV, linear", resample_opencv(rgb, kWidth, kHeight, w, h));
    say("OpenCV, area", resample_opencv_area(rgb, kWidth, kHeight, w, h));
    say("torch, bicubic", resample_torch(rgb, kWidth, kHeight, w, h));
    say("torch, linear", resample_torch_linear(rgb, kWidth, kHeight, w, h));
    say("TensorFlow, lanczos3", resample_tensorflow_lanczos3(rgb, kWidth, kHeight, w, h));
    say("TensorFlow, crop", crop_tensorflow(rgb, kWidth, kHeight, 0.9, w, h));
  }
}

void say_codes(Numbers& numbers) {
  constexpr std::int64_t kIn = 768, kOut = 2048;
  std::vector<float> weights(kIn * kOut), scales(kOut), room(kIn);
  for (float& w : weights) w = static_cast<float>(numbers.uniform() - 0.5);
  std::vector<std::byte> codes(weights.size());
  kernels::quantize_weights(DType::f32, reinterpret_cast<const std::byte*>(weights.data()), kIn, kOut, codes.data(),
                            scales.data(), room.data());
  say("codes of weights", codes);
  say("their scales", scales);
}

}  // namespace

int main() {
  Numbers numbers;
  say_noise();
  say_pixels(numbers);
  say_codes(numbers);
}
