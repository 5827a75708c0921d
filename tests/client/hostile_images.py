# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Images that cost most for what they are: `python tests/client/hostile_images.py FOLDER` writes them as files."""

import io
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
from PIL import Image, ImageFile

ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
PAETH = 4  # the filter that costs most
MOST_MESSAGE = 33_000_000  # bytes of an image that a request holds


def _chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(width, height, noise, passes=((0, 0, 1, 1),), most=256):
    """An RGB image whose rows are those of Paeth's filter, in one pass or in the seven of Adam7."""
    rows = []
    for x, y, step_x, step_y in passes:
        shape = (-(-(height - y) // step_y), 1 + 3 * -(-(width - x) // step_x))
        part = noise.integers(0, most, shape, dtype=np.uint8)
        part[:, 0] = PAETH
        rows.append(part.tobytes())
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, len(passes) > 1)
    body = zlib.compress(b"".join(rows), 1)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _encoded(pixels, format, **options):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format, **options)
    return file.getvalue()


def _turned():
    exif = Image.Exif()
    exif[0x112] = 6
    return exif


def _scans(width, height, n):
    """A progressive grey JPEG of one scan over all pixels, and `n` that refine nothing."""
    table = b"\xff\xdb\0\x43\0" + b"\1" * 64
    frame = b"\xff\xc2" + struct.pack(">HBHHB", 11, 8, height, width, 1) + b"\1\x11\0"
    # One code of one bit in each table: no difference, and the end of 2^14 blocks.
    codes = b"".join(b"\xff\xc4" + struct.pack(">HB", 20, kind) + b"\1" + b"\0" * 15 + bytes([code]) for kind, code in ((0, 0), (0x10, 0xE0)))
    blocks = -(-width // 8) * -(-height // 8)

    def scan(first, last, bits, n_bit):
        return b"\xff\xda" + struct.pack(">HBBBBBB", 8, 1, 1, 0, first, last, bits) + b"\0" * (n_bit // 8 + 1)

    rest = scan(1, 63, 0, 15 * (blocks >> 14) + 15)
    return b"\xff\xd8" + table + frame + codes + scan(0, 0, 0, blocks) + rest * n + b"\xff\xd9"


def files():
    """{name: file} of PNG and JPEG images."""
    ImageFile.MAXBLOCK = 1 << 26  # or Pillow refuses to write noise
    noise, side = np.random.default_rng(0), 4096
    black = np.zeros((side, side, 3), np.uint8)
    random = noise.integers(0, 256, (2600, 2600, 3), dtype=np.uint8)
    line = random.reshape(1, -1, 3)[:, : 4 * side]
    made = {
        "black.png": _encoded(black[:2000, :1800], "PNG"),
        "black.jpg": _encoded(black[:2700], "JPEG"),
        "turned.jpg": _encoded(black[:1750], "JPEG", exif=_turned()),
        "large.png": _png(2 * side, 1, noise).replace(struct.pack(">II", 2 * side, 1), struct.pack(">II", 2 * side, side)),
        "arithmetic.jpg": b"\xff\xd8\xff\xc9" + struct.pack(">HBHHB", 11, 8, side, side, 1) + b"\1\x11\0\xff\xd9",
        "lying.png": _png(8, 8, noise).replace(struct.pack(">II", 8, 8), struct.pack(">II", 60_000, 60_000)),
        "row.jpg": _encoded(line, "JPEG"),
        "column.jpg": _encoded(line.reshape(-1, 1, 3), "JPEG"),
        "column.png": _encoded(line.reshape(-1, 1, 3), "PNG"),
    }
    for size in (1900, 2600):  # the first is about as large as each may be, the second is refused
        made[f"noise_{size}.png"] = _png(size, size, noise)
        made[f"interlaced_{size}.png"] = _png(size, size, noise, ADAM7, most=6)
        for quality, progressive in ((75, False), (75, True), (100, False)):
            name = f"noise_{size}_{quality}{'_progressive' if progressive else ''}.jpg"
            made[name] = _encoded(random[:size, :size], "JPEG", quality=quality, subsampling=0, progressive=progressive)
    for size, n in ((256, 198), (600, 190), (1024, 60), (1300, 36), (2048, 12), (3600, 2), (4096, 14)):
        made[f"scans_{size}_{n}.jpg"] = _scans(size, size, n)
    return {name: file for name, file in made.items() if len(file) < MOST_MESSAGE}


def sizes():
    """(width, height) of raw frames."""
    return (1, 8000), (8000, 1), (1, 16384), (16384, 1), (512, 2048), (2048, 512), (1672, 6576), (6576, 1672), (3316, 3316)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True)
    for name, file in files().items():
        (folder / name).write_bytes(file)
