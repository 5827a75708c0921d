# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Image files made byte by byte, sound and otherwise."""

import struct
import zlib


def _chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_header(width, height):
    """Signature and IHDR of an 8-bit RGB image of that size."""
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))


def png(frame):
    """A frame (height, width, 3) uint8 as PNG."""
    rows = b"".join(b"\0" + row.tobytes() for row in frame)
    height, width, _ = frame.shape
    return png_header(width, height) + _chunk(b"IDAT", zlib.compress(rows)) + _chunk(b"IEND", b"")


def png_of_rows(width, height, n_row):
    """A black image that has the first `n_row` of its rows; the file is about a thousandth of them."""
    compressor, row = zlib.compressobj(1), bytes(1 + 3 * width)
    body = b"".join(compressor.compress(row) for _ in range(n_row)) + compressor.flush()
    return png_header(width, height) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def jpeg_with_size(data, width, height):
    """A JPEG file whose frame header claims another size."""
    at = next(i for i in range(len(data)) if data[i] == 0xFF and data[i + 1] in (0xC0, 0xC1, 0xC2))
    return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]
