# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints with small random weights to the contracts of contracts.json: what public repositories state of policies and robots.

A row holds what its source states: features, keys of config.json that differ from those of today's release or are absent there, renamings,
keys of robots with their widths and modes.  Widths of layers are small ones of our own; what a config says about them is not kept.
"""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import jax_checkpoint
import numpy as np
from goldens import act, gr00t, gr00t_n1_5, gr00t_n1_6, gr00t_n1_7, groot, pi, smolvla
from goldens.cases import Case, backbone_folder, conversion_options, write_checkpoint
from goldens.files import write_json
from vla_cpp.convert import cli
from vla_cpp.convert.dtypes import to_f32
from vla_cpp.convert.safetensors_file import read_safetensors

ROWS = json.loads((Path(__file__).parent / "contracts.json").read_text())
TEXT = "put the red block into the bowl"
IMAGES, STATE = "observation.images.", "observation.state"
PARTS = {"MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "IDENTITY": ()}


def name_of(row):
    """Unique, for people: the repository, and what of it."""
    repository, _, path = row["source"].partition("@")
    return f"{repository.split('/')[1]}:{re.split('[ /]', path.removesuffix('/config.json'))[-1]}:{row['family']}"


def views_of(row):
    """view -> (height, width) of the cameras that a robot may have."""
    if "views" in row:
        return {view: tuple(size) for view, size in row["views"].items()}
    return {key.removeprefix(IMAGES): tuple(shape[1:]) for key, shape in row["inputs"].items() if key.startswith(IMAGES) and "empty_camera" not in key}


def frames_of(row):
    """Frames of all cameras; none of those that no renaming fills where there are some, nor of empty ones."""
    filled = {name.removeprefix(IMAGES) for name in row.get("rename", {}).values()}
    views = {view: (*size, "png") if not filled or view in filled else None for view, size in views_of(row).items()}
    empty = {key.removeprefix(IMAGES): None for key in row.get("inputs", {}) if "empty_camera" in key}
    return views | empty


def case_of(row):
    return BUILDERS[row["family"]](row)


def lerobot_case(row, checkpoint, text):
    return Case(7, frames_of(row), text, checkpoint, options=row.get("options", {}))


def act_case(row):
    policy = act.CONFIG | {k: v for k, v in row.get("config", {}).items() if k in act.CONFIG} | {
        "dim_model": 64, "n_heads": 8, "dim_feedforward": 96, "n_encoder_layers": 2, "n_vae_encoder_layers": 1}
    return lerobot_case(row, act.Checkpoint(policy, views_of(row), *widths(row)), "")


def smolvla_case(row):
    policy = smolvla.CONFIG | {k: v for k, v in row.get("config", {}).items() if k in smolvla.CONFIG}
    layers = policy["num_vlm_layers"] if policy["num_vlm_layers"] > 0 else 4
    checkpoint = smolvla.Checkpoint(smolvla.vision(36, 2, 3, 60, policy["resize_imgs_with_padding"][0], 64), smolvla.text(48, layers + 1, 6, 2, 8, 56), 2,
                                    policy, views_of(row), *widths(row), rename=row.get("rename", {}))
    return lerobot_case(row, checkpoint, TEXT)


def pi_case(row):
    arch, stated = row["family"], row.get("config", {})
    policy = pi.DEFAULTS[arch] | {k: v for k, v in stated.items() if k in pi.DEFAULTS[arch]} | {"dtype": "float32"}
    sizes = pi.tower(36, 2, 3, 52), pi.gemma(40, 3, 8, 1, 8, 72), pi.gemma(32, 3, 8, 1, 8, 48)
    return lerobot_case(row, pi.Checkpoint(arch, policy, *sizes, views_of(row), *widths(row), rename=row.get("rename", {})), TEXT)


def widths(row):
    return row["inputs"][STATE][0], row["action"]


def robot(row):
    return gr00t.Robot(tuple(row["views"]), row["states"], row["actions"], row["rows"], row.get("relative", {}),
                       mean_std=tuple(row.get("action_mean_std", ())))


def n1_5_case(row):
    height, width = next(iter(views_of(row).values()))
    camera = gr00t_n1_5.camera(width, height, row["state_modes"], row["action_modes"])
    head = gr00t.head(3, (4, 4, 9), (1, 5, 8), 20, 64, 32, 16)
    checkpoint = gr00t_n1_5.Checkpoint("my_arm", gr00t_n1_5.INDEX, robot(row), gr00t_n1_5.vision(24, 2, 3, 40, 224, 56),
                                       gr00t_n1_5.text(40, 4, 6, 2, 12, 56), head, camera)
    options = {"variant": "data_config.json"} | row.get("options", {})
    return gr00t.case(7, frames_of(row), TEXT, checkpoint, options=options)


def n1_6_case(row):
    head = gr00t.head(3, (6, 4, 9), None, 20, 128, 128, 50)
    checkpoint = gr00t_n1_6.Checkpoint(row["tag"], 2, robot(row), gr00t_n1_6.vision(24, 2, 3, 40, 16, 14), gr00t_n1_6.text(40, 4, 6, 2, 12, 56), head,
                                       {"shortest_image_edge": 256, "crop_fraction": 0.95})
    return gr00t.case(7, frames_of(row), TEXT, checkpoint, options=row.get("options", {}))


def n1_7_case(row):
    head = gr00t.head(4, (6, 4, 9), (1, 5, 8), 20, 128, 128, 50)
    like = gr00t_n1_7.CASES["gr00t_n1_7/libero"].checkpoint
    image = {"shortest_image_edge": 256, "crop_fraction": 0.95}
    text = like.text | {"max_position_embeddings": 8192}
    checkpoint = replace(like, tag=row["tag"], text=text, index=2, robot=robot(row), head=head, image=image, side=256)
    return gr00t.case(7, frames_of(row), TEXT, checkpoint, options=row.get("options", {}))


OPENPI = {"pi0_": "pi0", "pi05": "pi05"}
ROBOTS = {"aloha": ({"state": 14}, 14), "droid": ({"joint_position": 7, "gripper_position": 1}, 8), "libero": ({"state": 8}, 7)}


def openpi_robot(row):
    """(model, widths of the states, width of actions, horizon) of a configuration, by name or as the row states it."""
    variant = row["variant"]
    if isinstance(variant, dict) and "robot" in variant:
        return variant["model"], *ROBOTS[variant["robot"]], variant["horizon"]
    if isinstance(variant, dict):
        return variant["model"], variant["states"], variant["actions"], variant["horizon"]
    states, action = next(robot for name, robot in ROBOTS.items() if name in variant)
    return OPENPI[variant[:4]], states, action, row["horizon"]


def openpi_case(row):
    """The checkpoint of LeRobot with the same weights, which `write` takes apart."""
    arch, states, action, horizon = openpi_robot(row)
    policy = pi.DEFAULTS[arch] | {"chunk_size": horizon, "n_action_steps": horizon}
    sizes = pi.tower(36, 2, 3, 52), pi.gemma(40, 3, 8, 1, 8, 72), pi.gemma(32, 3, 8, 1, 8, 48)
    checkpoint = pi.Checkpoint(arch, policy, *sizes, views_of(row), sum(states.values()), action)
    variant = row["variant"]
    options = {"variant": variant if isinstance(variant, str) else "variant.json"} | row.get("options", {})
    # Grippers of ALOHA between closed and open: beyond, the angle of their servos is not defined.
    state = tuple([0.1, -0.4, 0.3, 0.7, -0.2, 0.5, 0.25, -0.3, 0.2, -0.6, 0.4, 0.1, -0.5, 0.75]) if sum(states.values()) == 14 else ()
    return Case(7, frames_of(row), TEXT, checkpoint, state=state, options=options)


def as_openpi(row, checkpoint, folder):
    """The folder that openpi's PyTorch code saves, or where the row has ranks of LoRA its JAX code, of LeRobot's."""
    folder.mkdir()
    shutil.copy(checkpoint / "dims.json", folder)
    shutil.copytree(checkpoint / "tokenizer", folder / "tokenizer")
    if "jax_lora" in row:
        tensors = {name: to_f32(values(entry), entry.dtype) for name, entry in read_safetensors(str(checkpoint / "model.safetensors")).entries.items()}
        dims = json.loads((checkpoint / "dims.json").read_text())
        jax_checkpoint.write(folder / "params", jax_checkpoint.arrays_of(tensors, dims, dict(zip(("", "_1"), row["jax_lora"]))))
    else:
        write_json(folder / "config.json", {"action_dim": 32, "action_horizon": openpi_robot(row)[3], "precision": "float32"} | row.get("config", {}))
        rename_tensors(checkpoint / "model.safetensors", folder / "model.safetensors", lambda name: name.removeprefix("model."))
    numbers = next(read_safetensors(str(file)).entries for file in sorted(checkpoint.glob("policy_preprocessor_step_*.safetensors")))
    stats = {key: {part: [float(x) for x in values(numbers[f"{feature}.{part}"])] for part in ("mean", "std", "q01", "q99")}
             for key, feature in (("state", STATE), ("actions", "action"))}
    write_json(folder / "assets" / row["assets"] / "norm_stats.json", {"norm_stats": stats})
    if isinstance(row["variant"], dict):
        write_json(folder / "variant.json", {"assets": row["assets"]} | row["variant"])
    return folder


def groot_case(row):
    head = gr00t.head(3, (4, 4, 9), (1, 5, 8), 20, row["config"]["max_state_dim"], row["config"]["max_action_dim"], 16)
    checkpoint = groot.n1_5(views_of(row), *widths(row), gr00t_n1_5.vision(24, 2, 3, 40, 224, 56), gr00t_n1_5.text(40, 4, 6, 2, 12, 56), head)
    return Case(7, frames_of(row), TEXT, checkpoint, options=groot.OPTIONS)


BUILDERS = {"groot": groot_case, "openpi": openpi_case, "act": act_case, "smolvla": smolvla_case, "pi0": pi_case, "pi05": pi_case, "gr00t_n1_5": n1_5_case, "gr00t_n1_6": n1_6_case,
            "gr00t_n1_7": n1_7_case}


def write(row, folder):
    """checkpoint/ as today's reference reads it.  Returns the case, and the folder that is converted: another one where the row is of an
    older layout, which the reference migrates first."""
    case = case_of(row)
    write_checkpoint(case, folder)
    checkpoint = folder / "checkpoint"
    if "inputs" in row:
        as_stated(row, checkpoint)
    if row.get("statistics") == "none":
        without_statistics(checkpoint)
    if row["family"] == "openpi":
        return case, as_openpi(row, checkpoint, folder / "openpi")
    return case, older(checkpoint, folder / "older") if row.get("layout") == "weights" else checkpoint


def as_stated(row, checkpoint):
    """config.json with the row's keys alone, in its order of features."""
    file = checkpoint / "config.json"
    config = json.loads(file.read_text())
    shapes = config["input_features"]
    config["input_features"] = {key: shapes[key] for key in row["inputs"]}
    config |= {key: value for key, value in row.get("config", {}).items() if key not in config}
    write_json(file, {key: value for key, value in config.items() if key not in row.get("absent", ())}, indent=2)


