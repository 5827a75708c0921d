// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "processor/image.h"

/// The parts of `decode_image`, one per file format.
namespace vla::codecs {

using Bytes = std::span<const std::byte>;

/// The pixels and metadata of a PNG or JPEG file.
struct Image {
  int width = 0;
  int height = 0;
  std::vector<std::uint8_t> rgb;   // (height, width, 3)
  std::vector<std::uint8_t> exif;  // a TIFF structure, or empty
  std::string xmp;                 // an XML packet, or empty
};

Error refused(const std::string& where, std::string expected, std::string found, std::string hint = {});
Status check_size(std::int64_t width, std::int64_t height, const std::string& where, const ImageLimits& limits);

/// The size of a PNG or JPEG file's image, and the work of decoding it, from its header.
struct ImageHeader {
  int width = 0, height = 0;
  std::int64_t work = 0;  // work of decoding, in units of about 10 ns (one pixel)
};

/// Reads only the header and the positions of scans. Errors: those of `decode_image` that a header shows.
Result<ImageHeader> read_header(Bytes file, const std::string& where, const ImageLimits& limits);

/// The reason why the frame cannot come from a camera, if there is one: all pixels are equal, or all bytes are 0 or 1.
std::optional<std::string> suspicious(const Frame& frame);

bool is_png(Bytes file);
bool is_jpeg(Bytes file);
Result<ImageHeader> png_header(Bytes file, const std::string& where, const ImageLimits& limits);
Result<ImageHeader> jpeg_header(Bytes file, const std::string& where, const ImageLimits& limits);
Result<Image> decode_png(Bytes file, const std::string& where, const ImageLimits& limits);
Result<Image> decode_jpeg(Bytes file, const std::string& where, const ImageLimits& limits);

/// Encodes pixels (height, width, 3) as a JPEG of this quality with 4:2:0 subsampling and decodes it with the fast
/// integer DCT, like TensorFlow's encode_jpeg and decode_jpeg. Throws std::bad_alloc.
std::vector<std::uint8_t> through_jpeg(const std::vector<std::uint8_t>& rgb, int width, int height, int quality);

/// The EXIF orientation, 1 to 8, or if there is none the XMP orientation; 1 if there is neither, or no valid value.
/// Source: Pillow Image.getexif, TiffImagePlugin ImageFileDirectory_v2.load.
int orientation(std::span<const std::uint8_t> exif, const std::string& xmp);

}  // namespace vla::codecs
