# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A checkpoint folder, opened without reading weights: configs, processors, tensor headers, statistics. What lies in the folder says
whose layout it is: LeRobot's, openpi's, or that of the authors of Evo-1, GR00T or BitVLA."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from typing import Dict, List, Optional, Tuple

import numpy as np

from .dtypes import STATISTICS, to_f32
from .errors import Code, Problems, refuse
from .files import BACKBONE_PATTERNS, HUB_FORM, HUB_NAME, HUB_PATTERNS, hub_folder, plain_name, read_json
from .safetensors_file import Entry, read_safetensors
from .torch_file import read_torch

LEROBOT, OPENPI, EVO1, BITVLA = "lerobot", "openpi", "evo1", "bitvla"  # layouts; those of GR00T are called as its releases
GR00T_MODELS = {"gr00t_n1_5": "gr00t_n1_5", "Gr00tN1d6": "gr00t_n1_6", "Gr00tN1d7": "gr00t_n1_7"}  # what config.json states as model_type
WEIGHTS = "model.safetensors"
INDEX = WEIGHTS + ".index.json"
# What Evo-1's trainer writes, with and without DeepSpeed, and the member that holds the policy's tensors.
TORCH_FILES = {"mp_rank_00_model_states.pt": "module", "checkpoint.pt": "model_state_dict"}
NORM_STATS = "norm_stats.json"
# What BitVLA's trainer writes beside the language model, each with the step in its name.
SIDECARS = ("action_head", "proprio_projector")
BITVLA_TYPES = ("bitvla", "openvla")  # what config.json may state as model_type
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
# Where releases without processor files kept statistics: "<group>.buffer_<feature, dots as underscores>.<statistic>".
OLD_GROUPS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.", "unnormalize_targets.")
MAX_STATISTIC = 1 << 24  # bytes; a statistic has one number per joint, or per pixel channel


@dataclass
class Checkpoint:
    """A policy on disk. `tensors` maps the policy's own names, without what torch.compile adds to them."""

    name: str
    folder: str
    revision: str
    config: dict
    tensors: Dict[str, Entry]
    aliases: Dict[str, str]  # a tensor that was not stored because it shares memory -> the one that was
    old_statistics: Dict[str, Entry]
    processors: Optional[Tuple[dict, dict]]  # pre and post, None in the older layout
    layout: str = LEROBOT
    notes: List[str] = field(default_factory=list)
    backbone: str = ""  # the repository and commit that --backbone fetched
    degraded: List[str] = field(default_factory=list)  # features that pass unnormalized because --identity-stats allows it

    def path(self, name: str) -> str:
        return os.path.join(self.folder, name)


def _shards(folder: str, problems: Problems) -> List[str]:
    index = read_json(os.path.join(folder, INDEX)).get("weight_map")
    if not isinstance(index, dict) or not index or not all(plain_name(file) for file in index.values()):
        raise refuse(os.path.join(folder, INDEX) + ": weight_map", "tensor names with file names", str(index)[:100])
    files = sorted(set(index.values()))
    found = {file: read_safetensors(os.path.join(folder, file)).entries for file in files}
    for name, file in index.items():
        if name not in found[file]:
            problems.add("tensor " + name, "the tensor in {} as {} says".format(file, INDEX), "none")
    for file, entries in found.items():
        for name in entries:
            if index.get(name) != file:
                problems.add(
                    "tensor " + name, "the tensor in {}".format(index.get(name, "no file, as " + INDEX + " says")), file
                )
    return files


def _weight_files(folder: str, problems: Problems) -> List[str]:
    single, index = (os.path.exists(os.path.join(folder, name)) for name in (WEIGHTS, INDEX))
    if single and index:
        raise refuse(
            folder, "either {} or {}".format(WEIGHTS, INDEX), "both", "remove the one that is not the policy's"
        )
    if not single and not index:
        hint = (
            "merge the adapter into the policy and save it again"
            if os.path.exists(os.path.join(folder, "adapter_config.json"))
            else "give the folder that holds config.json and " + WEIGHTS
        )
        raise refuse(folder, WEIGHTS, "no such file", hint, Code.IO)
    return [WEIGHTS] if single else _shards(folder, problems)


