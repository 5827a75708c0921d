# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The references of the resize op: interleaved bytes at another size."""

import cv2
import numpy as np
import torch


def opencv_bilinear(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(frame, (width, height))


def torch_bicubic_8bit(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """What torchvision's resize does to an 8-bit tensor: it leaves one of the size alone, and computes in float32 otherwise."""
    if frame.shape[:2] == (height, width):
        return frame
    image = torch.from_numpy(frame).permute(2, 0, 1)[None].float()
    image = torch.nn.functional.interpolate(image, size=[height, width], mode="bicubic", align_corners=False, antialias=True)
    return image.clamp(0, 255).round().to(torch.uint8)[0].permute(1, 2, 0).numpy()


REFERENCES = {"opencv_bilinear": opencv_bilinear, "torch_bicubic_8bit": torch_bicubic_8bit}
