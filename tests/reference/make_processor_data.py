# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes tests/processor/data: small inputs and what the reference makes of them.

    python tests/reference/make_processor_data.py tests/processor/data

Run in an environment with Pillow, OpenCV, torch, lerobot and tokenizers.  What the files hold:
  tokenizer_*.json, tokenizer_cases.json   tokenizers of tokenizer_zoo.py as bundle keys; texts and ids
  images/*.png, *.jpg and *.npy            image files and Pillow's pixels of them; images without .npy are to be refused
  letterbox.json, letterbox.npy            frame and target sizes and the kind of letterbox; the planes that the references
                                           make of `frame_of`, one after another
  resize.json, resize.npy                  frame and target sizes and the filter; OpenCV's and torch's bytes
  standardize.npy                          torch's (x - mean) / std of every byte / 255: arithmetic, channel, byte
  views.json                               texts behind the places of views, and the ids of the tokenizer `qwen`
  vectors.json                             lerobot's, openpi's and Evo-1's normalize and unnormalize
  prompts.json                             lerobot's prompts with the state in words
  aloha.json                               openpi's conventions for the ALOHA robot, both ways
"""

import io
import json
import pathlib
import random
import struct
import sys
import zlib

import numpy as np
import tokenizers
import torch
from bundle_tokenizer import keys_of
from PIL import Image, PngImagePlugin
from resize_references import REFERENCES
from tokenizer_zoo import SENTENCES, ZOO, fuzz_string

DATA = pathlib.Path(sys.argv[1])


def write_tokenizers() -> None:
    cases = {}
    for name, make in ZOO.items():
        tokenizer = make()
        keys = keys_of(tokenizer)
        (DATA / f"tokenizer_{name}.json").write_text(json.dumps(keys, ensure_ascii=False, separators=(",", ":")) + "\n")
        added = [token["content"] for token in json.loads(keys["tokenizer.added"])]
        rng, texts = random.Random(11), SENTENCES if name == "smol" else SENTENCES[:5]
        texts = [*texts, "pick up the robot's cube " * 8]
        while len(texts) < 500:
            text = fuzz_string(rng, added)
            if len(text.encode()) <= 30:
                texts.append(text)
        cases[name] = [[text, *encoding.ids] for text, encoding in zip(texts, tokenizer.encode_batch(texts))]
    lines = [f'"{name}": [\n' + ",\n".join(json.dumps(case, ensure_ascii=False, separators=(",", ":")) for case in list) + "]" for name, list in cases.items()]
    (DATA / "tokenizer_cases.json").write_text("{" + ",\n".join(lines) + "}\n")


def image(width: int, height: int, channels: int = 3) -> np.ndarray:
    y, x, c = np.mgrid[0:height, 0:width, 0:channels]
    return ((x * 23 + y * 37 + c * 71 + (x * y) % 11 * 5) % 256).astype(np.uint8)


def smooth(width: int, height: int, channels: int = 3) -> np.ndarray:
    y, x, c = np.mgrid[0:height, 0:width, 0:channels]
    return (127 + 90 * np.sin(x / 3 + c) * np.cos(y / 4 - c)).astype(np.uint8)


def saved(image: Image.Image, format: str, **options) -> bytes:
    out = io.BytesIO()
    image.save(out, format, **options)
    return out.getvalue()


def exif_block(orientation: int, big_endian: bool = False) -> bytes:
    order = ">" if big_endian else "<"
    head = (b"MM" if big_endian else b"II") + struct.pack(order + "HI", 42, 8)
    # A make, whose text lies elsewhere, stands before the orientation.
    entries = struct.pack(order + "HHII", 0x010F, 2, 6, 38) + struct.pack(order + "HHIHH", 0x0112, 3, 1, orientation, 0)
    return head + struct.pack(order + "H", 2) + entries + struct.pack(order + "I", 0) + b"robot\0"


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, depth: int, colour: int, rows: bytes, before: list = (), interlace: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlace)
    chunks = [(b"IHDR", header), *before, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(kind, data) for kind, data in chunks)


def interlaced(array: np.ndarray) -> bytes:
    """Adam7, which Pillow reads and does not write."""
    rows = b""
    for y0, x0, dy, dx in [(0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)]:
        part = array[y0::dy, x0::dx]
        if part.size:
            rows += b"".join(b"\0" + row.tobytes() for row in part)
    return png(array.shape[1], array.shape[0], 8, 2, rows, interlace=1)


def bits(width: int, height: int, depth: int, top: int) -> bytes:
    """Rows of packed samples 0 .. top."""
    rows = b""
    for y in range(height):
        samples = "".join(format((x + y) % (top + 1), f"0{depth}b") for x in range(width))
        samples += "0" * (-len(samples) % 8)
        rows += b"\0" + int(samples, 2).to_bytes(len(samples) // 8, "big")
    return rows


def readable_images() -> dict:
    rgb, soft = Image.fromarray(image(13, 9)), Image.fromarray(smooth(21, 17))
    grey = Image.fromarray(image(13, 9, 1)[..., 0])
    palette = rgb.quantize(16)
    xmp = b'<x:xmpmeta><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    raw = PngImagePlugin.PngInfo()
    raw.add_text("Raw profile type exif", f"\nexif\n{len(exif_block(8)):8}\n{exif_block(8).hex()}\n", zip=True)
    colours = b"".join(bytes([i * 60, 255 - i * 60, i * 17]) for i in range(4))
    images = {
        "rgb.png": saved(rgb, "PNG"),
        "rgba.png": saved(Image.fromarray(image(13, 9, 4), "RGBA"), "PNG"),
        "grey.png": saved(grey, "PNG"),
        "grey_alpha.png": saved(Image.fromarray(image(13, 9, 2), "LA"), "PNG"),
        "grey_1_bit.png": png(13, 5, 1, 0, bits(13, 5, 1, 1)),
        "grey_2_bit.png": png(13, 5, 2, 0, bits(13, 5, 2, 3)),
        "grey_4_bit_transparent.png": png(13, 5, 4, 0, bits(13, 5, 4, 15), [(b"tRNS", b"\0\3")]),
        "palette.png": saved(palette, "PNG"),
        "palette_transparent.png": saved(palette, "PNG", transparency=3),
        "palette_2_bit.png": png(13, 5, 2, 3, bits(13, 5, 2, 3), [(b"PLTE", colours), (b"tRNS", b"\0\x80")]),
        "rgb_transparent.png": png(2, 1, 8, 2, b"\0" + bytes([1, 2, 3, 4, 5, 6]), [(b"tRNS", b"\0\1\0\2\0\3")]),
        "gamma.png": png(2, 1, 8, 2, b"\0" + bytes([10, 20, 30, 40, 50, 60]), [(b"gAMA", struct.pack(">I", 100000))]),
        "interlaced.png": interlaced(image(13, 9)),
        "exif.png": saved(rgb, "PNG", exif=exif_block(6)),
        "xmp.png": saved(rgb, "PNG", pnginfo=text),
        "rgb.jpg": saved(soft, "JPEG", quality=85),
        "rgb_444.jpg": saved(soft, "JPEG", quality=90, subsampling=0),
        "rgb_422.jpg": saved(soft, "JPEG", quality=90, subsampling=1),
        "grey.jpg": saved(soft.convert("L"), "JPEG"),
        "progressive.jpg": saved(soft, "JPEG", progressive=True),
        "restart.jpg": saved(soft, "JPEG", restart_marker_rows=1),
        "stored_as_rgb.jpg": saved(soft, "JPEG", keep_rgb=True),
        "xmp.jpg": saved(soft, "JPEG", xmp=xmp),
        "exif_broken.jpg": saved(soft, "JPEG", exif=b"Exif\0\0nothing of the kind"),
        "exif_as_text.png": saved(rgb, "PNG", pnginfo=raw),
        "exif_unknown.jpg": saved(soft, "JPEG", exif=b"Exif\0\0" + exif_block(9)),
        "exif_before_xmp.jpg": saved(soft, "JPEG", exif=b"Exif\0\0" + exif_block(3), xmp=xmp),
        "one_pixel.jpg": saved(soft.crop((0, 0, 1, 1)), "JPEG"),
    }
    for value in range(1, 9):
        images[f"exif_{value}.jpg"] = saved(soft.crop((0, 0, 11, 7)), "JPEG", exif=b"Exif\0\0" + exif_block(value, value % 2 == 0))
    return images


def refused_images() -> dict:
    rgb, soft = Image.fromarray(image(13, 9)), Image.fromarray(smooth(21, 17))
    whole, jpeg = saved(rgb, "PNG"), saved(soft, "JPEG")
    return {
        "bad_16_bit.png": png(2, 1, 16, 0, b"\0" + bytes(4)),
        "bad_16_bit_rgb.png": png(1, 1, 16, 2, b"\0" + bytes(6)),
        "bad_truncated.png": whole[: len(whole) // 2],
        "bad_no_end.png": whole[:-12],
        "bad_checksum.png": whole[:60] + bytes([whole[60] ^ 1]) + whole[61:],
        "bad_palette_index.png": png(2, 1, 8, 3, b"\0\0\5", [(b"PLTE", bytes(6))]),
        "bad_few_rows.png": png(2, 4, 8, 0, b"\0\1\2"),
        "bad_huge.png": png(20000, 20000, 8, 2, b""),
        "bad_truncated.jpg": jpeg[: len(jpeg) * 2 // 3],
        "bad_no_end.jpg": jpeg[:-2],
        "bad_header_only.jpg": jpeg[:20],
        "bad_cmyk.jpg": saved(soft.convert("CMYK"), "JPEG"),
        "bad_huge.jpg": jpeg.replace(struct.pack(">HH", 17, 21), struct.pack(">HH", 20000, 20000)),
    }


def write_images() -> None:
    folder = DATA / "images"
    folder.mkdir(exist_ok=True)
    for name, data in {**readable_images(), **refused_images()}.items():
        (folder / name).write_bytes(data)
    for name, data in readable_images().items():
        image = Image.open(io.BytesIO(data))
        pixels = np.array(image.convert("RGB"))
        np.save(folder / (name + ".npy"), pixels)


def frame_of(width: int, height: int) -> np.ndarray:
    y, x, c = np.mgrid[0:height, 0:width, 0:3]
    return ((x * 7 + y * 13 + c * 29 + (x * y) % 17) % 256).astype(np.uint8)


def write_letterbox() -> None:
    from lerobot.policies.common.vla_utils import resize_with_pad, resize_with_pad_torch

    cases, planes = [], []
    sizes = [
        (64, 48, 20, 20), (48, 64, 20, 20), (7, 5, 16, 16), (5, 7, 19, 11), (24, 16, 24, 16), (24, 15, 24, 16), (131, 17, 24, 8),
        (641, 480, 20, 16), (1921, 1079, 20, 12), (3001, 9, 340, 2), (4099, 4001, 16, 16), (1, 1, 9, 5), (90, 1, 90, 3), (33, 100, 14, 23),
    ]  # fmt: skip
    for kind in ("bottom_right", "center", "pillow"):
        for width, height, to_width, to_height in sizes if kind == "bottom_right" else sizes[:10]:
            image = torch.from_numpy(frame_of(width, height)).permute(2, 0, 1)[None].float().div(255)
            if kind == "bottom_right":
                image = resize_with_pad(image, to_height, to_width, pad_value=0)
            elif kind == "center":
                image = resize_with_pad_torch(image, to_height, to_width)
            else:
                image = pillow_letterbox(frame_of(width, height), to_width, to_height)
            planes.append((image * 2.0 - 1.0).flatten().numpy())
            cases.append([width, height, to_width, to_height, kind])
    (DATA / "letterbox.json").write_text(json.dumps(cases) + "\n")
    np.save(DATA / "letterbox.npy", np.concatenate(planes))


def pillow_letterbox(frame: np.ndarray, width: int, height: int) -> torch.Tensor:
    """openpi image_tools.py; columns before rows, as Pillow did in one call before release 12."""
    image = Image.fromarray(frame)
    ratio = max(image.width / width, image.height / height)
    size = (int(image.width / ratio), int(image.height / ratio))
    small = image.resize((size[0], image.height), Image.BILINEAR).resize(size, Image.BILINEAR)
    canvas = Image.new("RGB", (width, height), 0)
    canvas.paste(small, ((width - small.width) // 2, (height - small.height) // 2))
    return torch.from_numpy(np.array(canvas)).permute(2, 0, 1).float().div(255)


def write_resize() -> None:
    cases, planes = [], []
    sizes = [
        (64, 48, 20, 20), (48, 64, 20, 20), (7, 5, 16, 16), (16, 12, 8, 6), (16, 12, 8, 7), (40, 24, 8, 6), (9, 9, 9, 9), (1, 1, 5, 3),
        (5, 1, 10, 3), (21, 30, 42, 60), (300, 9, 30, 2), (90, 52, 28, 28), (13, 40, 13, 20), (40, 13, 20, 13),
    ]  # fmt: skip
    for name, resize in REFERENCES.items():
        for case in sizes:
            planes.append(resize(frame_of(*case[:2]), *case[2:]).flatten())
            cases.append([*case, name])
    (DATA / "resize.json").write_text(json.dumps(cases) + "\n")
    np.save(DATA / "resize.npy", np.concatenate(planes))


def write_standardize() -> None:
    """ImageNet's numbers, by lerobot policies/evo1/internvl3_embedder.py and by the first release of Evo-1."""
    x = (torch.arange(256).float() / 255).expand(3, 256)
    mean, std = torch.tensor([[0.485], [0.456], [0.406]]), torch.tensor([[0.229], [0.224], [0.225]])
    bf16 = torch.bfloat16
    rows = [(x - mean) / std, (x.to(bf16) - mean.to(bf16)) / std.to(bf16), ((x - mean) / std).to(bf16)]
    np.save(DATA / "standardize.npy", torch.stack([row.float() for row in rows]).numpy())


def write_views() -> None:
    """The prompt as lerobot policies/evo1/internvl3_embedder.py builds it (_build_multimodal_prompts), with five tokens a view."""
    tokenizer, cases = ZOO["qwen"](), []
    for text in ["pick up the red cube", "  Cafe\u0301 'S 12\r\n\n", "   ", "\u0301accent first", ".", "\u1161", "'s"]:
        prompt = "".join(f"Image-{i + 1}: <img>{'<IMG_CONTEXT>' * 5}</img>\n" for i in range(3)) + text.strip()
        cases.append([text, *tokenizer.encode(prompt).ids])
    (DATA / "views.json").write_text("[" + ",\n".join(json.dumps(case) for case in cases) + "]\n")


def evo1_normalize(kind: str, inverse: bool, low, high, x, eps: float = 1e-8):
    """Evo-1 scripts/Evo1_server.py (Normalizer._normalize_tensor, _denormalize_tensor) without its clamp."""
    if kind == "evo1_mean_std":
        return x * (high + eps) + low if inverse else (x - low) / (high + eps)
    return (x + 1.0) / 2.0 * (high - low + eps) + low if inverse else 2 * (x - low) / (high - low + eps) - 1


def short_json(value) -> str:
    """Nine digits give every float32 back."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}": {short_json(item)}' for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(short_json(item) for item in value) + "]"
    return format(value, ".9g") if isinstance(value, float) else json.dumps(value)


def openpi_normalize(kind: str, inverse: bool, low, high, x):
    """openpi transforms.py (Normalize, Unnormalize), whose epsilon is a literal."""
    spread = (high if kind == "openpi_mean_std" else high - low) + 1e-6
    if kind == "openpi_mean_std":
        return x * spread + low if inverse else (x - low) / spread
    return (x + 1.0) / 2.0 * spread + low if inverse else (x - low) / spread * 2.0 - 1.0


def write_prompts() -> None:
    """States at and around the edges of the bins, and texts with every kind of white space."""
    from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep

    edges = (-1 + np.arange(0, 257, 5) / 128).astype(np.float32)
    around = np.concatenate([np.nextafter(edges, np.float32(-9)), edges, np.nextafter(edges, np.float32(9))])
    states = np.concatenate([around, [-1.5, -1.0, 1.0, 1.5, -0.0, 0.0, 1e-9, -1e-9, 0.9921874, 0.9921875, 3e38, -3e38]]).astype(np.float32)
    rng, cases = np.random.default_rng(3), []
    texts = ["put the cup", " \t put_the cup\n", "a\nb_c\n\n", "\x1c\x1f\x85\xa0\u2003\u3000go\u2028\u1680", "\u200bgo\ufeff", "{state} {instruction}", "   ", "_x_"]
    for i, text in enumerate(texts):
        state = states if i == 0 else rng.normal(size=i, scale=0.7).astype(np.float32)
        transition = {"observation": {"observation.state": torch.from_numpy(state)[None]}, "complementary_data": {"task": [text]}}
        prompt = Pi05PrepareStateTokenizerProcessorStep()(transition)["complementary_data"]["task"][0]
        cases.append({"text": text, "state": [float(v) for v in state], "prompt": prompt})
    (DATA / "prompts.json").write_text("[" + ",\n".join(short_json(case) for case in cases) + "]\n")


def write_aloha() -> None:
    """openpi policies/aloha_policy.py (_decode_state, _encode_actions) with its constants."""
    flips = np.array([1, -1, -1, 1, 1, 1, 1, 1, -1, -1, 1, 1, 1, 1])
    rng = np.random.default_rng(4)
    cases = []
    for opening in (0.0, 0.1, 0.37, 0.62, 1.0, 1.3):
        x = rng.normal(size=14).astype(np.float32)
        x[[6, 13]] = opening, 1 - opening
        state, action = flips * x, flips * x
        metres = state[[6, 13]] * (0.05800 - 0.01844) + 0.01844
        radians = np.arcsin(np.clip((0.022**2 + metres**2 - 0.036**2) / (2 * 0.022 * metres), -1.0, 1.0))
        state[[6, 13]] = (radians - 0.5476) / (1.6296 - 0.5476)
        action[[6, 13]] = (action[[6, 13]] + 0.5476 + 0.6213) / (1.4910 + 0.6213)
        cases.append({"x": [float(v) for v in x], "state": list(state), "action": list(action)})
    (DATA / "aloha.json").write_text("[" + ",\n".join(short_json(case) for case in cases) + "]\n")


def write_vectors() -> None:
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.processor.normalize_processor import NormalizerProcessorStep

    rng = np.random.default_rng(5)
    names = {"MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"), "QUANTILE10": ("q10", "q90")}
    cases = []
    for mode, (low_name, high_name) in names.items():
        low = rng.normal(size=12).astype(np.float32)
        high = (np.abs(low) if mode == "MEAN_STD" else low + np.abs(rng.normal(size=12))).astype(np.float32)
        high[3] = 0 if mode == "MEAN_STD" else low[3]
        high[7] = 1e-6 if mode == "MEAN_STD" else np.nextafter(low[7], np.float32(9))
        x = rng.normal(size=12, scale=2).astype(np.float32)
        x[3] = low[3] + np.float32(0.25)
        step = NormalizerProcessorStep(
            features={"observation.state": PolicyFeature(FeatureType.STATE, (12,))},
            norm_map={FeatureType.STATE: NormalizationMode[mode]},
            stats={"observation.state": {low_name: torch.from_numpy(low), high_name: torch.from_numpy(high)}},
        )
        for inverse in (False, True):
            y = step._apply_transform(torch.from_numpy(x), "observation.state", FeatureType.STATE, inverse=inverse)
            columns = {"low": low, "high": high, "x": x, "y": y.numpy()}
            cases.append({"kind": mode.lower(), "inverse": inverse, "eps": 1e-8, **{k: [float(v) for v in column] for k, column in columns.items()}})
    for kind in ("openpi_mean_std", "openpi_quantiles"):
        low, x = rng.normal(size=(2, 12)).astype(np.float32)
        high = (np.abs(low) if kind == "openpi_mean_std" else low + np.abs(rng.normal(size=12))).astype(np.float32)
        high[3] = 0 if kind == "openpi_mean_std" else low[3]
        for inverse in (False, True):
            y = openpi_normalize(kind, inverse, *(column.astype(np.float64) for column in (low, high, x))).astype(np.float32)
            columns = {"low": low, "high": high, "x": x, "y": y}
            cases.append({"kind": kind, "inverse": inverse, "eps": 1e-6, **{k: [float(v) for v in column] for k, column in columns.items()}})
    for kind in ("evo1_mean_std", "evo1_min_max", "evo1_quantiles"):
        low, x = rng.normal(size=(2, 12)).astype(np.float32)
        high = (np.abs(low) if kind == "evo1_mean_std" else low + np.abs(rng.normal(size=12))).astype(np.float32)
        high[3] = 0 if kind == "evo1_mean_std" else low[3]
        high[7] = 1e-7 if kind == "evo1_mean_std" else np.nextafter(low[7], np.float32(9))
        for inverse in (False, True):
            y = evo1_normalize(kind, inverse, *map(torch.from_numpy, (low, high, x))).numpy()
            columns = {"low": low, "high": high, "x": x, "y": y}
            cases.append({"kind": kind, "inverse": inverse, "eps": 1e-8, **{k: [float(v) for v in column] for k, column in columns.items()}})
    (DATA / "vectors.json").write_text("[" + ",\n".join(short_json(case) for case in cases) + "]\n")


def main() -> None:
    torch.set_num_threads(1)
    DATA.mkdir(parents=True, exist_ok=True)
    write_tokenizers()
    write_images()
    write_letterbox()
    write_resize()
    write_standardize()
    write_views()
    write_vectors()
    write_prompts()
    write_aloha()
    import cv2
    import lerobot
    import PIL

    versions = {"opencv": cv2.__version__, "tokenizers": tokenizers.__version__, "pillow": PIL.__version__, "torch": torch.__version__, "lerobot": lerobot.__version__}
    (DATA / "versions.json").write_text(json.dumps(versions) + "\n")


main()
