# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What `--policy.*` takes when the type is vla_cpp."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig


@PreTrainedConfig.register_subclass("vla_cpp")
@dataclass
class VlaCppConfig(PreTrainedConfig):
    """A bundle and how to run it.

    bundle          path of the .gguf file that vla-convert made
    n_action_steps  rows of a chunk that are executed before the policy looks again, 1 to the bundle's horizon. It decides how
                    a policy behaves, so it has no default
    kernels, threads, engine_device, embodiment   as `vla_cpp.Policy` takes them; engine_device is where vla.cpp computes
                    ("cpu", "vulkan", "cuda"), whereas `device` is where LeRobot keeps its tensors
    strict_state    refuse a state far beyond what the policy has seen instead of answering with a note
    ignore          observations that the bundle does not take and that shall be left out, by name
    rename_map      observations by LeRobot's name and the bundle's. With `--policy.path` LeRobot's own `--rename_map` does the
                    same; with `--policy.type` LeRobot does not hand it to a policy's processors
    rtc_config      real-time chunking, as `lerobot-rollout --inference.type=rtc` sets it
    """

    bundle: str = ""
    n_action_steps: int | None = None
    kernels: str | None = None
    threads: int = 0
    engine_device: str = "cpu"
    embodiment: str | None = None
    strict_state: bool = False
    ignore: list[str] = field(default_factory=list)
    rename_map: dict[str, str] = field(default_factory=dict)
    rtc_config: RTCConfig | None = None

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def validate_features(self) -> None:
        """Names and shapes are compared with the bundle when it is loaded."""

    def get_optimizer_preset(self) -> AdamWConfig:
        raise NotImplementedError("a bundle is for inference: train the checkpoint with LeRobot, then convert it with vla-convert")

    def get_scheduler_preset(self) -> Any:
        return None
