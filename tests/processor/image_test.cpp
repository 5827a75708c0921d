// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/image.h"

#include <sys/resource.h>
#include <zlib.h>

#include <cstdio>  // jpeglib.h needs FILE
#include <cstdlib>
#include <filesystem>

#include <jpeglib.h>

#include "processor/image_codecs.h"
#include "processor/support.h"

namespace image_test {

using namespace vla;
using namespace vla::test;

namespace {

std::vector<std::uint8_t> pixels(const Frame& frame) { return std::get<std::vector<std::uint8_t>>(frame.rgb); }

std::string refusal_of(const std::string& name) { return refusal(decode_data(name), Code::bad_observation); }

/// Bytes of a .npy file with a header of our choosing.
std::string npy(const std::string& header, const std::string& data) {
  return std::string("\x93NUMPY\1\0", 8) + static_cast<char>(header.size()) + '\0' + header + data;
}

std::string float_npy(const std::vector<float>& values) {
  const std::string data(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(float));
  return npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, " + std::to_string(values.size() / 3) + ", 3), }",
             data);
}

std::string big_endian(std::size_t value) {
  std::string text;
  for (int shift = 24; shift >= 0; shift -= 8) text += static_cast<char>(value >> shift & 0xFF);
  return text;
}

/// A chunk of a PNG file: `type` and what it holds.
std::string chunk(const std::string& content) {
  const auto checksum = crc32(0, reinterpret_cast<const Bytef*>(content.data()), static_cast<uInt>(content.size()));
  return big_endian(content.size() - 4) + content + big_endian(checksum);
}

std::string packed(const std::string& text) {
  std::string out(compressBound(text.size()), '\0');
  uLongf size = out.size();
  REQUIRE(compress(reinterpret_cast<Bytef*>(out.data()), &size, reinterpret_cast<const Bytef*>(text.data()),
                   text.size()) == Z_OK);
  return out.substr(0, size);
}

/// A small image with these chunks behind its header.
std::string png_with(const std::string& chunks) {
  constexpr std::size_t kHeader = 8 + 25;
  return read_text(data_path("images/rgb.png")).insert(kHeader, chunks);
}

/// A black image that announces `height` rows and brings `n_row`.
std::string grey_png(std::size_t width, std::size_t height, std::size_t n_row) {
  const std::string head = "IHDR" + big_endian(width) + big_endian(height) + std::string("\x08\0\0\0\0", 5);
  const std::string rows = packed(std::string((width + 1) * n_row, '\0'));
  return "\x89PNG\r\n\x1A\n" + chunk(head) + chunk("IDAT" + rows) + chunk("IEND");
}

/// A grey image of 8 x 8 whose coefficients come one by one, first without their last bits and then bit by bit.
std::string jpeg_of_scans(int n_bit) {
  std::vector<jpeg_scan_info> scans = {{1, {0}, 0, 0, 0, 0}};
  for (int k = 1; k < 64; ++k) scans.push_back({1, {0}, k, k, 0, n_bit});
  for (int bit = n_bit; bit > 0; --bit)
    for (int k = 1; k < 64; ++k) scans.push_back({1, {0}, k, k, bit, bit - 1});
  jpeg_compress_struct jpeg = {};
  jpeg_error_mgr errors = {};
  jpeg.err = jpeg_std_error(&errors);
  jpeg_create_compress(&jpeg);
  unsigned char* out = nullptr;
  unsigned long size = 0;
  jpeg_mem_dest(&jpeg, &out, &size);
  jpeg.image_width = jpeg.image_height = 8;
  jpeg.input_components = 1;
  jpeg.in_color_space = JCS_GRAYSCALE;
  jpeg_set_defaults(&jpeg);
  jpeg.scan_info = scans.data();
  jpeg.num_scans = static_cast<int>(scans.size());
  jpeg_start_compress(&jpeg, TRUE);
  for (int y = 0; y < 8; ++y) {
    JSAMPLE row[8] = {};
    for (int x = 0; x < 8; ++x) row[x] = static_cast<JSAMPLE>(31 * x * y);
    JSAMPROW rows[] = {row};
    jpeg_write_scanlines(&jpeg, rows, 1);
  }
  jpeg_finish_compress(&jpeg);
  jpeg_destroy_compress(&jpeg);
  const std::string file(reinterpret_cast<const char*>(out), size);
  std::free(out);
  return file;
}

