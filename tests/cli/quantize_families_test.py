# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""`vla quantize` on a small policy of every family.  The golden cases have no matrix that is large enough to become codes, so that
theirs are widened here."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from golden_cases import ROOT, Golden, tensors
from program import every_third_if_sanitized
from vla_cpp.convert.bundle import read_bundle

sys.path.append(str(ROOT / "tools"))
from goldens import act, all_cases, bitvla, cases, evo1, families, gr00t, gr00t_n1_5, gr00t_n1_6, gr00t_n1_7  # noqa: E402
from goldens import openvla, pi, smolvla, turbovla, turbovla_authors, vla_adapter, vla_jepa, xvla  # noqa: E402

D, FF = 192, 272  # widths, of whole blocks of int4 and not; heads have 64 elements
FEW_ROWS = 144  # matrices from or to fewer elements stay as they are
TABLES = ("lm.token_embd.weight", "time.weight", "action_position.weight")
SECTIONS = (16, 8, 8)  # of a head's rotation
GEMMA = pi.gemma(D, 3, 3, 1, 64, FF)
PI = {"vision": pi.tower(D, 2, 3, FF), "lm": GEMMA, "expert": GEMMA}
WIDE = {
    "act/two_views": {"policy": act.policy(9, D, 3, FF, (2, 1, 1))},
    "bitvla/micro": {"vision": bitvla.sizes(D, FF, 1, 3, image_size=28), "text": bitvla.sizes(D, FF, 1, 3, num_key_value_heads=1)},
    "diffusion/environment": {"policy": all_cases()["diffusion/environment"].checkpoint.policy | {"down_dims": [D]}},
    "evo1/two_views": {"vision": evo1.tower(D, 2, 3, FF), "text": evo1.decoder(D, 3, 3, 1, FF), "head": evo1.head(2, 3, D, D)},
    "gr00t_n1_5/libero": {"vision": gr00t_n1_5.vision(D, 3, 3, FF, 28), "text": gr00t_n1_5.text(D, 5, 3, 1, 64, FF),
                          "head": gr00t.head(3, (6, 3, 64), (2, 3, 64), D, 14, 11, 6)},
    "gr00t_n1_6/libero": {"vision": gr00t_n1_6.vision(D, 3, 3, FF, 5), "text": gr00t_n1_6.text(D, 5, 3, 1, 64, FF),
                          "head": gr00t.head(3, (6, 3, 64), None, D, 14, 11, 7)},
    "gr00t_n1_7/libero": {"vision": gr00t_n1_7.vision(D, 5, 3, FF, 5, (0, 2, 3)), "text": gr00t_n1_7.text(D, 6, 3, 1, 64, FF, SECTIONS),
                          "head": gr00t.head(4, (6, 3, 64), (2, 3, 64), D, 14, 11, 8)},
    "groot/n1_5": {"base": replace(all_cases()["groot/n1_5"].checkpoint.base, vision=gr00t_n1_5.vision(D, 3, 3, FF, 28),
                                   text=gr00t_n1_5.text(D, 5, 3, 1, 64, FF), head=gr00t.head(3, (6, 3, 64), (2, 3, 64), D, 14, 11, 6))},
    "openvla/bridge": {"dino": openvla.Tower(D, 2, FF), "siglip": openvla.Tower(D, 2, FF), "text": openvla.decoder(D, 2, 3, 1, FF)},
    "openvla_oft/libero": {"dino": openvla.Tower(D, 2, FF), "siglip": openvla.Tower(D, 2, FF), "text": openvla.decoder(D, 3, 3, 1, FF)},
    "pi0/two_views": PI,
    "pi05/two_views": PI,
    "pi0_fast/two_views": {"vision": pi.tower(D, 2, 3, FF), "lm": GEMMA, "rows": {}},
    "smolvla/two_views": {"vision": smolvla.vision(D, 2, 3, FF, 32, 8), "text": smolvla.text(D, 4, 3, 1, 64, FF)},
    "turbovla/two_views": {"vision": turbovla.vision(D, 3, 3, FF, 8, 4), "text": turbovla.text(D, 2, 3, FF), "policy": turbovla.policy(6, D, 3, FF, (2, 2), 24)},
    "turbovla_authors/two_views": {
        "vision": turbovla.vision(D, 3, 3, FF, 8, 4), "text": turbovla.text(D, 2, 3, FF),
        "parts": turbovla_authors.parts(24, (D, 3, 2, FF, D), (6, 2, 3, D, D), {"padding_length": 28})},
    "vla_adapter/one_view": {"dino": vla_adapter.Tower(D, 2, FF), "siglip": vla_adapter.Tower(D, 2, FF), "text": vla_adapter.decoder(D, 2, 3, 1, FF)},
    "vla_jepa/libero": {"vision": vla_jepa.vision(D, 4, 3, FF, 5, (0, 2, 3)), "text": vla_jepa.text(D, 5, 3, 1, 64, FF, SECTIONS),
                        "policy": vla_jepa.policy(5, 4, (3, 64), 3, D, 6, resize_images_to=[20, 20])},
    "xvla/two_views": {"vision": xvla.vision((48, 96, D), (1, 2, 1), (3, 3, 3), (3, 3, 3), 3, D), "text": xvla.text(D, 2, 3, FF),
                       "policy": all_cases()["xvla/two_views"].checkpoint.policy | {"hidden_size": D}},
}


