# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Opens a checkpoint folder without reading weights: configs, processors, tensor headers, statistics. The files in the folder determine
its layout: LeRobot's, openpi's, or that of an architecture's authors."""

from __future__ import annotations

import glob
import os
from dataclasses import dataclass, field
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Tuple

import numpy as np

from .adapters import CONFIG as ADAPTER_CONFIG
from .adapters import WEIGHTS_FILE as ADAPTER_WEIGHTS
from .adapters import Adapter, base_of, is_adapter_name, parse, read_adapter
from .dtypes import STATISTICS, to_f32
from .errors import Code, Problems, refuse
from .files import plain_name, read_json
from .hub import BACKBONE_PATTERNS, HUB_FORM, HUB_PATTERNS, hub_folder
from .instead import check_is_policy, instead_of
from .options import Option
from .safetensors_file import Entry, read_safetensors

LEROBOT, OPENPI = "lerobot", "openpi"  # layouts; a layout of an architecture's authors has the name of the architecture
GROOT = "groot"  # value of `type` in LeRobot's config of GR00T
WEIGHTS = "model.safetensors"
INDEX = WEIGHTS + ".index.json"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
# Backbones that policies name, with the commit from which to fetch config and tokenizer if the checkpoint lacks them.
BACKBONES = {"HuggingFaceTB/SmolVLM2-500M-Video-Instruct": "7b375e1b73b11138ff12fe22c8f2822d8fe03467"}
# Groups of statistics in checkpoints without processor files, with tensors "<group>.buffer_<feature, dots as underscores>.<statistic>".
OLD_GROUPS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.", "unnormalize_targets.")
MAX_STATISTIC = 1 << 24  # bytes; a statistic has one number per joint, or per pixel channel


Tensors = Tuple[Dict[str, Entry], Dict[str, str]]  # tensors by name; aliases: a tensor left out because it shares memory -> the stored one


@dataclass
class Checkpoint:
    """A policy on disk. The names in `tensors` are the policy's own, without the infix of torch.compile."""

    name: str
    folder: str
    revision: str
    config: dict
    tensors: Dict[str, Entry]
    aliases: Dict[str, str]  # as in Tensors
    old_statistics: Dict[str, Entry]
    processors: Optional[Tuple[dict, dict]]  # pre and post, None in the older layout
    layout: str = LEROBOT
    notes: List[str] = field(default_factory=list)
    robot: str = ""  # the robot whose statistics to use, if the checkpoint has those of several
    backbone: str = ""  # the repository and commit that --backbone fetched
    base: str = ""  # the folder of the policy that this one, or an adapter, was trained from
    adapter: Optional[Adapter] = None
    documents: Dict[str, dict] = field(default_factory=dict)  # by file name: contents used instead of the JSON file
    vectors: Any = None  # for LeRobot's GR00T: a robot whose states and actions are one vector each (archs/gr00t/lerobot_files.py)
    degraded: List[str] = field(default_factory=list)  # features that stay unnormalized because --identity-stats allows it

    def path(self, name: str) -> str:
        """The path of a file; if the folder lacks the file, its path in the base's folder."""
        own = os.path.join(self.folder, name)
        return os.path.join(self.base, name) if self.base and not os.path.exists(own) else own


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
                problems.add("tensor " + name, "the tensor in {}".format(index.get(name, "no file, as " + INDEX + " says")), file)
    return files


def _weight_files(folder: str, problems: Problems) -> List[str]:
    single, index = (os.path.exists(os.path.join(folder, name)) for name in (WEIGHTS, INDEX))
    if single and index:
        raise refuse(folder, "either {} or {}".format(WEIGHTS, INDEX), "both", "remove the one that is not the policy's")
    if not single and not index:
        hint = "give the folder that holds config.json and " + WEIGHTS
        raise refuse(folder, WEIGHTS, "no such file", hint, Code.IO)
    return [WEIGHTS] if single else _shards(folder, problems)


