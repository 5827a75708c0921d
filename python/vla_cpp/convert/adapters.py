# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LoRA adapters of PEFT: read beside their base policy, and merged into its tensors while these are streamed.

    W + scale B A,   scale = alpha / r, or alpha / sqrt(r) with use_rslora

Computed in float64 and rounded once. Reference: peft tuners/lora/layer.py (get_delta_weight, merge), utils/other.py (get_pattern_key).
"""

from __future__ import annotations

import math
import os
import re
from typing import Dict, Iterator, List, NamedTuple, Optional, Tuple

import numpy as np

from .dtypes import WEIGHTS, bf16_to_f32, f32_to_bf16, to_f32
from .errors import Code, Problems, refuse
from .files import member, read_json
from .safetensors_file import CHUNK_BYTES, Entry, read_safetensors
from .section import Section

CONFIG, WEIGHTS_FILE = "adapter_config.json", "adapter_model.safetensors"
PREFIX = "base_model.model."
MAX_RANK = 4096
# Fields of LoraConfig that change the sum above in ways that this module does not implement.
UNREAD = set(
    """
    use_dora use_qalora use_bdlora alora_invocation_tokens arrow_config kasa_config monteclora_config velora_config layer_replication
    target_parameters trainable_token_indices megatron_config ensure_weight_tying
    """.split()
)
# Initializations that leave the base's weights unchanged; others (PiSSA, OLoRA, LoftQ, CorDA) subtract a part from them.
PLAIN_STARTS = (True, False, None, "gaussian", "eva", "orthogonal")
# Fields without effect on the merged weights: of training and of the library, and those that say which modules have tensors.
IGNORED = set(
    """
    auto_mapping base_model_name_or_path revision inference_mode task_type peft_version lora_dropout target_modules exclude_modules
    modules_to_save layers_to_transform layers_pattern eva_config corda_config lora_ga_config loftq_config runtime_config megatron_core
    qalora_group_size fan_in_fan_out bias lora_bias
    """.split()
)
KNOWN = {"peft_type", "r", "lora_alpha", "use_rslora", "rank_pattern", "alpha_pattern", "init_lora_weights"}


class Factors(NamedTuple):
    """The summand of a tensor (rows, ...): left (rows, r) times right (r, product of the other dimensions)."""

    left: np.ndarray
    right: np.ndarray


class Merged(NamedTuple):
    """The sum of a base tensor and an adapter's product. Has the members of an `Entry`; its chunks are float32."""

    base: Entry
    factors: Factors
    name: str
    first: int = 0  # the row at which `base` begins in the whole tensor
    dtype: str = "F32"

    @property
    def shape(self) -> Tuple[int, ...]:
        return self.base.shape

    @property
    def path(self) -> str:
        return self.base.path

    @property
    def n_bytes(self) -> int:
        return 4 * math.prod(self.shape)

    @property
    def stored(self) -> str:
        """The base tensor's type in the file, also used in the bundle unless --dtype asks for another."""
        return self.base.dtype

    def __hash__(self) -> int:  # arrays have no hash
        return hash((self.name, self.first))

    def rows(self, first: int, count: int) -> Merged:
        return self._replace(base=self.base.rows(first, count), first=self.first + first)

    def chunks(self, chunk_bytes: int = CHUNK_BYTES) -> Iterator[np.ndarray]:
        width = math.prod(self.shape[1:])
        n_row = max(1, chunk_bytes // (8 * width))
        for start in range(0, self.shape[0], n_row):
            part = self.base.rows(start, min(n_row, self.shape[0] - start))
            whole = np.concatenate([to_f32(raw, part.dtype) for raw in part.chunks()]).astype(np.float64).reshape(-1, width)
            at = self.first + start
            with np.errstate(all="ignore"):  # numbers that are not finite are reported with the tensor
                yield (whole + self.factors.left[at : at + len(whole)] @ self.factors.right).astype(np.float32).ravel()


class Adapter(NamedTuple):
    """An adapter's tensors, by the names of the policy's tensors."""

    factors: Dict[str, Factors]
    replaced: Dict[str, Entry]  # tensors that were trained in full and replace those of the base

    def renamed(self, canonical) -> Adapter:
        return Adapter(
            {canonical(name): value for name, value in self.factors.items()},
            {canonical(name): value for name, value in self.replaced.items()},
        )


def stored_dtype(entry) -> str:
    """The type of a tensor in the file; for a computed tensor the type of its base tensor."""
    return getattr(entry, "stored", entry.dtype)


def is_adapter_name(name: str) -> bool:
    return ".lora_" in name


def base_of(folder: str) -> str:
    """The base policy that adapter_config.json names; empty if it names none."""
    stated = read_json(os.path.join(folder, CONFIG)).get("base_model_name_or_path")
    return stated if isinstance(stated, str) else ""


def read_adapter(folder: str, problems: Problems) -> Adapter:
    """The adapter in a folder. Errors: io, bad_bundle, unsupported."""
    path = os.path.join(folder, WEIGHTS_FILE)
    if not os.path.exists(path):
        raise refuse(path, "the adapter's tensors", "no such file", "save the adapter with safetensors", Code.IO)
    return parse(read_json(os.path.join(folder, CONFIG)), read_safetensors(path).entries, problems)


def parse(config: dict, entries: Dict[str, Entry], problems: Problems, in_bf16: bool = False) -> Adapter:
    """Reads an adapter. `config`: adapter_config.json. `entries`: tensors by their names in the file. `in_bf16`: rounds them to bf16 first."""
    section = _check(config, problems)
    parts: Dict[str, Dict[str, Entry]] = {}  # module -> tensors by the rest of their names
    replaced: Dict[str, Entry] = {}
    for stored, entry in entries.items():
        name = stored[len(PREFIX) :] if stored.startswith(PREFIX) else stored
        found = re.fullmatch(r"(.+)\.lora_(\w+?)(?:\.(?!weight$|bias$)\w+)?(?:\.(weight|bias))?", name)
        if found:
            parts.setdefault(found[1].replace(".base_layer", ""), {})[found[2] + (".bias" if found[3] == "bias" else "")] = entry
            continue
        own = re.sub(r"\.(base_layer|modules_to_save\.\w+|modules_to_save|original_module)(?=\.)", "", name)
        if not re.search(r"\.original_module\.", name):
            replaced[own] = entry._replace(name=own)
    factors: Dict[str, Factors] = {}
    for module, tensors in sorted(parts.items()):
        factors.update(_factors(module, tensors, section, problems, in_bf16))
    return Adapter(factors, replaced)


def _check(config: dict, problems: Problems) -> Section:
    section = Section(CONFIG, config, {"r": 8, "lora_alpha": 8, "use_rslora": False, "init_lora_weights": True}, problems)
    if config.get("peft_type") != "LORA":
        section.bad("peft_type", "LORA", hint="merge it with peft (merge_and_unload) and save the policy", unsupported=True)
    if config.get("use_dora"):
        hint = "DoRA scales the rows of the sum: merge it with peft (merge_and_unload) and save the policy"
        section.bad("use_dora", "False", hint=hint, unsupported=True)
    for key in sorted(set(config) - IGNORED - KNOWN - {"use_dora"}):
        if config[key]:
            hint = "" if key in UNREAD else "it may change numbers; a newer vla-convert may know it"
            section.bad(key, "no such field, or one that is not set", str(config[key])[:80], hint, unsupported=True)
    if config.get("init_lora_weights", True) not in PLAIN_STARTS:
        hint = "this start changes the base's weights: merge the adapter with peft and save the policy"
        section.bad("init_lora_weights", "one that leaves the base as it is", hint=hint, unsupported=True)
    if not isinstance(section.get("use_rslora"), bool):
        section.bad("use_rslora", "true or false")
    return section


def _scale(module: str, rank: int, section: Section) -> float:
    stated = {}
    for key, pattern in (("r", "rank_pattern"), ("lora_alpha", "alpha_pattern")):
        table = member(section.values, pattern, dict, CONFIG)
        own = next((value for regex, value in table.items() if _matches(regex, module, section)), section.get(key))
        if not isinstance(own, (int, float)) or isinstance(own, bool) or not 0 < own < 1e6:
            section.bad(key, "a number above 0", repr(own))
            own = 1
        stated[key] = own
    if stated["r"] != rank:
        section.bad("r", "{}, the rank of the tensors of {}".format(rank, module), str(stated["r"]))
    return stated["lora_alpha"] / (math.sqrt(rank) if section.get("use_rslora") is True else rank)


def _matches(regex: str, module: str, section: Section) -> bool:
    try:
        return re.match(r"(.*\.)?({})$".format(regex), module) is not None
    except re.error as error:
        section.bad("rank_pattern, alpha_pattern", "regular expressions", str(error))
        return False


def _factors(module: str, tensors: Dict[str, Entry], section: Section, problems: Problems, in_bf16: bool) -> Dict[str, Factors]:
    """The factors of a linear layer, a convolution or an embedding, by tensor name."""
    where = "adapter of " + module
    if "magnitude_vector" in tensors:
        hint = "DoRA scales the rows of the sum: merge it with peft (merge_and_unload) and save the policy"
        problems.unsupported(where, "LoRA", "DoRA (lora_magnitude_vector)", hint)
        return {}
    bias = tensors.pop("B.bias", None)
    kinds = [("A", "B"), ("embedding_A", "embedding_B")]
    names = next((names for names in kinds if set(tensors) == set(names)), None)
    if names is None:
        problems.add(where, "lora_A and lora_B", ", ".join("lora_" + name for name in sorted(tensors)) or "lora_B.bias alone")
        return {}
    down, up = (tensors[name] for name in names)
    if any(entry.dtype not in WEIGHTS or len(entry.shape) not in (2, 4) or 0 in entry.shape for entry in (down, up)):
        problems.add(where, "matrices of F32, F16 or BF16", "{} {} and {} {}".format(down.dtype, down.shape, up.dtype, up.shape))
        return {}
    rank = down.shape[0]
    if up.shape[1] != rank or any(size != 1 for size in up.shape[2:]) or rank > MAX_RANK:
        problems.add(where, "lora_B of {} columns".format(rank), str(up.shape))
        return {}
    scale, a, b = _scale(module, rank, section), _whole(down, in_bf16), _whole(up, in_bf16)
    left, right = (a.T, b.T) if names[0].startswith("embedding") else (b, a)
    made = {module + ".weight": Factors(scale * left, right)}
    if bias is not None:
        made[module + ".bias"] = Factors(scale * _whole(bias, in_bf16).reshape(-1, 1), np.ones((1, 1)))
    return made


def _whole(entry: Entry, in_bf16: bool) -> np.ndarray:
    """The whole tensor in float64, as a matrix (rows, product of the other dimensions)."""
    values = np.concatenate([to_f32(raw, entry.dtype) for raw in entry.chunks()])
    if in_bf16:
        values = bf16_to_f32(f32_to_bf16(values))
    return values.astype(np.float64).reshape(entry.shape[0], -1)


def merge(tensors: Dict[str, Entry], adapter: Optional[Adapter], notes: List[str], problems: Problems) -> None:
    """Replaces the base's tensors by the sums with the adapter's products."""
    if adapter is None:
        return
    for name, entry in adapter.replaced.items():
        base = tensors.get(name)
        if base is None or base.shape != entry.shape:
            problems.add("adapter: tensor " + name, "a tensor of the base of its shape", "none" if base is None else str(base.shape))
        tensors[name] = entry
    for name, factors in adapter.factors.items():
        base = tensors.get(name)
        shape = (factors.left.shape[0], factors.right.shape[1])
        if base is None or not base.shape or (base.shape[0], math.prod(base.shape[1:])) != shape:
            problems.add(
                "adapter: tensor " + name,
                "a tensor of the base of {} rows of {} numbers".format(*shape),
                "none" if base is None else str(base.shape),
            )
        else:
            tensors[name] = Merged(base, factors, name)
    text = "adapter merged into {} tensors of the base; {} tensors are its own"
    notes.append(text.format(len(adapter.factors), len(adapter.replaced)))
