# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the reference computes when it goes on from the rows of a previous chunk that are not executed yet.

Beside `expected.gguf`, a case may have `leftover.gguf`: the rows, the delay, and LeRobot's own chunks, `chunk.<schedule>` with the guidance
of its policies/rtc, or for GR00T N1.7 `chunk`, which the head in-paints itself.
"""

import numpy as np

from .draw import Generator
from .recorder import load, read_observation, read_taps, write_taps

SCHEDULES = ("linear", "exp", "ones", "zeros")
N_ROW, DELAY, MAX_GUIDANCE = 4, 2, 5.0


def chunk_of(case, previous, schedule, delay=DELAY, max_guidance=MAX_GUIDANCE):
    """LeRobot's chunk for the case's observation and noise, (horizon, d_action). previous: (row, d_action)."""
    import torch

    torch.set_num_threads(1)
    torch.inference_mode = torch.no_grad  # the guidance asks for gradients
    policy, before, _ = load(case / "checkpoint")
    kind = type(getattr(policy, "policy", policy))  # GR00T's and Evo-1's are wrapped, to be given their noise
    predict, set_up = kind.predict_action_chunk, settings(schedule, len(previous), max_guidance)

    def with_leftover(self, batch, **kwargs):
        if set_up:
            self.config.rtc_config = set_up
            self.init_rtc_processor()
            kwargs["execution_horizon"] = len(previous)
        return predict(self, batch, **kwargs, inference_delay=delay, prev_chunk_left_over=torch.from_numpy(previous)[None])

    kind.predict_action_chunk = with_leftover
    try:
        policy = load(case / "checkpoint")[0]
        noise = torch.from_numpy(np.load(case / "noise.npy"))[None]
        return policy.predict_action_chunk(dict(before(read_observation(case))), noise=noise)[0].float().numpy()
    finally:
        kind.predict_action_chunk = predict


def settings(schedule, n_row, max_guidance):
    from lerobot.configs import RTCAttentionSchedule
    from lerobot.policies.rtc import RTCConfig

    return schedule and RTCConfig(prefix_attention_schedule=RTCAttentionSchedule[schedule.upper()],
                                  max_guidance_weight=max_guidance, execution_horizon=n_row)


def write_leftover(case, seed, out):
    """`leftover.gguf` into the folder `out`; the rows are drawn from the seed."""
    recorded = read_taps(case / "expected.gguf")["chunk"]
    previous = (Generator(seed + 7).normal(N_ROW, recorded.shape[1]) * np.float32(0.5)).astype(np.float32)
    schedules = (None,) if "gr00t" in case.parent.name else SCHEDULES
    chunks = {f"chunk.{schedule}" if schedule else "chunk": chunk_of(case, previous, schedule) for schedule in schedules}
    for name, value in chunks.items():
        print(f"{case.parent.name}/{case.name} {name}: moved by {np.abs(value - recorded).max():.2f}")
    write_taps(out / "leftover.gguf", {"previous": previous, **chunks}, leftover__delay=DELAY, leftover__max_guidance=MAX_GUIDANCE)