def read_stored(folder: str, problems: Problems) -> Tensors:
    """The tensors of model.safetensors or its shards."""
    tensors: Dict[str, Entry] = {}
    aliases: Dict[str, str] = {}
    for file in _weight_files(folder, problems):
        content = read_safetensors(os.path.join(folder, file))
        # A metadata key whose value is the name of a stored tensor is a shared tensor that was left out.
        aliases.update({clean(k): clean(v) for k, v in content.metadata.items() if v in content.entries})
        for stored, entry in content.entries.items():
            name = clean(stored)
            if name in tensors:
                problems.add("tensor " + name, "one tensor of this name", "a second one in " + file)
            tensors[name] = entry._replace(name=name)
    return tensors, aliases


class Layout(NamedTuple):
    """How checkpoints of one layout are saved and recognized."""

    name: str  # owner of the layout, to complete "a checkpoint of ..."
    options: Tuple[Option, ...]  # options for facts that these checkpoints do not state
    model_types: Tuple[str, ...] = ()  # values of model_type in config.json
    keys: Tuple[str, ...] = ()  # keys of config.json; any one identifies the layout among those with the same model_type
    value: Tuple[str, Tuple[str, ...]] = ("", ())  # a key of config.json and its values, any of which identifies the layout
    files: Tuple[str, ...] = ()  # file names or patterns; any one identifies the layout if config.json does not decide
    read: Callable[[str, Problems], Tensors] = read_stored  # reads the folder's tensors and aliases
    about: str = ""  # a paragraph of `vla-convert --help`
    has_config: bool = True  # whether there is a config.json

    def tells(self, folder: str) -> bool:
        return any(glob.glob(os.path.join(glob.escape(folder), name)) for name in self.files)


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
            os.path.join(folder, missing), "the file beside " + PROCESSORS[present.index(True)], "none", "save the policy again", Code.IO
        )
    return read_json(os.path.join(folder, PROCESSORS[0])), read_json(os.path.join(folder, PROCESSORS[1]))


def open_checkpoint(source: str, authors: Mapping[str, Layout], base: str = "") -> Checkpoint:
    """Opens a folder, or a repository in the form of hub_folder(). `authors`: layouts by architecture. `base`: value of --base, the policy
    that an adapter was trained on. Errors: usage, io, bad_bundle."""
    name, folder, revision = _opened(source)
    check_is_policy(folder)
    sizes = _opened(base) if base and states_no_sizes(folder) else None
    below = None if sizes else _base_of(folder, base)  # the policy with the weights
    # openpi's training writes no config.json; its converter from JAX writes one without a type.
    has_assets = any(os.path.isdir(os.path.join(folder, name)) for name in ("assets", "params"))
    own = folder if os.path.exists(os.path.join(folder, "config.json")) or not below else below.folder
    has_config = os.path.exists(os.path.join(own, "config.json"))
    states_sizes = has_assets or any(not each.has_config and each.tells(own) for each in authors.values())
    config = read_json(os.path.join(own, "config.json")) if has_config or not states_sizes else {}
    layout = _layout(below.folder if below else folder, config, has_assets, authors)
    problems, notes = Problems(name), []
    read = authors[layout].read if layout in authors else read_stored
    tensors, aliases = read(below.folder if below else folder, problems)
    problems.raise_any()
    tensors, aliases = without_prefix(tensors, aliases, layout, notes)
    adapter = read_adapter(folder, problems) if below else _adapter_inside(folder, tensors, problems)
    if below:
        notes.append("adapter of {}{}".format(below.name, " at revision " + below.revision if below.revision else ""))
        name = "{} on {}".format(name, below.name + ("@" + below.revision if below.revision else ""))
    problems.raise_any()
    old = {key: entry for key, entry in tensors.items() if key.startswith(OLD_GROUPS)}
    weights = {key: entry for key, entry in tensors.items() if key not in old}
    if config.get("use_peft") and adapter is None:
        notes.append("use_peft is true, but the weights are complete without an adapter: read as merged")
    processors = _read_processors(folder) or (_read_processors(below.folder) if below and own == below.folder else None)
    if sizes:
        name = "{} on {}".format(name, sizes.name + ("@" + sizes.revision if sizes.revision else ""))
    others = below.folder if below else sizes.folder if sizes else ""
    return Checkpoint(name, folder, revision, config, weights, aliases, old, processors, layout, notes, base=others, adapter=adapter)


