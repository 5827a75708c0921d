# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes what TensorFlow makes of `frame_of` into tests/processor/data/: tensorflow.json, tensorflow.npy.

    python tests/reference/make_tensorflow_data.py          # needs tensorflow-cpu 2.18 and numpy

Per case: width, height, target width and height, and lanczos3 (tf.image.resize) or crop_and_resize (as BitVLA's evaluation crops).
"""

import json
import pathlib

import numpy as np
import tensorflow as tf

DATA = pathlib.Path(__file__).resolve().parents[1] / "processor" / "data"
SIZES = [(64, 48, 20, 20), (48, 64, 20, 20), (7, 5, 16, 16), (33, 47, 28, 28), (9, 9, 9, 9), (1, 1, 5, 3), (300, 9, 30, 2), (30, 30, 7, 1)]


def frame_of(width, height):
    y, x, c = np.mgrid[0:height, 0:width, 0:3]
    return ((x * 7 + y * 13 + c * 29 + (x * y) % 17) % 256).astype(np.uint8)


def lanczos3(frame, width, height):
    image = tf.image.resize(frame, (height, width), method="lanczos3", antialias=True)
    return tf.cast(tf.clip_by_value(tf.round(image), 0, 255), tf.uint8).numpy()


def crop_and_resize(frame, width, height):
    side = tf.sqrt(tf.constant([0.9]))
    begin = (1 - side) / 2
    box = tf.stack([begin, begin, begin + side, begin + side], axis=1)
    image = tf.image.crop_and_resize(tf.image.convert_image_dtype(frame, tf.float32)[None], box, [0], (height, width))[0]
    return tf.image.convert_image_dtype(tf.clip_by_value(image, 0, 1), tf.uint8, saturate=True).numpy()


cases, images = [], []
for make in lanczos3, crop_and_resize:
    for width, height, to_width, to_height in SIZES:
        images.append(make(frame_of(width, height), to_width, to_height).flatten())
        cases.append([width, height, to_width, to_height, make.__name__])
(DATA / "tensorflow.json").write_text(json.dumps(cases) + "\n")
np.save(DATA / "tensorflow.npy", np.concatenate(images))