def pipelines(checkpoint):
    """file -> its content."""
    return {file: json.loads(file.read_text()) for file in sorted(checkpoint.glob("policy_*processor.json"))}


def without_statistics(checkpoint):
    """The pipelines of a base policy: normalizers of no features, without a file of numbers."""
    for file, pipeline in pipelines(checkpoint).items():
        for step in pipeline["steps"]:
            if "norm_map" in step["config"]:
                step["config"]["features"] = {}
                (checkpoint / step.pop("state_file")).unlink()
        write_json(file, pipeline, indent=2)


def older(checkpoint, folder):
    """The same policy as LeRobot saved it before September 2025: statistics among the weights, no pipelines."""
    shutil.copytree(checkpoint, folder)
    stats = {}
    for file, pipeline in pipelines(folder).items():
        for step in pipeline["steps"]:
            if "state_file" in step:
                stats |= {name: values(entry) for name, entry in read_safetensors(str(folder / step["state_file"])).entries.items()}
                (folder / step["state_file"]).unlink()
        file.unlink()
    config = json.loads((folder / "config.json").read_text())
    modes, numbers = config.get("normalization_mapping", {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}), {}
    for feature, kind in [(name, f["type"]) for name, f in (config["input_features"] | config["output_features"]).items()]:
        for group in {"ACTION": ("normalize_targets", "unnormalize_outputs")}.get(kind, ("normalize_inputs",)):
            for part in PARTS[modes[kind]]:
                numbers[f"{group}.buffer_{feature.replace('.', '_')}.{part}"] = stats[f"{feature}.{part}"]
    add_tensors(folder / "model.safetensors", numbers)
    return folder


