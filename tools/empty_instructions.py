# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What the references answer to an empty instruction: the golden cases again without their text, into tests/golden/empty_instructions.json.

    python tools/empty_instructions.py [--only FAMILY]    what is not asked for stays as it is recorded

The environment is that of tools/camera_sizes.py. BitVLA's reference needs a transformers of its own and is left out. LeRobot's N1.7 reads a sentence of
its own in place of an empty instruction, its authors' code (processing_gr00t_n1d7.py) none: that is recorded.
"""

import argparse
import contextlib
import json
import os
import warnings
from unittest import mock

from camera_sizes import ROOT, Pair, wanted

RECORDED = ROOT / "tests/golden/empty_instructions.json"
CASES = ("act/two_views", "diffusion/ddim", "evo1/two_views", "evo1/lerobot", "gr00t_n1_5/libero", "gr00t_n1_6/libero", "gr00t_n1_7/libero", "gr00t_n1_7/clean_text",
         "groot/n1_5", "groot/n1_7", "openvla/bridge", "openvla_oft/film", "pi0/two_views", "pi05/two_views", "pi0_fast/two_views", "smolvla/two_views", "turbovla/two_views",
         "turbovla/no_state", "turbovla_authors/two_views", "vla_adapter/calvin", "vla_jepa/libero",
         "xvla/two_views")


def as_the_authors(name):
    """N1.7 of LeRobot without the sentence of its own."""
    if not name.startswith("gr00t_n1_7/"):
        return contextlib.nullcontext()
    from lerobot.policies.groot import processor_groot

    def batch_of(language, batch_size, **_):
        return [language[0] if isinstance(language, list) else language or ""] * batch_size

    return mock.patch.object(processor_groot, "prepare_n1_7_language_batch", batch_of)


def answer(name):
    """The first and the last row of the chunk."""
    import torch

    pair = Pair(name, runtime=False)
    with torch.inference_mode(), as_the_authors(name):
        chunk = pair.policy.predict_action_chunk(pair.before(pair.batch | {"task": ""}), noise=pair.noise.clone())
        actions = pair.after(chunk).float().numpy()[0]
    return [[float(f"{x:.8g}") for x in actions[i]] for i in (0, -1)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="a family, as smolvla")
    only = parser.parse_args().only
    from goldens.recorder import open_reference

    open_reference()
    warnings.filterwarnings("ignore")
    recorded = json.loads(RECORDED.read_text())
    lines = (f" {json.dumps(name)}: {json.dumps(answer(name) if wanted(name, only) else recorded[name])}" for name in CASES
             if wanted(name, only) or name in recorded)
    RECORDED.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    main()