def _read_torch_file(folder: str) -> Dict[str, Entry]:
    present = [name for name in TORCH_FILES if os.path.exists(os.path.join(folder, name))]
    if len(present) != 1:
        found, code = ("no such file", Code.IO) if not present else ("both", Code.BAD_BUNDLE)
        raise refuse(folder, "either " + " or ".join(TORCH_FILES), found, "give the folder of one training step", code)
    return read_torch(os.path.join(folder, present[0]), TORCH_FILES[present[0]])


def _read_sidecars(folder: str, problems: Problems) -> Dict[str, Entry]:
    """The tensors of both files under their file's name, without what DistributedDataParallel puts in front."""
    tensors: Dict[str, Entry] = {}
    steps = {}
    for part in SIDECARS:
        pattern = re.compile(re.escape(part) + r"--(.+)_checkpoint\.pt")
        found = {name: match[1] for name in sorted(os.listdir(folder)) for match in [pattern.fullmatch(name)] if match}
        if len(found) != 1:
            hint = "the reference loads the only one" if found else "download it beside config.json"
            problems.add("{}--STEP_checkpoint.pt".format(part), "one such file", ", ".join(found) or "none", hint)
            continue
        ((name, steps[part]),) = found.items()
        for stored, entry in read_torch(os.path.join(folder, name), "").items():
            own = "{}.{}".format(part, stored[len("module.") :] if stored.startswith("module.") else stored)
            tensors[own] = entry._replace(name=own)
    if len(set(steps.values())) > 1:
        (head, proprio), where = (steps[part] for part in SIDECARS), "{}--{}_checkpoint.pt".format
        problems.add(where(SIDECARS[1], proprio), "the step of " + where(SIDECARS[0], head), proprio, "give the files of one step")
    return tensors


def _read_tensors(folder: str, layout: str, problems: Problems) -> Tuple[Dict[str, Entry], Dict[str, str]]:
    tensors: Dict[str, Entry] = {}
    aliases: Dict[str, str] = {}
    if layout == EVO1:
        return _read_torch_file(folder), aliases
    for file in _weight_files(folder, problems):
        content = read_safetensors(os.path.join(folder, file))
        # Every key of the metadata that names a stored tensor as its value is a shared tensor that was left out.
        aliases.update({clean(k): clean(v) for k, v in content.metadata.items() if v in content.entries})
        for stored, entry in content.entries.items():
            name = clean(stored)
            if name in tensors:
                problems.add("tensor " + name, "one tensor of this name", "a second one in " + file)
            tensors[name] = entry._replace(name=name)
    if layout == BITVLA:
        tensors.update(_read_sidecars(folder, problems))
    return tensors, aliases


def clean(name: str) -> str:
    """A compiled module's name without the infix of torch.compile."""
    return name.replace("._orig_mod", "")


def _read_processors(folder: str) -> Optional[Tuple[dict, dict]]:
    present = [os.path.exists(os.path.join(folder, name)) for name in PROCESSORS]
    if not any(present):
        return None
    if not all(present):
        missing = PROCESSORS[present.index(False)]
        raise refuse(
            os.path.join(folder, missing),
            "the file beside " + PROCESSORS[present.index(True)],
            "none",
            "save the policy again",
            Code.IO,
        )
    return read_json(os.path.join(folder, PROCESSORS[0])), read_json(os.path.join(folder, PROCESSORS[1]))


