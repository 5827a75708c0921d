# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The contracts of tests/convert/contracts.json: each as a checkpoint with small random weights, converted, run and compared.

    python tests/reference/corpus.py build/cpu/bin/vla [NAME ...]      rows whose name has NAME in it; all of them where none is given

Needs what the golden cases are recorded with: torch, lerobot, diffusers, opencv-python-headless.  Prints a line for each row and the share.  Exit
code 1 where a chunk is farther from the reference's than 1e-5 of its largest number, or the converter answers otherwise than the row says.
"""

import contextlib
import importlib.util
import io
import json
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / part) for part in ("python", "tools", "tests/convert", "tests/reference")]

import contracts  # noqa: E402
from goldens.cases import write_observation  # noqa: E402
from goldens.recorder import open_reference, read_observation, run_case  # noqa: E402
from openpi_transforms import Transforms  # noqa: E402

BOUND = 1e-5
# What the reference would fetch, compile or save memory with; no number depends on it.
QUIET = {"pretrained_backbone_weights": None, "compile_model": False, "gradient_checkpointing": False}


def convert(row, folder):
    """(case, exit code, messages); the bundle is folder/bundle.gguf."""
    case, checkpoint = contracts.write(row, folder)
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        code = contracts.convert(row, folder, checkpoint)
    return case, code, " ".join(said.getvalue().split())


def answer(vla, row, folder):
    """The chunk of `vla run`."""
    observation = json.loads((folder / "observation.json").read_text())
    command = [vla, "run", str(folder / "bundle.gguf"), "--kernels", "float32", "--out", str(folder / "out.npy")]
    for view, file in observation["images"].items():
        command += ["--image", f"{view}={folder / file if file else ''}"]
    for name, numbers in contracts.states_of(row, observation["state"]).items():
        command += ["--state", (f"{name}=" if name else "") + ",".join(map(repr, numbers))]
    if row["family"] != "act":
        command += ["--text", observation["text"], "--noise", str(folder / "noise.npy")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    return np.load(folder / "out.npy")


def has_reference(row):
    """LeRobot has GR00T N1.5 in its releases up to 0.5.1 alone."""
    return row["family"] != "groot" or importlib.util.find_spec("lerobot.policies.groot.groot_n1") is not None


def reference(row, folder):
    """The chunk of the reference, in the robot's units."""
    file = folder / "checkpoint/config.json"
    config = json.loads(file.read_text())
    file.write_text(json.dumps({key: QUIET.get(key, value) for key, value in config.items()}))
    if row["family"] == "openpi":
        return openpi(row, folder)
    if row["family"] == "gr00t_n1_7":
        as_the_authors_read(folder / "checkpoint/processor_config.json")
    return run_case(folder)["actions"]


def as_the_authors_read(file):
    """Without image_target_size LeRobot crops by a constant instead of crop_fraction."""
    settings = json.loads(file.read_text())
    kwargs = settings["processor_kwargs"]
    if kwargs["image_target_size"] is None:
        kwargs["image_target_size"] = [kwargs["shortest_image_edge"]] * 2
        file.write_text(json.dumps(settings))


def openpi(row, folder):
    """The network of LeRobot, which is openpi's, between openpi's transforms."""
    import torch
    from goldens import pi
    from transformers import AutoTokenizer

    torch.set_num_threads(1)
    policy, _, _ = pi.load(folder / "checkpoint")
    transforms, raw = Transforms(row, folder / "openpi"), read_observation(folder)
    images, masks = transforms.images(raw)
    state, text = transforms.state(raw["observation.state"].numpy().astype(np.float64)), raw["task"]
    tokens = AutoTokenizer.from_pretrained(str(folder / "checkpoint/tokenizer"))(
        transforms.prompt(text, state), max_length=policy.config.tokenizer_max_length, padding="max_length", truncation=True, padding_side="right",
        return_tensors="pt")
    ids, mask = tokens["input_ids"], tokens["attention_mask"].bool()
    noise = torch.from_numpy(np.load(folder / "noise.npy"))[None]
    add_up_time(policy.model)
    given = [torch.from_numpy(np.pad(state, (0, 32 - state.size)).astype(np.float32))[None]] if policy.config.type == "pi0" else []
    with torch.inference_mode():
        chunk = policy.model.sample_actions([torch.from_numpy(image)[None] for image in images], [torch.tensor([m]) for m in masks], ids, mask, *given,
                                            noise=noise)
    return transforms.actions(chunk[0].double().numpy(), raw["observation.state"].numpy().astype(np.float64)).astype(np.float32)


def add_up_time(model):
    """openpi adds up the time of the steps in float32, LeRobot computes each."""
    import torch

    step, time = model.denoise_step, torch.tensor([1.0])

    def at_openpis_time(**inputs):
        velocity = step(**(inputs | {"timestep": time.clone()}))
        time.add_(torch.tensor(-0.1))
        return velocity

    model.denoise_step = at_openpis_time


def main():
    vla, *names = sys.argv[1:]
    warnings.filterwarnings("ignore")
    open_reference()
    rows = [row for row in contracts.ROWS if not names or any(name in contracts.name_of(row) for name in names)]
    converted, refused, wrong, worst = 0, 0, [], 0.0
    for row in rows:
        name = contracts.name_of(row)
        with tempfile.TemporaryDirectory() as root:
            folder = Path(root) / "case"
            case, code, said = convert(row, folder)
            if code:
                refused += 1
                as_said = row.get("refused", "\0") in said
                print(f"{name:60} refused{'' if as_said else ' UNEXPECTEDLY'}: {said[:160]}", flush=True)
                wrong += [] if as_said else [name]
                continue
            if not has_reference(row):
                converted += 1
                print(f"{name:60} converted; compared with lerobot 0.4.4", flush=True)
                continue
            write_observation(case, folder)
            found, expected = answer(vla, row, folder), reference(row, folder)
            away = np.abs(found - expected).max() / np.abs(expected).max() if found.shape == expected.shape else np.inf
        converted, worst = converted + 1, max(worst, away)
        print(f"{name:60} {found.shape[0]:3} x {found.shape[1]:2} {away:.1e}{'' if away <= BOUND else '  WRONG'}", flush=True)
        wrong += [name] if away > BOUND or "refused" in row else []
    repositories = {row["source"].partition("@")[0] for row in rows}
    print(f"{len(rows)} contracts of {len(repositories)} repositories: {converted} converted ({converted / len(rows):.1%}), {refused} refused; "
          f"the chunk farthest from its reference: {worst:.1e}; wrong: {', '.join(wrong) or 'none'}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
