# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random robots of GR00T: states, actions and images by the authors' processor and by the runtime.

    python tools/parity_processor.py ARCH FIRST LAST --isaac DIR [--observations 20] [--vla build/cpu/bin/vla]

A seed draws a robot: its keys, how each is normalized, statistics (some of numbers that never or hardly moved, some with a row for each
action), relative joints and poses, a camera of odd size.  Its checkpoint has a tiny random network; what the network answers is decoded by
both sides.  States lie far beyond their ranges.  DIR holds the authors' code (Isaac-GR00T, of the release's time): numbers come from its
StateActionProcessor, for N1.5 from its Normalizer and its RotationTransform, which wants pytorch3d (0.7.6) on the path; images from
LeRobot's copy of the transform, for N1.5 from torchvision.

Ends with exit code 1 if a pixel differs, or a number by more than one unit in the last place; a number of a composed pose by more than one
of the largest number of its position or rotation; a matrix of a converted rotation by more than 2e-6, since torch's sines of angles of
several turns are that rough.
"""
import argparse
import ast
import contextlib
import json
import random
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from goldens import cases, gr00t, gr00t_n1_5, gr00t_n1_6, gr00t_n1_7, recorder
from goldens.gr00t import Robot, head
from parity_full import ROOT

SIDE = 16
N1_5_MODES = ("min_max", "q99", "mean_std", "binary", None)
EULER = tuple("euler_angles_" + order for order in ("rpy", "ryp", "pry", "pyr", "yrp", "ypr"))
ROTATIONS = {("state", 3): ("rotation_6d", ("axis_angle", *EULER)), ("state", 4): ("rotation_6d", ("quaternion",)), ("action", 3): ("axis_angle", EULER)}
BOUNDS = {"rotation_6d": 6 * [1.0], "axis_angle": 3 * [np.pi]}  # by which the authors normalize a rotation that they convert


# --- a random robot --------------------------------------------------------------------------------------------------


def draw_robot(r, arch):
    """Keys of random widths; with N1.6 and N1.7 some of the actions relative to a state of the same width."""
    states = {f"s{i}": r.choice((1, 2, 3, 3, 4, 9) if arch == "gr00t_n1_5" else (1, 1, 2, 3, 9, 9)) for i in range(r.randint(1, 5))}
    actions = {f"a{i}": r.choice((1, 2, 3)) for i in range(r.randint(0, 3))}
    relative, poses, rows = {}, {}, r.randint(2, 5)
    if arch != "gr00t_n1_5":
        for key, width in states.items():
            if r.random() < 0.6:
                name = key if r.random() < 0.5 else f"to_{key}"
                actions[name], relative[name] = width, None if name == key else key
                if width == 9 and r.random() < 0.8:
                    poses[name] = "XYZ_ROT6D"  # the authors' code of N1.6 composes no others
    if not actions:
        actions["a"] = 2
    keys = sorted({*states, *actions})
    mean_std = tuple(key for key in keys if key not in poses and r.random() < 0.3)
    sin_cos = tuple(key for key in states if arch != "gr00t_n1_5" and r.random() < 0.25)
    actions = dict(r.sample(sorted(actions.items()), len(actions)))
    return Robot(("camera",), states, actions, rows, relative, poses=poses, mean_std=mean_std, sin_cos=sin_cos, per_step=r.random() < 0.5)


def draw(arch, seed):
    """A case with the smallest network that the family allows around a random robot."""
    r = random.Random(f"{arch} {seed}")
    robot = draw_robot(r, arch)
    d_state, d_action = 2 * sum(robot.states.values()) + 1, sum(robot.actions.values()) + r.randint(0, 2)
    vl = None if arch == "gr00t_n1_6" else (1, 3, 8)
    sizes = head(4 if arch == "gr00t_n1_7" else 3, (4, 2, 10), vl, 14, d_state, d_action, robot.rows + 1, num_inference_timesteps=1)
    frame, crop = (r.randint(12, 60), r.randint(12, 60), "png"), r.choice((0.8, 0.9, 0.95))
    options = {"letterbox": True}
    if arch == "gr00t_n1_7":
        parts = gr00t_n1_7.vision(16, 3, 2, 24, 5, (0, 1, 2)), gr00t_n1_7.text(24, 5, 3, 1, 8, 32, (2, 1, 1))
        image = {"image_target_size": [SIDE] * 2, "shortest_image_edge": SIDE, "crop_fraction": crop}
        checkpoint = gr00t_n1_7.Checkpoint("robot", 1, robot, *parts, sizes, image, SIDE, percentiles=r.random() < 0.5)
    elif arch == "gr00t_n1_6":
        parts = gr00t_n1_6.vision(16, 2, 2, 24, 3), gr00t_n1_6.text(24, 4, 3, 1, 8, 32)
        image = {"shortest_image_edge": r.choice((16, 20, 30)), "crop_fraction": crop}
        checkpoint = gr00t_n1_6.Checkpoint("robot", 1, robot, *parts, sizes, image, percentiles=r.random() < 0.5)
    else:
        parts = gr00t_n1_5.vision(16, 2, 2, 24, 28), gr00t_n1_5.text(24, 4, 3, 1, 8, 32)
        modes = [{key: r.choice((*N1_5_MODES, *more)) for key in keys} for keys, more in ((robot.states, ("sin_cos",)), (robot.actions, ()))]
        checkpoint = gr00t_n1_5.Checkpoint("robot", 1, robot, *parts, sizes, gr00t_n1_5.camera(frame[1], frame[0], *modes, crop=crop))
        options = {"variant": "data_config.json"}
    return gr00t.case(seed, {"camera": frame}, "go on", checkpoint, options=options)


def disturb(checkpoint, arch, r):
    """Some numbers never moved, some hardly did, and the file has the digits of doubles."""
    file = checkpoint / ("experiment_cfg/metadata.json" if arch == "gr00t_n1_5" else "statistics.json")
    stated = json.loads(file.read_text())
    robot = stated["robot"].get("statistics", stated["robot"])
    for part in ("state", "action"):
        for table in robot[part].values():
            for name, numbers in table.items():
                table[name] = [x * (1 + 1e-9 * r.randint(-50, 50)) for x in numbers]
            for i in range(len(table["min"])):
                kind = r.random()
                for low, high in (("min", "max"), ("q01", "q99")):
                    if kind < 0.2:
                        table[high][i] = table[low][i] + (0 if kind < 0.1 else 3e-6 * abs(table[low][i]))
                if kind < 0.1:
                    table["std"][i] = 0.0
    if arch == "gr00t_n1_5":
        turn(checkpoint, stated["robot"], r)
    file.write_text(json.dumps(stated))
    if arch != "gr00t_n1_5":
        file = checkpoint / "processor_config.json"
        config = json.loads(file.read_text())
        config["processor_kwargs"]["clip_outliers"] = r.random() < 0.7
        file.write_text(json.dumps(config))


def turn(checkpoint, robot, r):
    """Some keys of N1.5 are rotations that the network has in another representation."""
    file = checkpoint / "data_config.json"
    data = json.loads(file.read_text()) | {"rotations": {}}
    if r.random() < 0.3:
        return
    data["state"] = {key: None if mode == "sin_cos" else mode for key, mode in data["state"].items()}  # which does not go beside rotations
    for part in ("state", "action"):
        for key in data[part]:
            target, sources = ROTATIONS.get((part, len(robot["statistics"][part][key]["min"])), (None, None))
            if target and r.random() < 0.8:
                data["rotations"][f"{part}.{key}"], data[part][key] = target, r.choice((None, "min_max"))
                robot["modalities"][part][key] = {"rotation_type": r.choice(sources), "absolute": True, "continuous": True}
    file.write_text(json.dumps(data))


# --- the authors' processors -----------------------------------------------------------------------------------------


class Isaac:
    """StateActionProcessor of N1.6 and N1.7, on one robot of a checkpoint."""

    turned = {"state": {}, "action": {}}  # what rotations are converted

    def __init__(self, code, checkpoint):
        sys.path.insert(0, str(code))
        from gr00t.configs.data.embodiment_configs import ModalityConfig
        from gr00t.data.state_action.state_action_processor import StateActionProcessor
        from gr00t.data.types import ActionConfig, ActionFormat, ActionRepresentation, ActionType

        settings = json.loads((checkpoint / "processor_config.json").read_text())["processor_kwargs"]
        statistics = json.loads((checkpoint / "statistics.json").read_text())
        self.robot = settings["modality_configs"]["robot"]
        configs = {name: ModalityConfig(**part | {"action_configs": part["action_configs"] and [
            ActionConfig(ActionRepresentation[c["rep"]], ActionType[c["type"]], ActionFormat[c["format"]], c["state_key"])
            for c in part["action_configs"]]}) for name, part in self.robot.items()}
        flags = ("use_percentiles", "clip_outliers", "apply_sincos_state_encoding", "use_relative_action")
        self.processor = StateActionProcessor({"robot": configs}, {"robot": statistics["robot"]}, **{k: settings[k] for k in flags})
        self.widths = {part: {k: len(statistics["robot"][part][k]["min"]) for k in self.robot[part]["modality_keys"]} for part in ("state", "action")}

    def state(self, state):
        return np.concatenate(list(self.processor.apply_state({k: x[None] for k, x in state.items()}, "robot").values()), -1)[0]

    def actions(self, chunk, state):
        ends = np.cumsum(list(self.widths["action"].values()))
        parts = dict(zip(self.widths["action"], np.split(chunk, ends, axis=1)))
        out = self.processor.unapply_action({k: x[None] for k, x in parts.items()}, "robot", {k: x[None, None] for k, x in state.items()})
        return np.concatenate([out[k] for k in self.widths["action"]], -1)[0]


class IsaacN15:
    """Normalizer and RotationTransform of N1.5, key by key, in torch's float32."""

    def __init__(self, code, checkpoint):
        import functools
        import torch
        from pytorch3d import transforms

        source = ast.parse((code / "gr00t/data/transform/state_action.py").read_text())
        only = [node for node in source.body if isinstance(node, ast.ClassDef) and node.name in ("Normalizer", "RotationTransform")]
        names = {"torch": torch, "pt": transforms, "functools": functools}
        exec(compile(ast.Module(only, []), "state_action.py", "exec"), names)
        robot = json.loads((checkpoint / "experiment_cfg/metadata.json").read_text())["robot"]
        statistics = robot["statistics"]
        self.modes = json.loads((checkpoint / "data_config.json").read_text())
        self.widths = {part: {k: len(statistics[part][k]["min"]) for k in self.modes[part]} for part in ("state", "action")}
        self.torch, self.by_key = torch, {(part, k): names["Normalizer"](mode, dict(statistics[part][k]))
                                          for part in ("state", "action") for k, mode in self.modes[part].items() if mode not in (None, "sin_cos")}
        self.turned = {"state": {}, "action": {}}
        for name, target in self.modes.get("rotations", {}).items():
            part, key = name.split(".")
            self.turned[part][key] = names["RotationTransform"](robot["modalities"][part][key]["rotation_type"], target)
            if (part, key) in self.by_key:
                bounds = {"min": [-x for x in BOUNDS[target]], "max": list(BOUNDS[target])}
                self.by_key[part, key] = names["Normalizer"]("min_max", bounds)

    def state(self, state):
        out = []
        for key, x in state.items():
            x = self.torch.from_numpy(x)
            if self.modes["state"][key] == "sin_cos":
                x = self.torch.cat([x.sin(), x.cos()])
            if key in self.turned["state"]:
                x = self.turned["state"][key].forward(x[None])[0]
            out.append(self.by_key["state", key].forward(x) if ("state", key) in self.by_key else x)
        return self.torch.cat(out).numpy()

    def actions(self, chunk, _):
        parts = np.split(chunk, np.cumsum(list(self.widths["action"].values())), axis=1)
        out = []
        for key, x in zip(self.widths["action"], map(self.torch.from_numpy, parts)):
            x = self.by_key["action", key].inverse(x) if ("action", key) in self.by_key else x
            out.append(self.turned["action"][key].inverse(x) if key in self.turned["action"] else x)
        return self.torch.cat(out, -1).numpy()