std::string jpeg_segment(int marker, const std::string& content) {
  const std::string size = big_endian(content.size() + 2).substr(2);
  return std::string("\xFF") + static_cast<char>(marker) + size + content;
}

/// Everything of a JPEG up to its first scan. Both of its codes have one word, a zero bit, for a block without
/// anything.
std::string jpeg_start(int kind, std::size_t width, std::size_t height, int n_component) {
  const std::string lengths = '\1' + std::string(15, '\0'), zero(1, '\0');
  std::string frame =
      '\x8' + big_endian(height).substr(2) + big_endian(width).substr(2) + static_cast<char>(n_component);
  for (int i = 1; i <= n_component; ++i) frame += static_cast<char>(i) + std::string("\x11\0", 2);
  return "\xFF\xD8" + jpeg_segment(0xDB, zero + std::string(64, '\1')) + jpeg_segment(kind, frame) +
         jpeg_segment(0xC4, zero + lengths + zero) + jpeg_segment(0xC4, '\x10' + lengths + zero);
}

/// The header of a scan of one component: coefficients `first` to `last` without their lowest `bits`.
std::string jpeg_scan(int component, int first, int last, int bits) {
  std::string content = {1, static_cast<char>(component), 0};
  for (const int number : {first, last, bits}) content += static_cast<char>(number);
  return jpeg_segment(0xDA, content);
}

/// The most memory that this process has had, in bytes.
std::size_t peak_memory() {
  rusage usage = {};
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<std::size_t>(usage.ru_maxrss) * 1024;
}

std::string repeated(const std::string& text, int count) {
  std::string out;
  for (int i = 0; i < count; ++i) out += text;
  return out;
}

const std::string kXmp = "XML:com.adobe.xmp";

}  // namespace

TEST_CASE("a thousand packed texts of 8 MB each cost a PNG nothing") {
  const std::string text = packed(std::string(8 << 20, 'x')), zero(1, '\0');
  for (const std::string& bomb :
       {chunk("zTXtcomment" + zero + zero + text), chunk("iTXtcomment" + zero + '\1' + zero + zero + zero + text),
        chunk("iCCPprofile" + zero + zero + text)}) {
    const std::string file = png_with(repeated(bomb, 1000));
    const std::size_t before = peak_memory();
    const auto frame = decode_image(bytes_of(file), "top");
    REQUIRE_MESSAGE(frame.ok(), frame.error().message());
    CHECK(pixels(*frame) == pixels(*decode_data("rgb.png")));
    CHECK(peak_memory() - before < std::size_t{64} << 20);
  }
}

TEST_CASE("the orientation that a file asks for is told, and its pixels stay as they are stored") {
  const std::string zero(1, '\0'), upright = "<x tiff:Orientation=\"6\"/>";
  const auto plain = decode_data("rgb.png");
  CHECK(plain->orientation == 1);
  for (const std::string& text :
       {chunk("tEXt" + kXmp + zero + upright), chunk("iTXt" + kXmp + repeated(zero, 5) + upright)}) {
    const std::string file = png_with(text);
    const auto frame = decode_image(bytes_of(file), "top");
    REQUIRE_MESSAGE(frame.ok(), frame.error().message());
    CHECK(frame->orientation == 6);
    CHECK(pixels(*frame) == pixels(*plain));
  }
  const std::string raw = "Raw profile type exif" + zero;
  for (const std::string& text :
       {chunk("zTXt" + kXmp + zero + zero + packed(upright)), chunk("tEXt" + raw), chunk("zTXt" + raw + zero),
        chunk("iTXt" + kXmp + zero + '\1' + zero + "en" + zero + "key" + zero + packed(upright))}) {
    const std::string file = png_with(text);
    CHECK(decode_image(bytes_of(file), "top")->orientation == 1);
  }
  for (int value = 1; value <= 8; ++value) {
    const auto frame = decode_data("exif_" + std::to_string(value) + ".jpg");
    REQUIRE(frame.ok());
    CHECK(frame->orientation == value);
    CHECK(frame->width == 11);
    CHECK(frame->height == 7);
  }
}