def states_no_sizes(folder: str) -> bool:
    """Whether the config omits the sizes of the network, which only the base's config states: LeRobot's GR00T."""
    path = os.path.join(folder, "config.json")
    return os.path.exists(path) and read_json(path).get("type") == GROOT


class Opened(NamedTuple):
    """An opened source. name: of the repository or folder; folder: its path; revision: commit of the repository, else empty."""

    name: str
    folder: str
    revision: str


def _opened(source: str) -> Opened:
    hub = hub_folder(source, HUB_PATTERNS)
    if hub is None and not os.path.isdir(source):
        raise refuse(source, "a checkpoint folder or " + HUB_FORM, "neither", instead_of(source), Code.IO)
    return Opened(hub.repo, hub.folder, hub.commit) if hub else Opened(os.path.basename(os.path.abspath(source)), source, "")


def _base_of(folder: str, given: str) -> Optional[Opened]:
    """The base policy of the adapter in a folder; None if the folder has all of the policy's weights. Errors: usage, io, unsupported."""
    is_adapter = os.path.exists(os.path.join(folder, ADAPTER_CONFIG))
    is_whole = any(os.path.exists(os.path.join(folder, name)) for name in (WEIGHTS, INDEX))
    if given and not is_adapter:
        raise refuse("--base", "a LoRA adapter, with " + ADAPTER_CONFIG, "a policy", "leave the option out", Code.USAGE)
    if not is_adapter or (is_whole and not given):
        if is_adapter and os.path.exists(os.path.join(folder, ADAPTER_WEIGHTS)) and _uses_adapter(folder):
            hint = "remove {} and {} if the weights are merged; --base {} if they are not".format(ADAPTER_CONFIG, ADAPTER_WEIGHTS, HUB_FORM)
            raise refuse(folder, "a merged policy or an adapter", "both {} and {}".format(WEIGHTS, ADAPTER_WEIGHTS), hint)
        return None
    stated = base_of(folder)
    if not given and not os.path.isdir(stated):
        hint = "--base DIR, or --base hub:{}@main fetches it".format(stated[:100]) if stated else "--base DIR or " + HUB_FORM
        found = "a LoRA adapter of " + (stated[:100] or "a policy that {} does not name".format(ADAPTER_CONFIG))
        raise refuse(folder, "the policy that the adapter was trained on", found, hint, Code.UNSUPPORTED)
    below = _opened(given or stated)
    if os.path.exists(os.path.join(below.folder, ADAPTER_CONFIG)):
        hint = "merge that one first (merge_and_unload of peft) and save the policy"
        raise refuse(below.folder, "a policy with all of its weights", "another adapter", hint, Code.UNSUPPORTED)
    return below


def _uses_adapter(folder: str) -> bool:
    path = os.path.join(folder, "config.json")
    return os.path.exists(path) and bool(read_json(path).get("use_peft"))


def _adapter_inside(folder: str, tensors: Dict[str, Entry], problems: Problems) -> Optional[Adapter]:
    """The adapter in weights that PEFT saved together with the base's; None if there is none. Leaves only the base's in `tensors`."""
    own = {name: tensors.pop(name) for name in list(tensors) if is_adapter_name(name)}
    for name in [name for name in tensors if ".base_layer." in name]:
        tensors[name.replace(".base_layer.", ".")] = tensors.pop(name)
    if not own:
        return None
    path = os.path.join(folder, ADAPTER_CONFIG)
    if not os.path.exists(path):
        hint = "merge the adapter (merge_and_unload of peft) and save the policy, or put the adapter's {} there".format(ADAPTER_CONFIG)
        problems.unsupported("tensor " + next(iter(own)), "merged weights", "an adapter whose alpha nothing states", hint)
        return None
    return parse(read_json(path), own, problems)


# Prefixes that wrappers add to all names of a module: torch's wrapper for several GPUs, torch.compile, and PEFT's class.
WRAPPERS = ("module.", "_orig_mod.", "base_model.model.")


