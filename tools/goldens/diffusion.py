# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Diffusion Policy: golden cases, random checkpoints in LeRobot's layout, and LeRobot's class with diffusers' schedulers as the reference.

The towers are torchvision's own ResNet-18 and -34, which have one width only: frames are small, so that what they give is.
"""

import functools
import random
import zlib
from dataclasses import dataclass, field

import numpy as np

from . import act
from . import lerobot_layout as layout
from .act import camera_statistics, write
from .cases import MODES, Case
from .draw import f32
from .parameters import linear, norm, parameter, statistics
from .recorder import Taps

NAMES = {"diffusion": "lerobot.policies.diffusion.DiffusionPolicy"}
ENVIRONMENT = act.ENVIRONMENT
COUNTER = "num_batches_tracked"  # of a batch norm
SEQUENTIAL = {"conv1": "0", "bn1": "1", "layer1": "4", "layer2": "5", "layer3": "6", "layer4": "7"}  # places of torchvision's modules
# The defaults of LeRobot's class, but for the weights of ImageNet.
CONFIG = {
    "n_obs_steps": 2, "horizon": 64, "n_action_steps": 32, "drop_n_last_frames": 7,
    "normalization_mapping": {"VISUAL": "MEAN_STD", "STATE": "MIN_MAX", "ACTION": "MIN_MAX"}, "vision_backbone": "resnet18", "resize_shape": None,
    "crop_ratio": 1.0, "crop_shape": None, "crop_is_random": True, "pretrained_backbone_weights": None, "use_group_norm": False,
    "spatial_softmax_num_keypoints": 32, "use_separate_rgb_encoder_per_camera": True, "down_dims": [512, 1024, 2048], "kernel_size": 5, "n_groups": 8,
    "diffusion_step_embed_dim": 128, "use_film_scale_modulation": True, "gradient_checkpointing": False, "noise_scheduler_type": "DDPM",
    "num_train_timesteps": 100, "beta_schedule": "squaredcos_cap_v2", "beta_start": 0.0001, "beta_end": 0.02, "prediction_type": "epsilon",
    "clip_sample": True, "clip_sample_range": 1.0, "num_inference_steps": None, "do_mask_loss_for_padding": False, "optimizer_lr": 1e-4,
    "scheduler_name": "cosine", "scheduler_warmup_steps": 500}


@dataclass(frozen=True)
class Checkpoint:
    """What differs from DiffusionConfig's defaults, features.  dtype: of all but norms; exact: as of act."""

    policy: dict
    cameras: dict  # camera -> (height, width)
    d_state: int = 4
    d_action: int = 3
    d_environment: int = 0
    exact: bool = True
    dtype: str = "F32"
    old: bool = False  # statistics inside the weights
    zero_spread: tuple = field(default=())

    @property
    def config(self):
        inputs, outputs = layout.features(self.cameras, self.d_state, self.d_action)
        if self.d_environment:
            inputs[ENVIRONMENT] = layout.feature("ENV", self.d_environment)
        return {"type": "diffusion"} | layout.COMMON | {"input_features": inputs, "output_features": outputs} | CONFIG | self.policy

    @property
    def moments(self):
        """What follows the name of a feature at each moment, the oldest first."""
        return [f"@-{k}" for k in range(self.config["n_obs_steps"] - 1, 0, -1)] + [""]

    @property
    def states(self):
        """Width by feature and moment."""
        widths = {"observation.state": self.d_state} | ({ENVIRONMENT: self.d_environment} if self.d_environment else {})
        return {name + moment: n for name, n in widths.items() for moment in self.moments}

    @property
    def n_step(self):
        return self.config["num_inference_steps"] or self.config["num_train_timesteps"]

    @property
    def noise_shape(self):
        """The start's rows, then those of each step that draws."""
        c = self.config
        return c["horizon"] * (self.n_step if c["noise_scheduler_type"] == "DDPM" else 1), self.d_action

    @property
    def image(self):
        """Height and width of what the network sees."""
        c = self.config
        if c["resize_shape"]:
            return [int(n * c["crop_ratio"]) for n in c["resize_shape"]] if c["crop_ratio"] < 1 else c["resize_shape"]
        return c["crop_shape"] or next(iter(self.cameras.values()))

    def shapes(self):
        c, k = self.config, self.config["spatial_softmax_num_keypoints"]
        cells = int(np.prod([(n + 31) // 32 for n in self.image])) if self.cameras else 0
        separate = c["use_separate_rgb_encoder_per_camera"]
        out = {}
        for at in ([f"{i}." for i in range(len(self.cameras))] if separate else [""]) if self.cameras else []:
            at = f"diffusion.rgb_encoder.{at}"
            for name, shape in act.resnet("", act.BACKBONES[c["vision_backbone"]]).items():
                first, _, rest = name.partition(".")
                if not (c["use_group_norm"] and "running" in name):
                    out[f"{at}backbone.{SEQUENTIAL[first]}.{rest}"] = shape
                if name.endswith("running_var") and not c["use_group_norm"]:
                    out[f"{at}backbone.{SEQUENTIAL[first]}.{rest.removesuffix('running_var')}{COUNTER}"] = ()
            out |= {f"{at}pool.nets.weight": (k, 512, 1, 1), f"{at}pool.nets.bias": (k,), f"{at}pool.pos_grid": (cells, 2)} | linear(f"{at}out", 2 * k, 2 * k)
        return out | self.unet()

    def unet(self):
        c, at = self.config, "diffusion.unet."
        d_time, widths, size = c["diffusion_step_embed_dim"], [self.d_action, *c["down_dims"]], c["kernel_size"]
        n = len(widths) - 1
        observation = self.d_state + self.d_environment + 2 * c["spatial_softmax_num_keypoints"] * len(self.cameras)
        condition = d_time + c["n_obs_steps"] * observation
        out = linear(f"{at}diffusion_step_encoder.1", 4 * d_time, d_time) | linear(f"{at}diffusion_step_encoder.3", d_time, 4 * d_time)

        def convolution(name, d_out, d_in, k):
            return {f"{at}{name}.weight": (d_out, d_in, k), f"{at}{name}.bias": (d_out,)}

        def block(name, d_in, d_out):
            for i, d in ((1, d_in), (2, d_out)):
                out.update(convolution(f"{name}.conv{i}.block.0", d_out, d, size) | norm(f"{at}{name}.conv{i}.block.1", d_out))
            out.update(linear(f"{at}{name}.cond_encoder.1", (2 if c["use_film_scale_modulation"] else 1) * d_out, condition))
            if d_in != d_out:
                out.update(convolution(f"{name}.residual_conv", d_out, d_in, 1))

        for i in range(n):
            block(f"down_modules.{i}.0", widths[i], widths[i + 1]), block(f"down_modules.{i}.1", widths[i + 1], widths[i + 1])
            if i < n - 1:
                out |= convolution(f"down_modules.{i}.2", widths[i + 1], widths[i + 1], 3)
        for i in range(2):
            block(f"mid_modules.{i}", widths[n], widths[n])
        for i in range(n - 1):
            d = widths[n - 1 - i]
            block(f"up_modules.{i}.0", 2 * widths[n - i], d), block(f"up_modules.{i}.1", d, d)
            out |= convolution(f"up_modules.{i}.2", d, d, 4)
        out |= convolution("final_conv.0.block.0", widths[1], widths[1], size) | norm(f"{at}final_conv.0.block.1", widths[1])
        return out | convolution("final_conv.1", self.d_action, widths[1], 1)

    def value(self, name, shape, seed):
        if name.endswith(COUNTER):
            return np.int64(seed)
        if name.endswith("pos_grid"):
            rows, columns = ((n + 31) // 32 for n in self.image)
            x, y = np.meshgrid(np.linspace(-1.0, 1.0, columns), np.linspace(-1.0, 1.0, rows))
            return np.stack((x.ravel(), y.ravel()), 1).astype(f32)
        if len(shape) == 4 and "backbone" in name:
            return act.filters(name, shape, seed)
        if "backbone" in name and not name.endswith(("bias", "mean")):
            return act.Checkpoint.norm_factor(self, name, shape, seed)
        if ".block.1." in name:  # norms of groups: as parameters of norms are drawn
            return parameter(name.replace(".block.1.", ".norm."), shape, seed)
        if len(shape) == 3:  # as a matrix over the window
            return parameter(name, (shape[0], shape[1] * shape[2]), seed).reshape(shape)
        return parameter(name, shape, seed) * f32(2 if "pool.nets.weight" in name else 1)  # keypoints that differ

    def statistics(self, seed):
        out = statistics(self.d_state, self.d_action, seed, self.zero_spread)
        for camera in self.cameras:
            out[f"observation.images.{camera}"] = camera_statistics(zlib.crc32(camera.encode()) + seed)
        if self.d_environment:
            out[ENVIRONMENT] = statistics(self.d_environment, 1, seed + 5)["observation.state"]
        return out

    def old_parts(self, feature):
        """Statistics of a feature that the older layout keeps among the weights."""
        mode = self.config["normalization_mapping"]["ACTION" if feature == "action" else "STATE" if feature == "observation.state" else "VISUAL"]
        return ("mean", "std") if mode == "MEAN_STD" else ("min", "max")

    def write(self, seed, folder):
        dtypes = {name: self.dtype if len(shape) > 1 and "pos_grid" not in name else "F32" if shape else "I64" for name, shape in self.shapes().items()}
        return write(self, dtypes, seed, folder)


FRAMES = {"image@-1": (96, 96, "png"), "image": (96, 96, "png")}  # of the published size
INSTRUCTION = ""


def published(views, arch="diffusion"):
    """The published size for PushT: 263 M parameters."""
    return Checkpoint({"horizon": 16, "n_action_steps": 8, "crop_shape": [84, 84], "use_group_norm": True, "use_separate_rgb_encoder_per_camera": False},
                      {"image": (96, 96)}, d_state=2, d_action=2)


# --- cases -----------------------------------------------------------------------------------------------------------


def case(seed, suffixes, checkpoint):
    """The observation of a policy that reads no instruction: a frame of each camera at each moment.  suffixes: by camera."""
    frames = {camera + moment: (*size, suffixes[i % len(suffixes)]) for i, (camera, size) in enumerate(checkpoint.cameras.items())
              for moment in checkpoint.moments}
    return Case(seed, frames, "", checkpoint)


def sizes(horizon, n_action, widths, d_time, groups, keypoints, **more):
    return {"horizon": horizon, "n_action_steps": n_action, "down_dims": list(widths), "diffusion_step_embed_dim": d_time, "n_groups": groups,
            "spatial_softmax_num_keypoints": keypoints, **more}


CASES = {
    # As published: groups, a crop, one camera at two moments, all steps of DDPM.
    "diffusion/ddpm": case(75, ("png",), Checkpoint(
        sizes(16, 8, (24, 32, 48), 12, 8, 5, use_group_norm=True, crop_shape=[41, 68], use_separate_rgb_encoder_per_camera=False,
              num_train_timesteps=12), {"image": (48, 75)}, d_state=2, d_action=2)),
    # DDIM in fewer steps than were trained; two cameras with an encoder each, batch norms, a resize; shifts alone; three moments.
    "diffusion/ddim": case(62, ("png", "jpg"), Checkpoint(
        sizes(8, 5, (16, 40), 8, 4, 3, kernel_size=3, use_film_scale_modulation=False, noise_scheduler_type="DDIM", num_train_timesteps=50,
              num_inference_steps=7, n_obs_steps=3, resize_shape=[40, 64], crop_ratio=0.9, beta_schedule="linear", clip_sample_range=2.0),
        {"front": (52, 70), "wrist": (52, 70)}, d_state=5, d_action=4)),
    # A state of the environment; the network predicts the sample; one moment, one level; two cameras with one encoder; nothing is clipped.
    "diffusion/environment": case(63, ("png",), Checkpoint(
        sizes(4, 4, (16,), 10, 8, 4, n_obs_steps=1, use_group_norm=True, use_separate_rgb_encoder_per_camera=False, prediction_type="sample",
              clip_sample=False, num_train_timesteps=20, num_inference_steps=6, beta_schedule="scaled_linear",
              normalization_mapping={"VISUAL": "MIN_MAX", "STATE": "MEAN_STD", "ENV": "MIN_MAX", "ACTION": "MEAN_STD"}),
        {"left": (33, 40), "right": (33, 40)}, d_state=3, d_action=3, d_environment=7, dtype="BF16")),
    # No cameras: the robot's state and the environment's at two moments; DDPM of a network that predicts the sample.
    "diffusion/no_cameras": case(65, ("png",), Checkpoint(
        sizes(8, 6, (16, 24, 32), 12, 4, 3, prediction_type="sample", num_train_timesteps=9, beta_schedule="sigmoid", kernel_size=3,
              normalization_mapping={"VISUAL": "MEAN_STD", "STATE": "MIN_MAX", "ENV": "MEAN_STD", "ACTION": "MIN_MAX"}),
        {}, d_state=2, d_action=2, d_environment=16)),
}

# --- random configurations -------------------------------------------------------------------------------------------


def draw(seed):
    """A case from the seed: scheduler, moments, cameras or none, norms, sizes of the U-Net; in one of ten a config that the reference
    refuses or cannot run."""
    r = random.Random(f"diffusion {seed}")
    levels, groups = r.randint(1, 4), r.choice((1, 2, 4, 8))
    widths = [8 * r.randint(1, 4) if i == 0 or groups == 8 else groups * r.randint(1, 10) for i in range(levels)]
    horizon = max(4, 2**levels * r.randint(1, 3))  # a norm of two values is their order
    moments = min(r.choice((1, 2, 2, 3, 4)), horizon)
    height, width = r.randint(20, 80), r.randint(20, 80)
    cameras, n_environment = {f"cam{i}": (height, width) for i in range(r.choice((0, 1, 1, 2, 3)))}, r.choice((0, 0, 1, 9))
    n_environment = n_environment or (0 if cameras else 5)
    n_train = r.choice((5, 20, 50, 100))
    scheduler = r.choice(("DDPM", "DDPM", "DDIM"))
    sized = {}
    if cameras and r.random() < 0.4:
        sized = {"resize_shape": [r.randint(20, 70), r.randint(20, 70)], "crop_ratio": r.choice((1.0, 0.9, 0.76, 0.5))}
    elif r.random() < 0.5:
        sized = {"crop_shape": [r.randint(12, height), r.randint(12, width)]}
    old = bool(cameras) and not n_environment and r.random() < 0.2
    states = ("MEAN_STD", "MIN_MAX") if old else MODES
    modes = {"VISUAL": r.choice(("MEAN_STD",) if old else ("MEAN_STD", "MEAN_STD", "MIN_MAX", "QUANTILES", "IDENTITY")),
             "STATE": r.choice(states), "ACTION": r.choice(states)}
    if n_environment:
        modes["ENV"] = r.choice(MODES)
    policy = sizes(
        horizon, r.randint(1, horizon - moments + 1), widths, 2 * r.randint(2, 9), groups, r.randint(1, 9), n_obs_steps=moments,
        kernel_size=r.choice((1, 3, 5, 5, 7)), use_film_scale_modulation=r.random() < 0.6, use_group_norm=r.random() < 0.5,
        use_separate_rgb_encoder_per_camera=r.random() < 0.5, vision_backbone=r.choice(("resnet18", "resnet18", "resnet34")),
        noise_scheduler_type=scheduler, num_train_timesteps=n_train, num_inference_steps=r.choice((None, r.randint(1, n_train))),
        beta_schedule=r.choice(("squaredcos_cap_v2", "squaredcos_cap_v2", "linear", "scaled_linear", "sigmoid")),
        beta_start=r.choice((0.0001, 0.001)), beta_end=r.choice((0.02, 0.05)), prediction_type=r.choice(("epsilon", "epsilon", "sample")),
        clip_sample=r.random() < 0.7, clip_sample_range=r.choice((1.0, 0.5, 3.0)), normalization_mapping=modes, **sized)
    checkpoint = Checkpoint(policy, cameras, r.randint(1, 12), r.randint(1, 12), n_environment, exact=False,
                            dtype=r.choice(("F32", "F32", "BF16")), old=old)
    return case(seed, (r.choice(("png", "png", "jpg")),), checkpoint)


DRAWN = {"diffusion": draw}


# --- the reference ---------------------------------------------------------------------------------------------------


def opened(checkpoint):
    """(policy, preprocessor, postprocessor) as LeRobot gives them."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    folder = str(checkpoint)
    config = PreTrainedConfig.from_pretrained(folder)
    policy = DiffusionPolicy.from_pretrained(folder, config=config, strict=not act.is_old(checkpoint)).float().eval()
    return policy, *(act.migrated(policy, checkpoint) if act.is_old(checkpoint) else make_pre_post_processors(config, pretrained_path=folder))


def load(checkpoint, dtype="float32"):
    """(policy, preprocessor of a case, postprocessor); published: products in bfloat16 as torch.autocast makes them."""
    import torch

    policy, before, after = opened(checkpoint)
    if dtype == "published":
        policy.predict_action_chunk = torch.autocast("cpu", torch.bfloat16)(policy.predict_action_chunk)
    policy.predict_action_chunk = functools.partial(chunk_of, policy, policy.predict_action_chunk)
    return policy, lambda batch: Moments(policy.config, before).of(batch), after


def chunk_of(policy, predict, batch, noise):
    """What the policy gives of moments, one after the other. noise (1, rows, d_action): the start's, then the scheduler's draws."""
    from diffusers.schedulers import scheduling_ddpm

    rows = policy.config.horizon
    draws = iter(noise[0].reshape(-1, rows, noise.shape[-1])[1:])
    scheduling_ddpm.randn_tensor, draw = lambda shape, **_: next(draws).reshape(shape), scheduling_ddpm.randn_tensor
    policy.reset()
    try:
        return predict(last_of(policy, batch["moments"]), noise=noise[:, :rows])
    finally:
        scheduling_ddpm.randn_tensor = draw


def last_of(policy, moments):
    """Fills the queues as select_action does, which also stacks cameras. Returns the last moment."""
    import torch
    from lerobot.policies.utils import populate_queues

    for moment in moments:
        last = {name: x for name, x in moment.items() if name != "action"}
        if policy.config.image_features:
            last["observation.images"] = torch.stack([moment[key] for key in policy.config.image_features], dim=-4)
        policy._queues = populate_queues(policy._queues, last)
    return last


class Moments:
    """A case's observation, moment by moment as a robot gives it: the reference keeps the last of them in queues."""

    def __init__(self, config, before):
        self.config, self.before, self.n = config, before, config.n_obs_steps

    def of(self, batch):
        state, n_robot = batch["observation.state"], self.config.robot_state_feature.shape[0]
        n_environment = self.config.env_state_feature.shape[0] if self.config.env_state_feature else 0
        robot, environment = state[: self.n * n_robot].reshape(self.n, n_robot), state[self.n * n_robot :].reshape(self.n, n_environment)
        seen = []
        for i in range(self.n):
            suffix = f"@-{self.n - 1 - i}" if i < self.n - 1 else ""
            moment = {name: batch[name + suffix] for name in self.config.image_features} | {"task": batch["task"], "observation.state": robot[i]}
            seen.append(self.before(moment | ({ENVIRONMENT: environment[i]} if n_environment else {})))
        return {"moments": seen}


class Recorder(Taps):
    """Listens to one run of `select_action`, whose queues hold the moments before, with the scheduler's draws given."""

    def __init__(self, policy):
        model = policy.diffusion
        super().__init__(model.num_inference_steps)
        self.policy, self.pixels, separate = policy, [], policy.config.use_separate_rgb_encoder_per_camera
        encoders = getattr(model, "rgb_encoder", [])
        for i, encoder in enumerate(encoders if separate or encoders == [] else [encoders]):
            at = f"vision.{i}." if separate else "vision."
            self.before(encoder.backbone, self.pixels.append)
            blocks = [block for stage in range(4, 8) for block in encoder.backbone[stage]]
            for j, block in enumerate(blocks):
                if j in (0, len(blocks) - 1):
                    self.after(block, lambda x, name=f"{at}blk.{j}": self.put(name, x.permute(0, 2, 3, 1)))
            self.after(encoder.pool, lambda x, name=f"{at}keypoints": self.put(name, x.flatten(1)))
            self.after(encoder.out, lambda x, name=f"{at}out": self.put(name, x))
        unet = model.unet
        unet.register_forward_pre_hook(self.on_step, with_kwargs=True)
        blocks = [*(block for level in unet.down_modules for block in level[:2]), *unet.mid_modules, *(block for level in unet.up_modules for block in level[:2])]
        for i, block in enumerate(blocks):
            self.after(block, lambda x, name=f"unet.blk.{i}": self.at_step(name, x.transpose(1, 2)))
        self.after(unet.final_conv, lambda x: self.at_step("unet.action_out", x.transpose(1, 2)))

    def on_step(self, module, args, kwargs):
        self.step += 1
        if self.step == 0:
            self.put("prefix", kwargs["global_cond"][0])
        elif self.is_told(self.step - 1):
            self.put(f"step.{self.step - 1}.x", args[0][0])

    def is_told(self, step):
        """Whether x may be judged: a predicted sample is divided by the root of a product of alphas, which the first steps of a schedule have
        near 0, so that the rounding of the network's output stays in x until a tenth of it is the sample's."""
        scheduler = self.policy.diffusion.noise_scheduler
        return scheduler.config.prediction_type == "sample" or scheduler.alphas_cumprod[scheduler.timesteps[step]] > 0.1

    def run(self, batch, noise):
        """Every tap of one inference."""
        import torch

        model, moments, cameras = self.policy.diffusion, batch["moments"], len(self.policy.config.image_features)
        sample = model.conditional_sample

        def whole(*args, **kwargs):
            x = sample(*args, **kwargs)
            self.put(f"step.{self.step}.x", x[0])
            return x

        model.conditional_sample = whole
        with torch.inference_mode():
            self.put("chunk", self.policy.predict_action_chunk(batch, noise=noise)[0])
        if self.pixels:
            self.put("pixels", torch.cat(self.pixels))
        if len(self.pixels) == 1:  # of one encoder: ordered by moment, then by camera; the runtime's the other way round
            for name in [name for name in self.taps if name.startswith(("vision.", "pixels"))]:
                x = self.taps[name]
                self.taps[name] = np.swapaxes(x.reshape(len(moments), cameras, *x.shape[1:]), 0, 1).reshape(x.shape).copy()
        parts = [moment[name][0] for name in ("observation.state", ENVIRONMENT) if name in moments[0] for moment in moments]
        self.put("state", torch.cat(parts))
        return self.taps
