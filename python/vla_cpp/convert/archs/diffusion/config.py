# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of a Diffusion Policy from its config.json, with refusals of everything that the runtime does not support.

An absent key has the default of the reference's own class, listed here with the key.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Sequence, Tuple

from ...checkpoint import Checkpoint
from ...errors import Problems
from ...lerobot import action_width, check_keys, no_position_rule, state_width, vector_dim
from ...section import Section
from .. import Options
from ..act.config import BACKBONES, ENVIRONMENT, MAX_SIDE, cameras_of

# DiffusionConfig keys with effect on numbers, with the class's defaults.
POLICY = {
    "n_obs_steps": 2,
    "horizon": 64,
    "n_action_steps": 32,
    "normalization_mapping": {"VISUAL": "MEAN_STD", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"},
    "vision_backbone": "resnet18",
    "resize_shape": None,
    "crop_ratio": 1.0,
    "crop_shape": None,
    "pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1",
    "use_group_norm": False,
    "spatial_softmax_num_keypoints": 32,
    "use_separate_rgb_encoder_per_camera": True,
    "down_dims": [512, 1024, 2048],
    "kernel_size": 5,
    "n_groups": 8,
    "diffusion_step_embed_dim": 128,
    "use_film_scale_modulation": True,
    "noise_scheduler_type": "DDPM",
    "num_train_timesteps": 100,
    "beta_schedule": "squaredcos_cap_v2",
    "beta_start": 0.0001,
    "beta_end": 0.02,
    "prediction_type": "epsilon",
    "clip_sample": True,
    "clip_sample_range": 1.0,
    "num_inference_steps": None,
}
# Keys without effect on the numbers of an action chunk, beside those of every LeRobot policy. A crop is random only in training.
IGNORED = set("crop_is_random drop_n_last_frames gradient_checkpointing do_mask_loss_for_padding scheduler_name".split())
SCHEDULERS = {"DDPM": "ddpm", "DDIM": "ddim"}
PREDICTIONS = {"epsilon": "noise", "sample": "sample"}
BETAS = {"DDPM": ("linear", "scaled_linear", "squaredcos_cap_v2", "sigmoid"), "DDIM": ("linear", "scaled_linear", "squaredcos_cap_v2")}
MAX_VIEWS, MAX_MOMENTS, MAX_STEPS, MAX_LEVELS = 64, 64, 1000, 12


@dataclass
class Sizes:
    cameras: Sequence[str]
    frame: Tuple[int, int]  # width, height of a camera's frames
    resized: Optional[Tuple[int, int]]
    image: Tuple[int, int]  # width, height of the network's images
    n_moment: int
    d_state: int  # width of the state at one moment
    d_environment: int  # width of the environment's state; 0: none
    d_action: int
    horizon: int
    n_action_steps: int
    n_block: Sequence[int]
    group_norm: bool
    n_keypoint: int
    separate: bool
    widths: Sequence[int]
    kernel_size: int
    n_group: int
    d_time: int
    scales: bool
    scheduler: str
    n_step: int
    n_train_step: int
    beta_schedule: str
    beta_start: float
    beta_end: float
    predicts: str
    clip: float  # 0: samples are not clipped

    @property
    def encoders(self) -> Sequence[Tuple[str, str]]:
        """The bundle's and the checkpoint's prefix of each image encoder; empty without cameras."""
        at = ["{}.".format(i) for i in range(len(self.cameras))] if self.separate or not self.cameras else [""]
        return [("vision." + i, "diffusion.rgb_encoder." + i) for i in at]

    @property
    def n_cell(self) -> int:
        return ((self.image[0] + 31) // 32) * ((self.image[1] + 31) // 32)

    @property
    def d_observation(self) -> int:
        return self.n_moment * (self.d_state + self.d_environment + 2 * self.n_keypoint * len(self.cameras))


def read_sizes(checkpoint: Checkpoint, options: Options, problems: Problems) -> Sizes:
    policy = Section("config.json", checkpoint.config, POLICY, problems)
    no_position_rule(policy, options, problems)
    check_keys(policy, "DiffusionConfig", set(POLICY) | IGNORED, {})
    _check_words(policy)
    cameras, frame = _read_cameras(policy)
    resized, image = _image_sizes(policy, frame) if cameras else (None, frame)
    features = policy.get("input_features")
    has_environment = isinstance(features, dict) and ENVIRONMENT in features
    scheduler = policy.get("noise_scheduler_type")
    n_train = policy.count("num_train_timesteps", maximum=100_000)
    steps = "num_train_timesteps" if policy.get("num_inference_steps") is None else "num_inference_steps"
    s = Sizes(
        cameras=cameras,
        frame=frame,
        resized=resized,
        image=image,
        n_moment=policy.count("n_obs_steps", maximum=MAX_MOMENTS),
        d_state=state_width(policy, checkpoint, options, padded=False),
        d_environment=vector_dim(policy, "input_features", ENVIRONMENT, "ENV") if has_environment else 0,
        d_action=action_width(policy, checkpoint, options),
        horizon=policy.count("horizon", maximum=4096),
        n_action_steps=policy.count("n_action_steps", maximum=4096),
        n_block=BACKBONES.get(policy.get("vision_backbone"), (1, 1, 1, 1)),
        group_norm=policy.get("use_group_norm") is True,
        n_keypoint=policy.count("spatial_softmax_num_keypoints", maximum=4096),
        separate=policy.get("use_separate_rgb_encoder_per_camera") is True,
        widths=_read_widths(policy),
        kernel_size=policy.count("kernel_size", maximum=255),
        n_group=policy.count("n_groups"),
        d_time=policy.count("diffusion_step_embed_dim", minimum=4),
        scales=policy.get("use_film_scale_modulation") is True,
        scheduler=SCHEDULERS.get(scheduler, "ddpm"),
        n_step=policy.count(steps, maximum=MAX_STEPS),
        n_train_step=n_train,
        beta_schedule=str(policy.get("beta_schedule")),
        beta_start=_share(policy, "beta_start"),
        beta_end=_share(policy, "beta_end"),
        predicts=PREDICTIONS.get(policy.get("prediction_type"), "noise"),
        clip=policy.number("clip_sample_range") if policy.get("clip_sample") is True else 0.0,
    )
    _check_together(policy, s)
    return s


def _check_words(policy: Section) -> None:
    backbone, scheduler = policy.get("vision_backbone"), policy.get("noise_scheduler_type")
    if backbone not in BACKBONES:
        hint = "their blocks are three convolutions, which the runtime does not have" if str(backbone).startswith("resnet") else ""
        policy.bad("vision_backbone", " or ".join(BACKBONES), hint=hint, unsupported=True)
    for key, words in (("noise_scheduler_type", SCHEDULERS), ("prediction_type", PREDICTIONS), ("beta_schedule", BETAS.get(scheduler, BETAS["DDPM"]))):
        if policy.get(key) not in words:
            policy.bad(key, " or ".join(words), unsupported=True)
    for key in ("use_group_norm", "use_separate_rgb_encoder_per_camera", "use_film_scale_modulation", "clip_sample"):
        if not isinstance(policy.get(key), bool):
            policy.bad(key, "true or false")
    if policy.get("use_group_norm") is True and policy.get("pretrained_backbone_weights"):
        policy.bad("pretrained_backbone_weights", "null, as use_group_norm is true", hint="the reference refuses it too")
    if not isinstance(policy.get("normalization_mapping"), dict):
        policy.bad("normalization_mapping", "the modes of VISUAL, STATE and ACTION")
    policy.values.setdefault("normalization_mapping", POLICY["normalization_mapping"])  # readers of the older layout use it


def _check_together(policy: Section, s: Sizes) -> None:
    if s.n_step > s.n_train_step:
        policy.bad("num_inference_steps", "at most num_train_timesteps {}".format(s.n_train_step), hint="the reference refuses it too")
    if s.cameras and not s.group_norm and s.n_cell == 1:
        expected = "images of more than 32 pixels on one side, since use_group_norm is false"
        policy.bad("input_features", expected, "{} x {}".format(*s.image), "the reference refuses it too: its batch norms are built with one image")
    if s.horizon % 2 ** len(s.widths):
        hint = "the reference refuses it too"
        policy.bad("horizon", "a multiple of {}, which down_dims divide it by".format(2 ** len(s.widths)), hint=hint)
    if s.n_moment + s.n_action_steps - 1 > s.horizon:
        expected = "at most {} rows, which follow those of the past in a chunk".format(max(s.horizon - s.n_moment + 1, 0))
        policy.bad("n_action_steps", expected)
    if s.kernel_size % 2 == 0:
        policy.bad("kernel_size", "an odd number", hint="the reference cannot add what even ones leave")
    if s.d_time % 2:
        policy.bad("diffusion_step_embed_dim", "an even number")
    if any(width % s.n_group for width in s.widths):
        policy.bad("n_groups", "a divisor of each of down_dims {}".format(list(s.widths)))
    if s.widths[0] % 8:
        policy.bad("down_dims", "a first width that 8 divides, the groups of the last norm")
    n_view = len(s.cameras) * s.n_moment
    if n_view > MAX_VIEWS:
        expected = "at most {} frames in an observation".format(MAX_VIEWS)
        policy.bad("n_obs_steps", expected, "{} cameras at {} moments".format(len(s.cameras), s.n_moment), unsupported=True)


def _share(policy: Section, key: str) -> float:
    value = policy.get(key)
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value <= 1:
        return float(value)
    policy.bad(key, "a number from 0 to 1")
    return 0.0


def _read_widths(policy: Section) -> Tuple[int, ...]:
    widths = policy.get("down_dims")
    if isinstance(widths, (list, tuple)) and 0 < len(widths) <= MAX_LEVELS and all(type(n) is int and 0 < n <= 16384 for n in widths):
        return tuple(widths)
    policy.bad("down_dims", "1 to {} widths".format(MAX_LEVELS))
    return (8,)


def _pair(policy: Section, key: str) -> Optional[Tuple[int, int]]:
    """(width, height) of a size that the config states as [height, width]; None if it is null."""
    size = policy.get(key)
    if size is None:
        return None
    if isinstance(size, (list, tuple)) and len(size) == 2 and all(type(n) is int and 0 < n <= MAX_SIDE for n in size):
        return size[1], size[0]
    policy.bad(key, "[height, width] of 1 to {} pixels, or null".format(MAX_SIDE))
    return None


def _image_sizes(policy: Section, frame: Tuple[int, int]) -> Tuple[Optional[Tuple[int, int]], Tuple[int, int]]:
    """(width, height) to which frames are resized, if they are, and of the crop after it, computed from the ratio as in the class."""
    resized, crop, ratio = _pair(policy, "resize_shape"), _pair(policy, "crop_shape"), policy.number("crop_ratio")
    if ratio > 1:
        policy.bad("crop_ratio", "a number in (0, 1]")
    if resized is not None:
        if min(resized) < 2:
            policy.bad("resize_shape", "2 pixels or more on each side", unsupported=True)
        crop = (int(resized[0] * ratio), int(resized[1] * ratio)) if ratio < 1 else None
        if crop is not None and min(crop) < 1:
            policy.bad("crop_ratio", "a share of resize_shape with a pixel or more")
    whole = resized or frame
    if crop is not None and (crop[0] > whole[0] or crop[1] > whole[1]):
        policy.bad("crop_shape", "at most the frames' {}".format([whole[1], whole[0]]), hint="the reference refuses it too")
    return resized, crop or whole


def _read_cameras(policy: Section) -> Tuple[Sequence[str], Tuple[int, int]]:
    """Cameras in order, and (width, height) of their frames."""
    features = policy.get("input_features")
    cameras, sizes = cameras_of(policy)
    if not cameras and not (isinstance(features, dict) and ENVIRONMENT in features):
        policy.bad("input_features", "a VISUAL feature or several, or {}".format(ENVIRONMENT), "none", "the reference refuses it too")
    if len(set(sizes)) > 1:
        policy.bad("input_features", "cameras of one size", str(sizes), "the reference refuses others too")
    return cameras, sizes[0]