def without_prefix(tensors: Dict[str, Entry], aliases: Dict[str, str], layout: str, notes: List[str]) -> Tensors:
    """Removes from all names a common prefix that is not part of the policy's own names."""
    cut = ""
    while tensors:
        own = "model." if layout not in (LEROBOT, OPENPI) else "model.model."
        found = next((p for p in (*WRAPPERS, own) if all(name.startswith(cut + p) for name in tensors)), "")
        if not found:
            break
        cut += "model." if found == "model.model." else found
    if not cut:
        return tensors, aliases
    notes.append("names of all tensors begin with {}, which is left out".format(cut))
    n = len(cut)
    return {name[n:]: entry._replace(name=name[n:]) for name, entry in tensors.items()}, {k[n:]: v[n:] for k, v in aliases.items()}


def of_model_type(config: dict, folder: str, authors: Mapping[str, Layout]) -> str:
    """The architecture with config.json's model_type; empty if there is none. Among several it is the first whose `value` matches; else one
    whose `keys` occur, preferably with its `files` in the folder; else the first."""
    found = [arch for arch, layout in authors.items() if config.get("model_type") in layout.model_types]
    told = [arch for arch in found if config.get(authors[arch].value[0]) in authors[arch].value[1]]
    own = [arch for arch in found if any(key in config for key in authors[arch].keys)]
    return "".join(told[:1]) or next((arch for arch in own if authors[arch].tells(folder)), "".join((own or found)[:1]))


def _layout(folder: str, config: dict, has_assets: bool, authors: Mapping[str, Layout]) -> str:
    """The layout's name. Only LeRobot's config states a type and features."""
    if "type" in config or "input_features" in config:
        return LEROBOT
    stated = of_model_type(config, folder, authors)
    if stated:
        return stated
    for arch, layout in authors.items():
        if layout.tells(folder):
            return arch
    return OPENPI if has_assets or "paligemma_variant" in config else LEROBOT


def given_backbone(checkpoint: Checkpoint, given: str) -> str:
    """The folder that --backbone names, downloaded if it is on the hub; empty without the option. Errors: io."""
    hub = hub_folder(given, BACKBONE_PATTERNS)
    if hub:
        checkpoint.backbone = "{}@{}".format(hub.repo, hub.commit)
        checkpoint.notes.append("backbone config and tokenizer: {} at revision {}".format(hub.repo, hub.commit))
        return hub.folder
    if given and not os.path.isdir(given):
        raise refuse("--backbone " + given, "a folder or " + HUB_FORM, "neither", code=Code.IO)
    return given


def find_backbone(checkpoint: Checkpoint, given: str, named, key: str = "vlm_model_name", own: str = "vlm") -> str:
    """The folder with the backbone's config.json: the given one, else `own` inside the checkpoint."""
    if given:
        return given
    inside = checkpoint.path(own)
    if os.path.exists(os.path.join(inside, "config.json")):
        checkpoint.notes.append("backbone config and tokenizer: from {}/ inside the checkpoint".format(own))
        return inside
    raise refuse(
        "backbone {}, which config.json: {} names".format(str(named)[:100], key),
        "--backbone DIR, or {}/ inside the checkpoint".format(own),
        "neither",
        _backbone_hint(named),
        Code.IO,
    )


def _backbone_hint(named) -> str:
    """A hint for a missing backbone. A checkpoint may come from anyone, so a folder that its config names is read only on --backbone."""
    if isinstance(named, str) and named in BACKBONES:
        return "run vla-convert again with --backbone hub:{}@{}".format(named, BACKBONES[named])
    if isinstance(named, str) and os.path.isabs(named):
        return "where that folder is the one you mean, run vla-convert again with --backbone {}".format(named)
    return "--backbone {} fetches it from the hub".format(HUB_FORM)


def read_statistic(entry: Entry) -> np.ndarray:
    """A statistic as float32, the type in which the reference loads it."""
    if entry.dtype not in STATISTICS or entry.n_bytes > MAX_STATISTIC:
        raise refuse(
            "{}: tensor {}".format(entry.path, entry.name), "a statistic in F32", "{} bytes of {}".format(entry.n_bytes, entry.dtype)
        )
    parts = [to_f32(part, entry.dtype) for part in entry.chunks()]
    return (np.concatenate(parts) if parts else np.zeros(0, np.float32)).reshape(entry.shape)
