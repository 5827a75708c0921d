# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's policy interface over `vla_cpp.Policy`. Observations come unnormalized and actions leave in the robot's units."""

import logging
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
import vla_cpp
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from .configuration_vla_cpp import VlaCppConfig
from .observation import observations
from .rows import unexecuted_rows

logger = logging.getLogger(__name__)


class VlaCppPolicy(PreTrainedPolicy):
    """A bundle as a LeRobot policy. It has no parameters of torch; the network is in the bundle.

    Errors: those of `vla_cpp.Policy` and `vla_cpp.Policy.act`, which name what was expected and what was found.
    """

    config_class = VlaCppConfig
    name = "vla_cpp"

    def __init__(self, config: VlaCppConfig, **_: Any) -> None:
        super().__init__(config)
        self.engine = _open(config)
        self.spec = vla_cpp.observation.robot_of(self.engine.spec, config.embodiment)
        _check_steps(config.n_action_steps, self.spec.horizon)
        logger.info("%r", self.spec)
        self.reset()

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, *, config: Any = None, **_: Any) -> "VlaCppPolicy":
        """A folder that `vla-lerobot` wrote; its bundle is named relative to it. Hub names are not looked up."""
        folder = Path(pretrained_name_or_path)
        config = config or VlaCppConfig.from_pretrained(folder)
        config.bundle = str(folder / config.bundle)
        return cls(config).eval()

    def reset(self) -> None:
        self._action_queue: deque[Tensor] = deque()
        self._previous: list[vla_cpp.Chunk] = []

    def supports_rtc(self) -> bool:
        return bool(self.spec.real_time_chunking)

    def get_optim_params(self) -> dict:
        return {}

    def forward(self, batch: dict[str, Tensor]) -> Any:
        raise NotImplementedError("a bundle is for inference: train the checkpoint with LeRobot, then convert it with vla-convert")

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], noise: Tensor | None = None, **_: Any) -> Tensor:
        """One action (batch, d_action) in the robot's units; a new chunk when n_action_steps rows were given out."""
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch, noise)
            self._action_queue.extend(chunk.transpose(0, 1)[: self.config.n_action_steps])
        return self._action_queue.popleft()

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        noise: Tensor | None = None,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
    ) -> Tensor:
        """Chunks (batch, horizon, d_action) float32 in the robot's units.

        noise                 (batch, noise_rows, d_noise); None: drawn as LeRobot's policies draw it for a CPU, one draw for the
                              whole batch, so that the same seed of torch gives the same noise
        inference_delay       rows of prev_chunk_left_over that will be executed before this chunk arrives
        prev_chunk_left_over  rows of this policy's previous chunk that are not executed yet, perhaps with rows of zeros after
                              them, as `lerobot-rollout` pads them
        """
        seen = observations(batch, self.spec, self.config)
        noises = self._noises(noise, len(seen))
        previous = self._previous if prev_chunk_left_over is not None else []
        chunks = []
        for i, observation in enumerate(seen):
            leftover = self._leftover(previous, i, inference_delay, prev_chunk_left_over)
            chunks.append(self.engine.act(**observation, **noises[i], leftover=leftover, embodiment=self.config.embodiment))
        self._previous = chunks
        for note in {note for chunk in chunks for note in chunk.notes}:
            logger.warning("%s", note)
        return torch.from_numpy(np.stack([chunk.actions for chunk in chunks])).to(_device_of(batch))

    def _noises(self, given: Tensor | None, n: int) -> list[dict[str, Any]]:
        shape = (n, self.spec.noise_rows, self.spec.d_noise)
        if given is None and self.spec.noise == "normal":
            given = torch.normal(0.0, 1.0, shape)  # policies/common/flow_matching.py, sample_noise
        if given is None and self.spec.noise == "uniform":
            given = torch.rand(shape) * 2 - 1  # policies/evo1/flow_matching.py, get_action
        if given is not None:
            return [{"noise": one} for one in given.float().cpu().numpy()]
        return [{"seed": int(seed)} for seed in torch.randint(0, 2**32, (n,))]

    def _leftover(self, previous: list, i: int, delay: int | None, rows: Tensor | None) -> vla_cpp.Leftover | None:
        if rows is None:
            return None
        rows = rows if rows.ndim == 3 else rows[None]
        if not previous or len(rows) != len(previous):
            raise vla_cpp.UsageError("prev_chunk_left_over", "rows of this policy's previous chunk", "no previous chunk of that batch")
        rtc = self.config.rtc_config
        if rtc is None:
            raise vla_cpp.UsageError("rtc_config", "the configuration of real-time chunking", "None")
        rows = unexecuted_rows(rows[i].float().cpu().numpy(), previous[i])
        guided = self.spec.real_time_chunking == "guided"
        schedule = rtc.prefix_attention_schedule.value.lower()
        return vla_cpp.Leftover(
            rows,
            delay=min(delay or 0, len(rows)),
            schedule=schedule if guided else None,
            max_guidance=rtc.max_guidance_weight if guided else None,
        )


def _open(config: VlaCppConfig) -> vla_cpp.Policy:
    if not config.bundle:
        raise vla_cpp.UsageError("policy.bundle", "the path of a bundle", "none", "--policy.bundle=policy.gguf; vla-convert makes one")
    return vla_cpp.Policy(
        config.bundle,
        threads=config.threads,
        kernels=config.kernels,
        device=config.engine_device,
        embodiment=config.embodiment,
        strict_state=config.strict_state,
    )


def _check_steps(n: int | None, horizon: int) -> None:
    if n is None or not 1 <= n <= horizon:
        hint = f"--policy.n_action_steps={horizon} executes whole chunks; the checkpoint's config.json has what it was evaluated with"
        raise vla_cpp.UsageError("policy.n_action_steps", f"1 to {horizon}", "none" if n is None else str(n), hint)


def _device_of(batch: dict[str, Any]) -> torch.device:
    return next((v.device for k, v in batch.items() if k.startswith("observation") and isinstance(v, Tensor)), torch.device("cpu"))