def reference_pixels(arch, folder, frame):
    """(3, height, width) as the network sees them."""
    import torch
    from PIL import Image

    checkpoint = folder / "checkpoint"
    if arch == "gr00t_n1_5":
        reference = object.__new__(gr00t_n1_5.Reference)
        reference.robot, reference.size = json.loads((checkpoint / "data_config.json").read_text()), 28
        return reference.image(torch.from_numpy(frame).permute(2, 0, 1).float() / 255).numpy()
    numbers = gr00t_n1_6.RobotNumbers(checkpoint)
    image = numbers.transform(frame)
    if arch == "gr00t_n1_6":
        sides = [gr00t_n1_6.whole_tokens(n, 8) for n in image.shape[:2]]
        image = np.asarray(Image.fromarray(image).resize((sides[1], sides[0])))
    return (image.transpose(2, 0, 1).astype(np.float32) - np.float32(127.5)) / np.float32(127.5)


# --- the runtime -----------------------------------------------------------------------------------------------------


def run(vla, folder, case, state, frame, seed):
    """{tap: numbers} of one observation."""
    from PIL import Image

    Image.fromarray(frame).save(folder / "frame.png")
    command = [str(vla), "run", str(folder / "bundle.gguf"), "--image", f"camera={folder / 'frame.png'}", "--text", case.text, "--seed", str(seed),
               "--tap", "state,chunk,actions,pixels", "--taps-out", str(folder / "taps.gguf"), "--threads", "1", "--kernels", "float32"]
    for key, x in state.items():
        command += ["--state", f"state.{key}=" + ",".join(repr(float(v)) for v in x)]
    subprocess.run(command, check=True, capture_output=True)
    return recorder.read_taps(folder / "taps.gguf")


