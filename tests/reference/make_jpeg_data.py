# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes what a JPEG of `frame_of` leaves of it into tests/processor/data/: jpeg_WxH.npy.

    python tests/reference/make_jpeg_data.py          # needs pillow 13.0.0, simplejpeg 1.9.0 and numpy

Pillow's file at quality 95 has the bytes of tf.io.encode_jpeg but for the density in its header, and libjpeg-turbo's fast integer DCT the
pixels of tf.io.decode_jpeg; both were compared with TensorFlow 2.18.
"""

import io
import pathlib

import numpy as np
import simplejpeg
from PIL import Image

DATA = pathlib.Path(__file__).resolve().parents[1] / "processor" / "data"

for width, height in ((40, 24), (37, 21)):
    y, x, c = np.mgrid[0:height, 0:width, 0:3]
    frame = ((x * 7 + y * 13 + c * 29 + (x * y) % 17) % 256).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "JPEG", quality=95)
    np.save(DATA / f"jpeg_{width}x{height}.npy", simplejpeg.decode_jpeg(file.getvalue(), fastdct=True))
