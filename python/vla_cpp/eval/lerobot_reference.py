# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot's policies on a CPU, from packages alone: import this before lerobot.

    from vla_cpp.eval import lerobot_reference as reference
    policy, before, after = reference.load("checkpoint")
    chunk = reference.predict(policy, before, after, frames, state, "open the faucet", noise)   # (horizon, d_action)

It changes nothing of what a policy computes. It (1) lets Python 3.11 read the five files of lerobot 0.6 that use the generics
syntax of 3.12, (2) lets the registry's torchvision, built for CUDA, load beside a torch without CUDA, and (3) keeps every lookup
offline, so that a missing file fails at once instead of being sought on a hub.
"""
import hashlib
import importlib.machinery
import importlib.metadata
import os
import re
import sys
import warnings
from pathlib import Path
from typing import Any, Mapping, Tuple

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning threads lose badly when something else runs as well

import numpy as np  # noqa: E402
import torch  # noqa: E402

def to_python_311(source: str) -> str:
    """Rewrites `type X = Y`, `class A[T](B):` and `def f[T](x):` to what Python 3.11 understands."""
    lines, out = source.split("\n"), []
    for line in lines:
        line = re.sub(r"^type (\w+) = ", r"\1 = ", line)
        found = re.match(r"(\s*)(class|def) (\w+)\[([^\]]*)\](.*)$", line)
        if found:
            indent, kind, name, parameters, rest = found.groups()
            names = [p.partition(":")[0].strip() for p in parameters.split(",")]
            if kind == "class":  # "(Base):" or ":"
                bases = re.match(r"\((.*)\):", rest)
                rest = f"({bases[1] + ', ' if bases else ''}__import__('typing').Generic[{', '.join(names)}]):"
            at = len(out)
            while at and out[at - 1].startswith(f"{indent}@"):  # type variables go above the decorators
                at -= 1
            out[at:at] = [f"{indent}{n} = __import__('typing').TypeVar({n!r})" for n in names]
            line = f"{indent}{kind} {name}{rest}"
        out.append(line)
    return "\n".join(out)


def _read_new_syntax() -> None:
    loader = importlib.machinery.SourceFileLoader
    compile_source = loader.source_to_code

    def source_to_code(self: Any, data: Any, path: Any, **options: Any) -> Any:
        if f"{os.sep}lerobot{os.sep}" in str(path):
            data = to_python_311(importlib.util.decode_source(data))
        return compile_source(self, data, path, **options)

    loader.source_to_code = source_to_code  # type: ignore[method-assign]


def _declare_vision_operators() -> Any:
    """torchvision describes two operators of its compiled part at import; declared here, the description finds them."""
    operators = torch.library.Library("torchvision", "FRAGMENT")
    operators.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    operators.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    return operators  # must stay alive


if sys.version_info < (3, 12):
    _read_new_syntax()
try:
    if torch.version.cuda is None and "+cpu" not in importlib.metadata.version("torchvision"):
        _operators = _declare_vision_operators()
    import lerobot  # noqa: F401
except ImportError as e:
    raise SystemExit(f"{e}. The PyTorch reference is missing: see 'Set up' in examples/metaworld/README.md") from e
warnings.filterwarnings("ignore", category=UserWarning)


def load(folder: "str | Path") -> Tuple[Any, Any, Any]:
    """(policy in float32, pre-processor, post-processor) of a checkpoint folder with the backbone's files in vlm/."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    folder = Path(folder).resolve()
    if not (folder / "model.safetensors").exists():
        raise SystemExit(f"no checkpoint in {folder}: model.safetensors is missing. Make one with train.py.")
    config = PreTrainedConfig.from_pretrained(str(folder))
    config.vlm_model_name, config.load_vlm_weights = str(folder / "vlm"), False
    policy = SmolVLAPolicy.from_pretrained(str(folder), config=config).float().eval()
    tokenizer = {"tokenizer_processor": {"tokenizer_name": config.vlm_model_name}}
    before, after = make_pre_post_processors(config, pretrained_path=str(folder), preprocessor_overrides=tokenizer)
    return policy, before, after


def identity(folder: "str | Path") -> str:
    """Which weights a checkpoint holds: the start of their SHA-256."""
    digest = hashlib.sha256()
    with open(Path(folder) / "model.safetensors", "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()[:16]


def predict(
    policy: Any,
    before: Any,
    after: Any,
    frames: Mapping[str, np.ndarray],
    state: Mapping[str, np.ndarray],
    text: str,
    noise: np.ndarray,
) -> np.ndarray:
    """One action chunk in the robot's units.

    frames: (height, width, 3) uint8 by view, named in full or by the part after observation.images; state: float32 vectors by
    name; noise (horizon, max_action_dim) float32 -> (horizon, d_action) float32
    """
    batch = {name: torch.from_numpy(values) for name, values in state.items()}
    for name, frame in frames.items():
        key = name if name.startswith("observation.") else f"observation.images.{name}"
        batch[key] = torch.from_numpy(np.ascontiguousarray(frame)).permute(2, 0, 1).float() / 255
    with torch.inference_mode():
        chunk = policy.predict_action_chunk(dict(before({**batch, "task": text})), noise=torch.from_numpy(noise)[None])
        return after(chunk)[0].float().numpy().copy()