def off_by(ours, theirs):
    """Largest distance in units of the last place of the reference's numbers."""
    theirs = theirs.astype(np.float32)
    return float((np.abs(ours.astype(np.float64) - theirs) / np.spacing(np.abs(theirs))).max(initial=0))


def off_by_of_pose(ours, theirs):
    theirs = theirs.astype(np.float32)
    return max(float(np.abs(o.astype(np.float64) - t).max() / np.spacing(np.abs(t).max())) for o, t in
               ((ours[:, :3], theirs[:, :3]), (ours[:, 3:], theirs[:, 3:])))


def off_by_of_angles(ours, theirs):
    """Of Euler angles how far their rotations are apart, in units of 2e-6: where the middle angle is a right one the others mean little."""
    turns = np.abs((ours.astype(np.float64) - theirs + np.pi) % (2 * np.pi) - np.pi)
    return float((turns * np.abs(np.cos(theirs[:, 1:2]))).max() / 2e-6)


def compare(isaac, case, state, taps):
    """{what: its distance} of one observation."""
    expected, chunk = isaac.state(state), taps["chunk"].reshape(case.checkpoint.robot.rows, -1)
    actions, ours = isaac.actions(chunk, state), taps["actions"].reshape(chunk.shape)
    found, start, got = {"states": 0.0, "actions": 0.0, "poses": 0.0, "rotations": 0.0}, 0, taps["state"].ravel()[: expected.size]
    turned = np.concatenate([np.full(6 if k in isaac.turned["state"] else n, k in isaac.turned["state"]) for k, n in isaac.widths["state"].items()])
    if turned.any():
        found["rotations"] = float(np.abs(got - expected)[turned].max() / 2e-6)
        got, expected = got[~turned], expected[~turned]
    found["states"] = off_by(got, expected)
    for key, width in case.checkpoint.robot.actions.items():
        part = ours[:, start : start + width], actions[:, start : start + width]
        kind = "poses" if key in case.checkpoint.robot.poses else "rotations" if key in isaac.turned["action"] else "actions"
        found[kind] = max(found[kind], {"poses": off_by_of_pose, "rotations": off_by_of_angles, "actions": off_by}[kind](*part))
        start += width
    return found