TEST_CASE("a damaged text is passed over") {
  const std::string zero(1, '\0');
  for (const std::string& content :
       {"tEXt" + kXmp, "iTXt" + kXmp, std::string("tEXt"), std::string("zTXt"), "iTXt" + kXmp + zero}) {
    const std::string file = png_with(chunk(content));
    CHECK(decode_image(bytes_of(file), "top").ok());
  }
}

TEST_CASE("a PNG of many short rows takes no memory beside its pixels") {
  constexpr std::size_t kWidth = 256, kHeight = 1 << 14;
  const std::string file = grey_png(kWidth, kHeight, kHeight);
  const std::size_t before = peak_memory();
  const auto frame = decode_image(bytes_of(file), "top");
  REQUIRE_MESSAGE(frame.ok(), frame.error().message());
  CHECK(peak_memory() - before < 2 * 3 * kWidth * kHeight);
}

TEST_CASE("a PNG that announces 64 million pixels and brings one row takes memory for one row") {
  const std::string file = grey_png(8000, 8000, 1);
  const std::size_t before = peak_memory();
  const auto frame = decode_image(bytes_of(file), "top");
  REQUIRE_FALSE(frame.ok());
  CHECK(contains(frame.error().message(), "expected a whole PNG image"));
  CHECK(peak_memory() - before < std::size_t{64} << 20);  // the pixels are 192 MB
}

TEST_CASE("every readable PNG and JPEG decodes to Pillow's pixels") {
  int compared = 0;
  for (const auto& entry : std::filesystem::directory_iterator(data_path("images"))) {
    const std::string name = entry.path().filename();
    if (name.ends_with(".npy") || name.starts_with("bad_")) continue;
    CAPTURE(name);
    const auto found = decode_data(name), expected = decode_data(name + ".npy");
    REQUIRE_MESSAGE(found.ok(), found.error().message());
    REQUIRE(expected.ok());
    CHECK(found->width == expected->width);
    CHECK(found->height == expected->height);
    CHECK(pixels(*found) == pixels(*expected));
    ++compared;
  }
  CHECK(compared == 36);
}

TEST_CASE("16-bit PNG and CMYK JPEG are refused by name") {
  CHECK(contains(refusal_of("bad_16_bit.png"), "a 16-bit PNG"));
  CHECK(contains(refusal_of("bad_16_bit_rgb.png"), "a 16-bit PNG"));
  CHECK(contains(refusal_of("bad_cmyk.jpg"), "CMYK"));
}

TEST_CASE("truncated and damaged images are refused") {
  for (const char* name : {"bad_truncated.png", "bad_no_end.png", "bad_checksum.png", "bad_few_rows.png"})
    CHECK(contains(refusal_of(name), "expected a whole PNG image"));
  for (const char* name : {"bad_truncated.jpg", "bad_no_end.jpg", "bad_header_only.jpg"})
    CHECK(contains(refusal_of(name), "expected a whole JPEG image"));
  CHECK(contains(refusal_of("bad_palette_index.png"), "beyond its palette"));
}

TEST_CASE("a JPEG of more than 200 scans is refused") {
  const std::string many = jpeg_of_scans(3), most = jpeg_of_scans(2);  // 253 and 190
  const auto frame = decode_image(bytes_of(most), "top");
  REQUIRE_MESSAGE(frame.ok(), frame.error().message());
  const auto refused = decode_image(bytes_of(many), "top");
  REQUIRE_FALSE(refused.ok());
  CHECK(contains(refused.error().message(), "expected at most 200 scans in a JPEG of 8 x 8, found 253 scans"));
}