def open_checkpoint(source: str) -> Checkpoint:
    """A folder, or a repository as hub_folder() reads it. Errors: io, bad_bundle."""
    hub = hub_folder(source, HUB_PATTERNS)
    if hub is None and not os.path.isdir(source):
        raise refuse(source, "a checkpoint folder or " + HUB_FORM, "neither", _instead(source), Code.IO)
    folder, revision = (hub.folder, hub.commit) if hub else (source, "")
    name = hub.repo if hub else os.path.basename(os.path.abspath(folder))
    inner = os.path.join(folder, "pretrained_model")
    if not os.path.exists(os.path.join(folder, "config.json")) and os.path.isdir(inner):
        raise refuse(os.path.join(folder, "config.json"), "a policy", "none", "give " + inner, Code.IO)
    # openpi's training writes no config.json, its converter from JAX one without a type.
    has_assets = os.path.isdir(os.path.join(folder, "assets"))
    has_config = os.path.exists(os.path.join(folder, "config.json"))
    config = read_json(os.path.join(folder, "config.json")) if has_config or not has_assets else {}
    layout = _layout(folder, config, has_assets)
    problems = Problems(name)
    tensors, aliases = _read_tensors(folder, layout, problems)
    problems.raise_any()
    old = {key: entry for key, entry in tensors.items() if key.startswith(OLD_GROUPS)}
    weights = {key: entry for key, entry in tensors.items() if key not in old}
    return Checkpoint(name, folder, revision, config, weights, aliases, old, _read_processors(folder), layout)


def _instead(source: str) -> str:
    """What a source that is no folder was probably meant to be."""
    if source.endswith(".gguf"):
        return "a bundle is converted already: vla run takes it"
    if os.path.isfile(source):
        return "give the folder that holds the file"
    return "hub:{}@main fetches it from the hub".format(source) if re.fullmatch(HUB_NAME, source) else ""


def _layout(folder: str, config: dict, has_assets: bool) -> str:
    """LeRobot's config states a type, and none of the others does."""
    if "type" in config:
        return LEROBOT
    if str(config.get("model_type")) in GR00T_MODELS:
        return GR00T_MODELS[config["model_type"]]
    if config.get("model_type") in BITVLA_TYPES:
        return BITVLA
    if any(os.path.exists(os.path.join(folder, name)) for name in (*TORCH_FILES, NORM_STATS)):
        return EVO1
    return OPENPI if has_assets or "action_horizon" in config else LEROBOT


def given_backbone(checkpoint: Checkpoint, given: str) -> str:
    """The folder that --backbone means, empty without one. Errors: io."""
    hub = hub_folder(given, BACKBONE_PATTERNS)
    if hub:
        checkpoint.backbone = "{}@{}".format(hub.repo, hub.commit)
        checkpoint.notes.append("backbone config and tokenizer: {} at revision {}".format(hub.repo, hub.commit))
        return hub.folder
    if given and not os.path.isdir(given):
        raise refuse("--backbone " + given, "a folder or " + HUB_FORM, "neither", code=Code.IO)
    return given


def find_backbone(checkpoint: Checkpoint, given: str, named, key: str = "vlm_model_name") -> str:
    """The folder with the backbone's config.json: as given, inside the checkpoint, or the one that the policy's config states."""
    if given:
        return given
    inside = checkpoint.path("vlm")
    if os.path.exists(os.path.join(inside, "config.json")):
        checkpoint.notes.append("backbone config and tokenizer: from vlm/ inside the checkpoint")
        return inside
    if isinstance(named, str) and os.path.isabs(named) and os.path.isdir(named):
        checkpoint.notes.append(
            "backbone config and tokenizer: from the folder {} that config.json names".format(os.path.basename(named))
        )
        return named
    raise refuse(
        "backbone {}, which config.json: {} names".format(str(named)[:100], key),
        "--backbone DIR, or vlm/ inside the checkpoint",
        "neither",
        "--backbone {} fetches it from the hub".format(HUB_FORM),
        Code.IO,
    )


def read_statistic(entry: Entry) -> np.ndarray:
    """A small tensor as float32, as the reference loads statistics."""
    if entry.dtype not in STATISTICS or entry.n_bytes > MAX_STATISTIC:
        raise refuse(
            "{}: tensor {}".format(entry.path, entry.name),
            "a statistic in F32",
            "{} bytes of {}".format(entry.n_bytes, entry.dtype),
        )
    parts = [to_f32(part, entry.dtype) for part in entry.chunks()]
    return (np.concatenate(parts) if parts else np.zeros(0, np.float32)).reshape(entry.shape)
