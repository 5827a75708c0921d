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


def hostile_pngs(sound):
    """{what: (PNG, whether it is an image all the same)}: a sound one with what would make a reader unpack gigabytes."""
    bomb = zlib.compress(bytes(8 << 20), 9)
    after_header = len(png_header(1, 1))

    def with_chunks(*chunks):
        return sound[:after_header] + b"".join(chunks) + sound[after_header:]

    xmp = b"XML:com.adobe.xmp\0\1\0\0\0" + bomb
    return {
        "a thousand packed texts": (with_chunks(*[_chunk(b"zTXt", b"comment\0\0" + bomb)] * 1000), True),
        "a thousand packed international texts": (with_chunks(*[_chunk(b"iTXt", b"comment\0\1\0\0\0" + bomb)] * 1000), True),
        "a packed profile": (with_chunks(_chunk(b"iCCP", b"profile\0\0" + bomb)), True),
        "packed orientations": (with_chunks(*[_chunk(b"iTXt", xmp)] * 200), True),
        "a text of 2 GiB": (with_chunks(struct.pack(">I", 2**31 - 1) + b"tEXtcomment\0"), False),
        "a hundred thousand empty chunks": (with_chunks(*[_chunk(b"teSt", b"")] * 100_000), True),
        "rows that are not there": (png_of_rows(4000, 4000, 1), False),
    }
