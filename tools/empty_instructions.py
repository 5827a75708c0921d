# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the references answer to an empty instruction: the golden cases again without their text, into tests/golden/empty_instructions.json.

    python tools/empty_instructions.py

The environment is that of tools/camera_sizes.py. BitVLA's reference needs a transformers of its own and is left out. LeRobot's N1.7 reads a sentence of
its own in place of an empty instruction, its authors' code (processing_gr00t_n1d7.py) none: that is recorded.
"""

import json
import os
import warnings
from unittest import mock

from camera_sizes import ROOT, Pair

RECORDED = ROOT / "tests/golden/empty_instructions.json"
CASES = ("act/two_views", "evo1/two_views", "evo1/lerobot", "gr00t_n1_5/libero", "gr00t_n1_6/libero", "gr00t_n1_7/libero", "gr00t_n1_7/clean_text",
         "pi0/two_views", "pi05/two_views", "smolvla/two_views", "turbovla/two_views", "turbovla/no_state", "vla_jepa/libero", "xvla/two_views")


def answer(name):
    """The first and the last row of the chunk."""
    import torch

    pair = Pair(name, runtime=False)
    from lerobot.policies.groot import processor_groot

    name = "prepare_n1_7_language_batch"
    with torch.inference_mode(), mock.patch.object(processor_groot, name, lambda language, batch_size, **_: [language[0] if isinstance(language, list) else language or ""] * batch_size):
        chunk = pair.policy.predict_action_chunk(pair.before(pair.batch | {"task": ""}), noise=pair.noise.clone())
        actions = pair.after(chunk).float().numpy()[0]
    return [[float(f"{x:.8g}") for x in actions[i]] for i in (0, -1)]


def main():
    from goldens.recorder import open_reference

    open_reference()
    warnings.filterwarnings("ignore")
    lines = (f" {json.dumps(name)}: {json.dumps(answer(name))}" for name in CASES)
    RECORDED.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    main()