TEST_CASE("scans times pixels are bounded before a JPEG is decoded") {
  const std::string scan = jpeg_scan(1, 1, 63, 0);
  const std::string file = jpeg_start(0xC2, 4096, 4096, 1) + jpeg_scan(1, 0, 0, 0) + repeated(scan, 16) + "\xFF\xD9";
  const auto refused = decode_image(bytes_of(file), "top");
  CHECK(contains(refusal(refused, Code::bad_observation),
                 "top: expected at most 16 scans in a JPEG of 4096 x 4096, found 17 scans"));
}

TEST_CASE("what decoding costs is known from the header") {
  const std::string black = grey_png(100, 30, 1);
  const auto png = codecs::read_header(bytes_of(black), "top", {});
  REQUIRE_MESSAGE(png.ok(), png.error().message());
  CHECK(png->width == 100);
  CHECK(png->height == 30);
  CHECK(png->work == 3 * 100 * 30);
  const std::string scan = jpeg_scan(1, 1, 63, 0);
  const std::string file = jpeg_start(0xC2, 64, 48, 1) + jpeg_scan(1, 0, 0, 0) + repeated(scan, 8) + "\xFF\xD9";
  const auto jpeg = codecs::read_header(bytes_of(file), "top", {});
  REQUIRE_MESSAGE(jpeg.ok(), jpeg.error().message());
  CHECK(jpeg->width == 64);
  CHECK(jpeg->height == 48);
  CHECK(jpeg->work == 64 * 48 * 3 + static_cast<std::int64_t>(file.size()));
  for (const std::string& cut : {black.substr(0, 20), file.substr(0, 12), std::string("GIF89a")})
    refusal(codecs::read_header(bytes_of(cut), "top", {}), Code::bad_observation);
}

TEST_CASE("a JPEG in arithmetic code is refused") {
  for (const int kind : {0xC9, 0xCA}) {
    const bool progressive = kind == 0xCA;
    const std::string file = jpeg_start(kind, 8, 8, 1) + jpeg_scan(1, 0, progressive ? 0 : 63, 0) + "\xFF\xD9";
    CHECK(contains(refusal(decode_image(bytes_of(file), "top"), Code::bad_observation),
                   "top: expected a JPEG in Huffman code, found arithmetic code"));
  }
}

TEST_CASE("a JPEG without all of its scans is damaged") {
  const std::string end = "\xFF\xD9", zeros(1, '\0');
  const std::string colour = jpeg_start(0xC0, 8, 8, 3), grey = jpeg_start(0xC2, 8, 8, 1);
  const auto sequential = [&](int component) { return jpeg_scan(component, 0, 63, 0) + zeros; };
  const auto first = [&](int bits) { return jpeg_scan(1, 0, 0, bits) + zeros; };
  const auto rest = [&](int bits) { return jpeg_scan(1, 1, 63, bits) + zeros; };
  for (const std::string& whole : {colour + sequential(1) + sequential(2) + sequential(3), grey + first(0) + rest(0)}) {
    const std::string file = whole + end;
    const auto frame = decode_image(bytes_of(file), "top");
    REQUIRE_MESSAGE(frame.ok(), frame.error().message());
  }
  for (const std::string& part : {colour + sequential(1) + sequential(2), grey + first(0), grey + first(0) + rest(1),
                                  grey + first(1) + rest(0)}) {
    const std::string file = part + end;
    CHECK(contains(refusal(decode_image(bytes_of(file), "top"), Code::bad_observation),
                   "top: expected a whole JPEG image, found one without all of its scans"));
  }
}

TEST_CASE("an image that is cut anywhere is refused") {
  for (const char* name : {"interlaced.png", "palette.png", "rgb.jpg", "progressive.jpg"}) {
    const std::string file = read_text(data_path("images/" + std::string(name)));
    for (std::size_t size = 0; size < file.size(); ++size) {
      const std::string part = file.substr(0, size);
      CHECK_FALSE(decode_image(bytes_of(part), name).ok());
    }
  }
}

