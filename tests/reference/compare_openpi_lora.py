# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""LoRA of openpi's JAX code: products of its own modules beside those of the tensors that the converter merges.

    python tests/reference/compare_openpi_lora.py FOLDER/openpi

Needs a checkout of openpi, jax, flax, orbax-checkpoint and tensorstore. Orbax writes a random policy with LoRA; openpi's Einsum and
FeedForward multiply with its arrays, the converter reads it. Exit code 1 where a product differs by more than 1e-6 of its largest number.
"""

import importlib.util
import sys
import tempfile
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / part) for part in ("python", "tests/convert")]

from jax_checkpoint import LLM, PALIGEMMA, TOWERS, VISION, arrays_of  # noqa: E402
from vla_cpp.convert.archs.pi0 import jax_layout  # noqa: E402
from vla_cpp.convert.errors import Problems  # noqa: E402

DIMS = {
    "vision": {"num_attention_heads": 2},
    "gemma_2b": {"num_heads": 4, "head_dim": 8},
    "gemma_300m": {"num_heads": 4, "head_dim": 8},
}
RANKS = {"": 16, "_1": 32}
ATTENTION = {"q_einsum": "BTD,NDH->BTNH", "kv_einsum": "BSD,2KDH->2BSKH", "attn_vec_einsum": "BTNH,NHD->BTD"}  # models/gemma.py


def openpi_lora(checkout):
    """openpi's models/lora.py, without its checks of array types."""
    sys.modules["openpi"], sys.modules["openpi.shared"] = types.ModuleType("openpi"), types.ModuleType("openpi.shared")
    sys.modules["openpi.shared.array_typing"] = types.SimpleNamespace(Array=jax.Array)
    sys.modules["openpi.shared"].array_typing = sys.modules["openpi.shared.array_typing"]
    spec = importlib.util.spec_from_file_location("lora", Path(checkout) / "src/openpi/models/lora.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["lora"] = module
    spec.loader.exec_module(module)
    return module


def random_policy(random):
    """LeRobot's tensors of a small π0, as far as arrays are made of them."""
    shapes = {f"{VISION}embeddings.patch_embedding.weight": (24, 3, 4, 4), f"{VISION}embeddings.patch_embedding.bias": (24,)}
    shapes |= {f"{VISION}embeddings.position_embedding.weight": (16, 24), f"{VISION}post_layernorm.weight": (24,), f"{VISION}post_layernorm.bias": (24,)}
    shapes |= {f"{PALIGEMMA}multi_modal_projector.linear.weight": (40, 24), f"{PALIGEMMA}multi_modal_projector.linear.bias": (40,)}
    shapes[f"{PALIGEMMA}language_model.embed_tokens.weight"] = (50, 40)
    for i in range(2):
        at = f"{VISION}encoder.layers.{i}."
        for part, shape in (("weight", (24, 24)), ("bias", (24,))):
            shapes |= {f"{at}self_attn.{name}_proj.{part}": shape for name in ("q", "k", "v", "out")}
            shapes |= {f"{at}layer_norm{k}.{part}": (24,) for k in (1, 2)}
        shapes |= {f"{at}mlp.fc1.weight": (52, 24), f"{at}mlp.fc1.bias": (52,), f"{at}mlp.fc2.weight": (24, 52), f"{at}mlp.fc2.bias": (24,)}
    for at, d, ff in ((f"{PALIGEMMA}language_model.", 40, 72), (f"{TOWERS}gemma_expert.model.", 32, 48)):
        shapes[at + "norm.weight"] = (d,)
        for i in range(3):
            layer = f"{at}layers.{i}."
            shapes |= {layer + "input_layernorm.weight": (d,), layer + "post_attention_layernorm.weight": (d,)}
            shapes |= {f"{layer}self_attn.{name}_proj.weight": (32 if name == "q" else 8, d) for name in "qkv"}
            shapes |= {layer + "self_attn.o_proj.weight": (d, 32), layer + "mlp.down_proj.weight": (d, ff)}
            shapes |= {f"{layer}mlp.{name}_proj.weight": (ff, d) for name in ("gate", "up")}
    shapes |= {"model.action_in_proj.weight": (32, 8), "model.action_in_proj.bias": (32,)}
    return {name: random.normal(0, 0.3, shape).astype(np.float32) for name, shape in shapes.items()}


def written(folder, arrays):
    """By Orbax, as flax's State: `value` behind every name."""
    tree = {}
    for name, array in arrays.items():
        at = tree
        for key in name.split("/"):
            at = at.setdefault(key, {})
        at["value"] = jnp.asarray(array)
    orbax.checkpoint.PyTreeCheckpointer().save(folder / "params", {"params": tree})


def worst_of_layer(lora, arrays, tensors, which, at, i, random):
    """The largest distance of a product in one layer, of the product's largest number."""
    config = lora.LoRAConfig(rank=RANKS[which], alpha=float(RANKS[which]))
    matrix = {name: np.asarray(list(tensors[f"{at}layers.{i}.{name}.weight"].chunks())[0], np.float64).reshape(tensors[f"{at}layers.{i}.{name}.weight"].shape)
              for name in ("self_attn.q_proj", "self_attn.k_proj", "self_attn.v_proj", "self_attn.o_proj", "mlp.gate_proj", "mlp.up_proj", "mlp.down_proj")}  # fmt: skip
    worst = 0.0

    def compare(found, expected):
        nonlocal worst
        worst = max(worst, float(np.abs(found - expected).max() / np.abs(expected).max()))

    for module, equation in ATTENTION.items():
        name = f"{LLM}layers/attn/{module}{which}/"
        params = {part: jnp.asarray(arrays[name + part][i], jnp.float64) for part in ("w", "lora_a", "lora_b")}
        shape = params["w"].shape
        x = random.normal(0, 1, (1, 5, *shape[:2]) if module == "attn_vec_einsum" else (1, 5, shape[-2]))
        y = np.asarray(lora.Einsum(shape, lora_config=config).apply({"params": params}, equation, jnp.asarray(x)))
        rows = x.reshape(5, -1)
        if module == "kv_einsum":
            compare(rows @ matrix["self_attn.k_proj"].T, y[0].reshape(5, -1))
            compare(rows @ matrix["self_attn.v_proj"].T, y[1].reshape(5, -1))
        else:
            compare(rows @ matrix["self_attn.o_proj" if module == "attn_vec_einsum" else "self_attn.q_proj"].T, y.reshape(5, -1))
    name = f"{LLM}layers/mlp{which}/"
    params = {part: jnp.asarray(arrays[name + part][i], jnp.float64) for part in
              ("gating_einsum", "linear", "gating_einsum_lora_a", "gating_einsum_lora_b", "linear_lora_a", "linear_lora_b")}  # fmt: skip
    _, d, ff = params["gating_einsum"].shape
    x = random.normal(0, 1, (5, d))
    y = np.asarray(lora.FeedForward(d, ff, lora_config=config).apply({"params": params}, jnp.asarray(x)))
    gate = np.asarray(jax.nn.gelu(jnp.asarray(x @ matrix["mlp.gate_proj"].T)))
    compare((gate * (x @ matrix["mlp.up_proj"].T)) @ matrix["mlp.down_proj"].T, y)
    return worst


def main():
    jax.config.update("jax_enable_x64", True)
    lora, random = openpi_lora(sys.argv[1]), np.random.default_rng(3)
    arrays = arrays_of(random_policy(random), DIMS, RANKS, seed=4)
    with tempfile.TemporaryDirectory() as folder:
        written(Path(folder), arrays)
        problems = Problems("policy")
        tensors, _ = jax_layout.read_jax(folder, problems)
        problems.raise_any()
        worst = max(worst_of_layer(lora, arrays, tensors, which, at, i, random)
                    for which, at in (("", PALIGEMMA + "language_model."), ("_1", TOWERS + "gemma_expert.model.")) for i in range(3))  # fmt: skip
    print(f"products of {len(arrays)} arrays, 6 layers: {worst:.1e} at most from openpi's")
    return int(worst > 1e-6)


if __name__ == "__main__":
    sys.exit(main())
