# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Compares decode + letterbox + affine with the references on photographs, at many sizes, aspects and encodings.

    cmake --build --preset cpu --target reference_tool
    python tests/reference/compare_images.py build/cpu/bin/reference_tool PHOTO ... [--variants 10] [--seed 0]

Run in an environment with Pillow, torch and lerobot; the scikit-image wheel has photographs under skimage/data.  Each
photograph is compared as it is and in `--variants` random crops, resizings and encodings (JPEG quality and subsampling,
progressive, EXIF orientation; PNG with alpha, grey, palette), against SmolVLA's letterbox, the centred one of pi0, and
Pillow's own resampling, which openpi uses.  Exit code 1 when any number differs by more than 1e-5.
"""

import argparse
import io
import random
import struct
import subprocess

import numpy as np
import torch
from lerobot.policies.common.vla_utils import resize_with_pad, resize_with_pad_torch
from PIL import Image

TARGETS = [(512, 512), (224, 224), (320, 240), (96, 160), (640, 64)]


class Runtime:
    def __init__(self, tool: str, width: int, height: int, how: str):
        self.shape = (3, height, width)
        self.process = subprocess.Popen([tool, "image", str(width), str(height), *([how] if how else [])], stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def planes(self, file: bytes) -> np.ndarray:
        self.process.stdin.write(struct.pack("<I", len(file)) + file)
        self.process.stdin.flush()
        (count,) = struct.unpack("<I", self.process.stdout.read(4))
        values = np.frombuffer(self.process.stdout.read(4 * count), "<f4")
        return values.reshape(self.shape) if count else values


def reference(file: bytes, width: int, height: int, how: str) -> np.ndarray:
    """The pixels as LeRobot sees them: RGB as stored, channels first, divided by 255; openpi resizes before it divides."""
    stored = Image.open(io.BytesIO(file)).convert("RGB")
    if how == "pillow":
        ratio = max(stored.width / width, stored.height / height)
        size = (int(stored.width / ratio), int(stored.height / ratio))
        # Columns first and then rows, as Pillow did in one call before release 12 and openpi's pinned one does.
        small = stored.resize((size[0], stored.height), Image.BILINEAR).resize(size, Image.BILINEAR)
        stored = Image.new("RGB", (width, height), 0)
        stored.paste(small, ((width - small.width) // 2, (height - small.height) // 2))
    image = torch.from_numpy(np.array(stored)).permute(2, 0, 1)[None].contiguous().float().div(255)
    if how == "center":
        image = resize_with_pad_torch(image, height, width)
    elif not how:
        image = resize_with_pad(image, height, width, pad_value=0)
    return (image * 2.0 - 1.0)[0].numpy()


def exif(orientation: int) -> bytes:
    data = Image.Exif()
    data[0x0112] = orientation
    return data.tobytes()


def variant(image: Image.Image, rng: random.Random) -> tuple[str, bytes]:
    image = image.convert("RGB")
    width, height = rng.randint(image.width // 6, image.width), rng.randint(image.height // 6, image.height)
    left, top = rng.randint(0, image.width - width), rng.randint(0, image.height - height)
    image = image.crop((left, top, left + width, top + height))
    if rng.random() < 0.4:
        factor = rng.choice([0.1, 0.31, 1.7, 2.9])
        image = image.resize((max(8, int(width * factor)), max(8, int(height * factor))))
    out, kind = io.BytesIO(), rng.choice(["jpeg", "jpeg", "jpeg", "grey jpeg", "png", "rgba", "grey", "palette"])
    if "jpeg" in kind:
        options = {"quality": rng.randint(30, 98), "subsampling": rng.choice([0, 1, 2]), "progressive": rng.random() < 0.3}
        orientation = rng.choice([1, 1, 2, 3, 4, 5, 6, 7, 8])
        (image.convert("L") if "grey" in kind else image).save(out, "JPEG", exif=exif(orientation), **options)
        return f"{kind} {image.size} {options} orientation {orientation}", out.getvalue()
    modes = {"png": image, "rgba": image.convert("RGBA"), "grey": image.convert("L"), "palette": image.quantize(64)}
    if kind == "rgba":
        modes[kind].putalpha(image.convert("L"))
    modes[kind].save(out, "PNG", compress_level=1)
    return f"{kind} {image.size}", out.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("tool")
    parser.add_argument("photos", nargs="+")
    parser.add_argument("--variants", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng, compared, equal, worst = random.Random(args.seed), 0, 0, 0.0
    runtimes = [((*target, how), Runtime(args.tool, *target, how)) for target in TARGETS for how in ("", "center", "pillow")]
    for photo in args.photos:
        whole = open(photo, "rb").read()
        files = [("as it is", whole)] + [variant(Image.open(photo), rng) for _ in range(args.variants)]
        for (name, file), (target, runtime) in ((f, r) for f in files for r in runtimes):
            found, expected = runtime.planes(file), reference(file, *target)
            if found.shape != expected.shape:
                raise SystemExit(f"{photo}: {name} to {target}: refused")
            error = float(np.abs(found - expected).max())
            compared, equal, worst = compared + 1, equal + (error == 0.0), max(worst, error)
            if error > 1e-5:
                raise SystemExit(f"{photo}: {name} to {target}: differs by {error}")
    print(f"{compared} images compared, {equal} equal bit for bit, largest difference {worst:.3g}")


main()