TEST_CASE("a 20000 x 20000 image is refused by its header") {
  CHECK(contains(refusal_of("bad_huge.png"), "at most 64000000 pixels, found 20000 x 20000"));
  CHECK(contains(refusal_of("bad_huge.jpg"), "at most 64000000 pixels, found 20000 x 20000"));
}

TEST_CASE("an image with a side of more than 16384 pixels is refused by its header") {
  for (const auto& [width, height] : {std::pair{std::size_t{1}, std::size_t{1} << 24}, {16385, 1}}) {
    const std::string file = grey_png(width, height, 1);
    CHECK(contains(refusal(decode_image(bytes_of(file), "top"), Code::bad_observation),
                   "top: expected sides of at most 16384 pixels, found "));
  }
  const std::string longest = grey_png(16384, 1, 1);
  CHECK(decode_image(bytes_of(longest), "top").ok());
  refusal(check_frame({1, 16385, std::vector<std::uint8_t>(3 * 16385)}, "f"), Code::bad_observation);
}

TEST_CASE("the pixel limit is inclusive and holds for every format") {
  for (const char* name : {"rgb.png", "rgb.png.npy", "rgb.jpg", "rgb.jpg.npy"}) {
    const auto frame = decode_data(name);
    REQUIRE(frame.ok());
    const std::int64_t count = frame->width * frame->height;
    CHECK(decode_data(name, {count}).ok());
    refusal(decode_data(name, {count - 1}), Code::bad_observation);
  }
}

TEST_CASE("empty files and files of another kind are refused") {
  CHECK(contains(refusal(decode_image({}, "top.png"), Code::bad_observation),
                 "top.png: expected a PNG, JPEG or .npy image, found an empty file"));
  const std::string gif = "GIF89a..........";
  CHECK(contains(refusal(decode_image(bytes_of(gif), "top.png"), Code::bad_observation), "another kind"));
}

TEST_CASE("a float array in [0, 1] is a frame, other floats are refused") {
  const std::string good = float_npy({0.0f, 0.5f, 1.0f});
  const auto frame = decode_image(bytes_of(good), "f");
  REQUIRE(frame.ok());
  CHECK(std::get<std::vector<float>>(frame->rgb) == std::vector<float>{0.0f, 0.5f, 1.0f});
  for (const float bad :
       {-0.001f, 1.001f, 255.0f, std::numeric_limits<float>::infinity(), std::numeric_limits<float>::quiet_NaN()}) {
    const std::string file = float_npy({0.0f, bad, 1.0f});
    CHECK(contains(refusal(decode_image(bytes_of(file), "f"), Code::bad_observation), "float pixels in [0, 1]"));
  }
}

TEST_CASE("arrays that are not (height, width, 3) are refused") {
  for (const char* shape : {"(6,)", "(2, 3)", "(1, 2, 3, 1)", "(3, 1, 2)", "(0, 2, 3)"}) {
    const std::size_t n = std::string(shape) == "(0, 2, 3)" ? 0 : 6;
    const std::string file =
        npy("{'descr': '|u1', 'fortran_order': False, 'shape': " + std::string(shape) + ", }", std::string(n, 'x'));
    refusal(decode_image(bytes_of(file), "f"), Code::bad_observation);
  }
}

TEST_CASE("a frame whose pixels do not fit its size is refused") {
  CHECK(check_frame({2, 1, std::vector<std::uint8_t>(6)}, "f").ok());
  refusal(check_frame({2, 1, std::vector<std::uint8_t>(5)}, "f"), Code::bad_observation);
  refusal(check_frame({0, 0, std::vector<std::uint8_t>()}, "f"), Code::bad_observation);
  refusal(check_frame({-1, -2, std::vector<float>(6)}, "f"), Code::bad_observation);
}

}  // namespace image_test
