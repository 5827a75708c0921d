# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Fields of a checkpoint's JSON files changed one by one: the converter follows the reference, or refuses.

    python tools/config_fields.py [--only FAMILY] [--all]    exit code 1 where a chunk differs from the reference's

Starts from golden cases (`python tools/goldens make`). Each changed checkpoint is converted, and where it is not refused the chunk of `vla run`'s
engine is compared with the reference's. Where the reference fails, anything but a crash is right. TurboVLA's authors keep their config in the
file of weights. The environment is that of tools/camera_sizes.py. --all prints what was done with every change.
"""

import argparse
import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from camera_sizes import CLOSE, wanted
from goldens.build import FOLDER
from goldens.turbovla_authors import WEIGHTS
from tokenizer_fields import changed, changes

CASES = ("act/two_views", "smolvla/two_views", "pi0/two_views", "pi05/two_views", "xvla/two_views", "turbovla/two_views", "turbovla_authors/two_views",
         "vla_jepa/libero", "evo1/two_views", "evo1/lerobot", "diffusion/ddpm", "diffusion/ddim", "diffusion/no_cameras", "openvla/bridge", "openvla/fine_tuned", "openvla_oft/libero", "openvla_oft/diffusion", "vla_adapter/one_view", "vla_adapter/calvin", "pi0_fast/stops", "gr00t_n1_5/modes", "gr00t_n1_6/relative", "gr00t_n1_7/libero",
         "groot/n1_5", "groot/n1_7")
SKIPPED = ("data_config", "tokenizer", "vocab", "model.safetensors.index", "dims", "special_tokens", "added_tokens")


def files_of(checkpoint):
    """{path: content} of the JSON files that say what the policy computes."""
    found = sorted(file for file in checkpoint.rglob("*.json") if not any(word in file.name for word in SKIPPED) and "tokenizer" not in file.parts[-2])
    files = {str(file.relative_to(checkpoint)): json.loads(file.read_text()) for file in found}
    return files | ({WEIGHTS: read_weights(checkpoint)["model_config"]} if (checkpoint / WEIGHTS).exists() else {})


def read_weights(checkpoint):
    import torch

    return torch.load(checkpoint / WEIGHTS, weights_only=True)


def modest(new):
    """Whether no number would make either side allocate without an end."""
    return not (new and isinstance(new[0], int) and not isinstance(new[0], bool) and abs(new[0]) > 1 << 16)


class Case:
    def __init__(self, name, root):
        from goldens import recorder

        self.source, self.folder, self.recorder = FOLDER / name, root / "case", recorder
        shutil.copytree(self.source, self.folder, ignore=shutil.ignore_patterns("bundle.gguf", "*.safetensors", "*.pt"))
        for file in (self.source / "checkpoint").rglob("*"):  # weights are not copied
            here = self.folder / "checkpoint" / file.relative_to(self.source / "checkpoint")
            if file.is_file() and not here.exists():
                here.symlink_to(file)
        self.files = files_of(self.source / "checkpoint")
        self.observation = json.loads((self.folder / "observation.json").read_text())
        self.noise = np.load(self.folder / "noise.npy")

    def put(self, which, content):
        file = self.folder / "checkpoint" / which
        if which != WEIGHTS:
            file.write_text(json.dumps(content))
            self.order_state(content)
            return
        import torch

        file.unlink(missing_ok=True)
        torch.save(read_weights(self.source / "checkpoint") | {"model_config": content}, file)

    def order_state(self, content):
        """The recorder hands a state of several parts over as one vector, in the order of GR00T's modality_keys."""
        with contextlib.suppress(AttributeError, TypeError, KeyError):
            for modes in content["processor_kwargs"]["modality_configs"].values():
                state = {key: self.observation["state"][key] for key in modes["state"]["modality_keys"] if key in self.observation["state"]}
                if len(state) == len(self.observation["state"]):
                    (self.folder / "observation.json").write_text(json.dumps(self.observation | {"state": state}))

    def reference(self):
        """The chunk, or the exception's text."""
        import torch

        try:
            with torch.inference_mode(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                policy, before, after = self.recorder.load(self.folder / "checkpoint")
                batch = before(self.recorder.read_observation(self.folder))
                return after(policy.predict_action_chunk(batch, noise=torch.from_numpy(self.noise)[None].clone())).float().numpy()[0]
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever stops it
            return repr(error)[:160]

    def runtime(self):
        """The chunk, or the refusal."""
        import vla_cpp
        from goldens.cases import backbone_folder, conversion_options
        from PIL import Image
        from vla_cpp.convert import cli

        bundle, checkpoint, said = self.folder / "bundle.gguf", self.folder / "checkpoint", io.StringIO()
        backbone = backbone_folder(checkpoint)
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            code = cli.main([str(checkpoint), *(["--backbone", str(backbone)] if backbone else []), "-o", str(bundle), "--dtype", "f32", "--force",
                             "--quiet", "--vla", "none", *conversion_options(self.folder)])
        if code == 1:
            raise RuntimeError("the converter failed: " + said.getvalue())
        if code:
            return said.getvalue()
        images = {view: file and np.asarray(Image.open(self.folder / file).convert("RGB")) for view, file in self.observation["images"].items()}
        try:
            with vla_cpp.Policy(str(bundle), kernels="float32", threads=1) as engine:
                return np.asarray(engine.act(images=images, state=self.observation["state"], text=self.observation["text"], noise=self.noise))
        except vla_cpp.VlaError as error:
            return str(error)


def judged(found, expected):
    if isinstance(found, str):
        return "refused"
    if isinstance(expected, str):
        return "unreadable to the reference"
    if found.shape != expected.shape:
        return f"WRONG: {found.shape} for {expected.shape}"
    off = np.abs(found - expected).max() / max(1, np.abs(expected).max())
    return "followed" if off <= CLOSE else f"WRONG: {off:.1e}"


def compare(name, tell):
    told, wrong = dict.fromkeys(("followed", "refused", "unreadable to the reference"), 0), []
    with tempfile.TemporaryDirectory() as root:
        case = Case(name, Path(root))
        for which, content in case.files.items():
            for path, new in [((), ()), *changes(content)]:
                if not modest(new):
                    continue
                what = f"{which}: {'.'.join(map(str, path))} " + (f"= {json.dumps(new[0])[:60]}" if new else "missing" if path else "as it is")
                case.put(which, changed(case.files, which, path, new)[which] if path else content)
                found = case.runtime()
                verdict = "refused" if isinstance(found, str) else judged(found, case.reference())
                told[verdict] = told.get(verdict, 0) + 1
                if tell or verdict.startswith("WRONG"):
                    print(f"    {what}: {verdict}" + (f"  {found[:120]!r}" if tell and isinstance(found, str) else ""), flush=True)
                wrong += [what] if verdict.startswith("WRONG") else []
            case.put(which, content)
    told = {key: n for key, n in told.items() if not key.startswith("WRONG")}
    print(f"{name}: {sum(told.values()) + len(wrong)} changes: " + ", ".join(f"{n} {key}" for key, n in told.items()) + f", {len(wrong)} wrong", flush=True)
    return not wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="a family or case, as smolvla or evo1/lerobot")
    parser.add_argument("--all", action="store_true")
    args = parser.parse_args()
    from goldens.recorder import open_reference

    open_reference()
    warnings.filterwarnings("ignore")
    import torch

    torch.set_num_threads(1)
    chosen = [name for name in CASES if name == args.only or wanted(name, args.only)]
    good = [compare(name, args.all) for name in chosen]
    sys.exit(not all(good))


if __name__ == "__main__":
    os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
    os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")  # compile_model takes minutes and changes nothing that is compared
    main()
