// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <csetjmp>
#include <cstdio>  // jpeglib.h needs FILE
#include <cstring>

#include <jpeglib.h>

#include <jerror.h>

#include "processor/image_codecs.h"

namespace vla::codecs {
namespace {

constexpr int kMaxScans = 200;  // of a progressive file; more is an attack on the decoder's time

/// libjpeg reports errors through a function that must not return; it jumps, which destroys nothing. So everything that
/// owns memory lives here, outside the functions that a jump leaves, and those (`guarded_*`) hold only plain values.
struct JpegReader {
  jpeg_decompress_struct jpeg{};
  jpeg_error_mgr errors{};
  jpeg_progress_mgr progress{};
  std::jmp_buf jump{};
  char message[JMSG_LENGTH_MAX] = {};
  std::vector<std::uint8_t> pixels;

  JpegReader() = default;
  JpegReader(const JpegReader&) = delete;
  JpegReader& operator=(const JpegReader&) = delete;
  ~JpegReader() { jpeg_destroy_decompress(&jpeg); }
};

[[noreturn]] void fail(j_common_ptr jpeg) {
  auto* reader = static_cast<JpegReader*>(jpeg->client_data);
  jpeg->err->format_message(jpeg, reader->message);
  std::longjmp(reader->jump, 1);
}

/// Warnings (level -1) say that data was missing or wrong and something was made up instead.
void on_message(j_common_ptr jpeg, int level) {
  if (level < 0) fail(jpeg);
}

void on_progress(j_common_ptr jpeg) {
  auto* reader = static_cast<JpegReader*>(jpeg->client_data);
  if (reader->jpeg.input_scan_number <= kMaxScans) return;
  std::strncpy(reader->message, "too many scans", sizeof reader->message - 1);
  std::longjmp(reader->jump, 1);
}

bool guarded_header(JpegReader& reader, Bytes file) {
  reader.jpeg.err = jpeg_std_error(&reader.errors);
  reader.errors.error_exit = fail;
  reader.errors.emit_message = on_message;
  reader.jpeg.client_data = &reader;
  if (setjmp(reader.jump) != 0) return false;
  jpeg_create_decompress(&reader.jpeg);
  reader.progress.progress_monitor = on_progress;
  reader.jpeg.progress = &reader.progress;
  jpeg_mem_src(&reader.jpeg, reinterpret_cast<const unsigned char*>(file.data()), file.size());
  jpeg_save_markers(&reader.jpeg, JPEG_APP0 + 1, 0xFFFF);
  jpeg_read_header(&reader.jpeg, TRUE);
  return true;
}

bool guarded_pixels(JpegReader& reader) {
  if (setjmp(reader.jump) != 0) return false;
  reader.jpeg.out_color_space = JCS_RGB;
  jpeg_start_decompress(&reader.jpeg);
  const std::size_t row_size = static_cast<std::size_t>(reader.jpeg.output_width) * 3;
  while (reader.jpeg.output_scanline < reader.jpeg.output_height) {
    JSAMPROW row = reader.pixels.data() + reader.jpeg.output_scanline * row_size;
    jpeg_read_scanlines(&reader.jpeg, &row, 1);
  }
  jpeg_finish_decompress(&reader.jpeg);
  return true;
}

/// The text after `name` when the marker starts with it.
std::string_view payload(jpeg_saved_marker_ptr marker, std::string_view name) {
  const std::string_view data(reinterpret_cast<const char*>(marker->data), marker->data_length);
  return data.starts_with(name) ? data.substr(name.size()) : std::string_view{};
}

void read_metadata(const JpegReader& reader, Image& image) {
  using namespace std::string_view_literals;
  std::string exif;
  for (jpeg_saved_marker_ptr marker = reader.jpeg.marker_list; marker != nullptr; marker = marker->next) {
    exif += payload(marker, "Exif\0\0"sv);
    if (const auto xmp = payload(marker, "http://ns.adobe.com/xap/1.0/\0"sv); !xmp.empty()) image.xmp = xmp;
  }
  if (exif.starts_with("Exif\0\0"sv)) exif.erase(0, 6);  // some cameras write the name twice
  image.exif.assign(exif.begin(), exif.end());
}

Error corrupt(const JpegReader& reader, const std::string& where) {
  if (reader.errors.msg_code == JERR_OUT_OF_MEMORY)
    return {Code::out_of_memory, where, "", "no memory for the JPEG decoder"};
  return refused(where, "a whole JPEG image", reader.message[0] != 0 ? reader.message : "a damaged one");
}

}  // namespace

bool is_jpeg(Bytes file) {
  constexpr std::uint8_t kStart[] = {0xFF, 0xD8, 0xFF};
  return file.size() >= sizeof kStart && std::memcmp(file.data(), kStart, sizeof kStart) == 0;
}

Result<Image> decode_jpeg(Bytes file, const std::string& where, const ImageLimits& limits) {
  JpegReader reader;
  if (!guarded_header(reader, file)) return corrupt(reader, where);
  const auto width = static_cast<std::int64_t>(reader.jpeg.image_width);
  const auto height = static_cast<std::int64_t>(reader.jpeg.image_height);
  VLA_CHECK(check_size(width, height, where, limits));
  if (reader.jpeg.num_components != 1 && reader.jpeg.num_components != 3)
    return refused(where, "a grey or RGB JPEG",
                   reader.jpeg.num_components == 4 ? "a CMYK one" : "another number of channels", "convert it to RGB");
  Image image{static_cast<int>(width), static_cast<int>(height), {}, {}, {}};
  read_metadata(reader, image);  // now, because finishing frees the markers
  reader.pixels.resize(static_cast<std::size_t>(width * height) * 3);
  if (!guarded_pixels(reader)) return corrupt(reader, where);
  image.rgb = std::move(reader.pixels);
  return image;
}

}  // namespace vla::codecs