def values(entry):
    return np.concatenate([*entry.chunks()]).reshape(entry.shape)


def header_of(file):
    """(header, data) of a safetensors file."""
    data = file.read_bytes()
    n = 8 + int.from_bytes(data[:8], "little")
    return json.loads(data[8:n]), data[n:]


def write_raw(file, header, data):
    text = json.dumps(header).encode()
    file.write_bytes(len(text).to_bytes(8, "little") + text + data)


def rename_tensors(file, to, rename):
    header, data = header_of(file)
    write_raw(to, {name if name == "__metadata__" else rename(name): entry for name, entry in header.items() if name != "__metadata__"}, data)


def add_tensors(file, numbers):
    """Puts float32 tensors behind those of a safetensors file."""
    header, data = header_of(file)
    end = len(data)
    for name, x in sorted(numbers.items()):
        header[name] = {"dtype": "F32", "shape": list(x.shape), "data_offsets": [end, end + 4 * x.size]}
        end += 4 * x.size
    write_raw(file, header, data + b"".join(x.astype("<f4").tobytes() for _, x in sorted(numbers.items())))


def states_of(row, state):
    """Numbers of an observation by the name of their feature, "" where there is one feature alone."""
    if isinstance(state, dict):
        return state
    widths = openpi_robot(row)[1] if row["family"] == "openpi" else {"": len(state)}
    if len(widths) == 1:
        return {"": state}
    numbers = iter(state)
    return {name: [next(numbers) for _ in range(n)] for name, n in widths.items()}


def convert(row, folder, checkpoint):
    """The exit code of vla-convert; the bundle is folder/bundle.gguf."""
    backbone = backbone_folder(checkpoint)
    return cli.main([str(checkpoint), *(["--backbone", str(backbone)] if backbone else []), "-o", str(folder / "bundle.gguf"), "--dtype", "f32",
                     "--quiet", "--vla", "none", *arguments(row, folder)])


def arguments(row, folder):
    """The options of vla-convert."""
    identity = row.get("options", {}).get("identity_stats", [])
    rest = [part for part in conversion_options(folder)]
    if identity:
        at = rest.index("--identity-stats")
        rest[at : at + 2] = [part for feature in identity for part in ("--identity-stats", feature)]
    return rest