def check_seed(args, seed, folder):
    """[distances of each observation]"""
    r, case = random.Random(seed + 7), draw(args.arch, seed)
    cases.write_checkpoint(case, folder)
    disturb(folder / "checkpoint", args.arch, r)
    with contextlib.redirect_stderr(sys.stdout):
        cases.write_bundle(folder, dtype="f32")
    isaac = (IsaacN15 if args.arch == "gr00t_n1_5" else Isaac)(args.isaac, folder / "checkpoint")
    generator, out = np.random.default_rng(seed), []
    height, width, _ = case.frames["camera"]
    for i in range(args.observations):
        scale = generator.choice([0.3, 1.0, 5.0])
        state = {key: (generator.normal(size=n) * scale).astype(np.float32) for key, n in isaac.widths["state"].items()}
        if i == 0 or args.arch != "gr00t_n1_5":  # N1.5 takes one camera size alone
            height, width = (height, width) if args.arch == "gr00t_n1_5" else generator.integers(5, 90, 2)
        frame = generator.integers(0, 256, (height, width, 3), dtype=np.uint8)
        taps = run(args.vla, folder, case, state, frame, seed + i)
        pixels = reference_pixels(args.arch, folder, frame)
        out.append(compare(isaac, case, state, taps) | {"pixels": float((taps["pixels"].ravel() != pixels.ravel()).sum())})
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arch", choices=("gr00t_n1_5", "gr00t_n1_6", "gr00t_n1_7"))
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--isaac", type=Path, required=True)
    parser.add_argument("--observations", type=int, default=20)
    parser.add_argument("--vla", type=Path, default=ROOT / "build/cpu/bin/vla")
    args = parser.parse_args()
    recorder.open_reference()
    warnings.filterwarnings("ignore")
    every = []
    for seed in range(args.first, args.last + 1):
        with tempfile.TemporaryDirectory() as scratch:
            found = check_seed(args, seed, Path(scratch))
        worst = {name: max(one[name] for one in found) for name in found[0]}
        print(f"seed {seed}: " + ", ".join(f"{name} {x:.3g}" for name, x in worst.items()), flush=True)
        every += found
    wrong = sum(max(one.values()) > 1 or one["pixels"] > 0 for one in every)
    same = sum(max(one.values()) == 0 for one in every)
    print(f"{len(every)} observations: {same} equal to the bit, {len(every) - same - wrong} within the bounds above, {wrong} beyond")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