def test_every_family_is_here():
    assert {name.split("/")[0] for name in WIDE} == set(families())


@pytest.fixture(scope="module", params=every_third_if_sanitized(WIDE))
def wide(request, tmp_path_factory):
    case = all_cases()[request.param]
    case = replace(case, checkpoint=replace(case.checkpoint, **WIDE[request.param]))
    folder = tmp_path_factory.mktemp("wide") / request.param
    cases.write_checkpoint(case, folder)
    cases.write_observation(case, folder)
    cases.write_bundle(folder)
    return Golden(str(folder))


def distance(got, expected):
    return np.sqrt(np.mean((got - expected) ** 2) / np.mean(expected**2))


@pytest.mark.parametrize("dtype, bound", [("int8", 0.05), ("int4", 0.5)])
def test_codes_of_a_family_act_as_its_floats_rounded_at_load_and_near_them(vla, wide, tmp_path, dtype, bound):
    tap = "logits" if read_bundle(str(wide.bundle)).keys["solver.kind"] == "greedy" else "chunk"  # a token is another one or the same

    def chunk(bundle, *options):
        answer = vla(*wide.arguments(bundle, options=("--tap", tap, "--taps-out", tmp_path / "taps.gguf", *options)))
        assert answer.code == 0, answer.err
        return tensors(tmp_path / "taps.gguf")[tap]

    codes = tmp_path / "codes.gguf"
    answer = vla("quantize", wide.bundle, "-o", codes, "--dtype", dtype)
    assert answer.code == 0, answer.err
    of_codes, widened = chunk(codes), chunk(codes, "--kernels", "float32")
    assert np.array_equal(of_codes, chunk(wide.bundle, "--kernels", dtype))
    assert 0 < distance(of_codes, widened) < 0.05  # activations alone
    assert 0 < distance(widened, chunk(wide.bundle, "--kernels", "float32")) < bound  # weights alone


def test_all_large_matrices_of_floats_become_codes_and_nothing_else(vla, wide, tmp_path):
    assert vla("quantize", wide.bundle, "-o", tmp_path / "codes.gguf").code == 0
    before, after = read_bundle(str(wide.bundle)), read_bundle(str(tmp_path / "codes.gguf"))
    for name, values in before.tensors.items():
        is_large = before.dtypes[name] in ("bf16", "f32") and values.ndim == 2 and min(values.shape) >= FEW_ROWS and name not in TABLES
        assert (after.dtypes[name] != before.dtypes[name]) == is_large, name
        assert is_large or np.array_equal(after.tensors[name], values), name
