# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""OpenVLA-OFT: names against the reference's and the runtime's, FiLM with its LoRA, what no file states, statistics, recipes, refusals."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from goldens import openvla, openvla_oft
from goldens.draw import bfloat16
from goldens.openvla import EMPTY, MEANS, STDS, Tower
from goldens.openvla_oft import CASES, STATISTICS, STEP
from goldens.parameters import decoder
from manifests import check_keys, check_parameters
from saved import Saved
from vla_cpp.convert.archs.openvla_oft import mapping
from vla_cpp.convert.errors import Code, Problems

SEED = 6
SMALL = openvla_oft.Checkpoint(Tower(16, 2, 20), Tower(32, 3, 28), decoder(16, 2, 2, 1, 24))
PIXELS = [{"mean": tuple(mean), "std": tuple(std)} for mean, std in zip(MEANS, STDS)]
LIBERO = {"platform": "libero", "views": ["image", "image2"]}
FILE = "{}--" + str(STEP) + "_checkpoint.pt"


def saved(checkpoint=SMALL, **changes):
    return Saved(checkpoint, SEED, **changes)


def sizes_of(checkpoint, **config):
    """Of the config with the shapes of the tensors that the reference has."""
    problems, shapes = Problems("test"), checkpoint.shapes()
    for part, own in checkpoint.parts().items():
        shapes.update({f"{part}.{name}": shape for name, shape in own.items() if part != "vision_backbone"})
    stated = {**checkpoint.config(SEED), **config}
    s = mapping.read_sizes(SimpleNamespace(config=stated, tensors={name: SimpleNamespace(shape=shape) for name, shape in shapes.items()}), problems)
    s.horizon = checkpoint.constants[0]
    problems.raise_any()
    return s


@pytest.fixture(scope="module")
def published():
    """With the text_config of openvla-7b, which leaves all sizes to LlamaConfig."""
    text = {"model_type": "llama", "pad_token_id": 32000, "torch_dtype": "bfloat16", "vocab_size": 32064}
    return sizes_of(openvla_oft.published(), text_config=text)


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(published):
    check_parameters("openvla_oft", mapping.weights(published, PIXELS))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(published):
    check_keys("openvla_oft", mapping.network_keys(published))
    count = sum(int(np.prod(row.stored)) for row in {row.source: row for row in mapping.weights(published, PIXELS)}.values())
    head = 28672 * 4096 + 2 * 4096**2 + 4096 * 7  # and its biases and norms
    assert count == pytest.approx(7.4e9 + head + 4096**2, rel=1e-2)


def values(bundle, name):
    found = bundle.tensors[name]
    return found if found.dtype == np.float32 else (found.astype(np.uint32) << 16).view(np.float32)


def part(checkpoint, file, name):
    return checkpoint.part_value(file, name, checkpoint.parts()[file][name], SEED)


def test_what_was_trained_in_float32_is_rounded_as_the_reference_loads_it(converter):
    bundle = converter.bundle(saved(), dtype="f32", **LIBERO)
    for target, file, name in (("state_in", "proprio_projector", "fc1"), ("head.in", "action_head", "model.fc1"),
                               ("head.blk.1.linear", "action_head", "model.mlp_resnet_blocks.1.ffn.1")):
        w = part(SMALL, file, name + ".weight")
        assert (w != bfloat16(w)).any() and (values(bundle, target + ".weight") == bfloat16(w)).all()


def test_towers_with_film_take_the_place_of_the_others(converter):
    film = replace(SMALL, rank=24)  # alpha is 16
    bundle = converter.bundle(saved(film), dtype="f32", **LIBERO)
    assert bundle.keys["policy.film"] == "scale_shift"
    own = "vision_backbone.fused_featurizer.blocks.1."
    w, a, b = (part(film, "vision_backbone", f"{own}block.mlp.fc1.{name}.weight") for name in ("base_layer", "lora_A.default", "lora_B.default"))
    expected = w.astype(float) + 16 / 24 * bfloat16(b).astype(float) @ bfloat16(a).astype(float)
    assert (values(bundle, "siglip.blk.1.ffn_up.weight") == expected.astype(np.float32)).all()
    assert (values(bundle, "siglip.blk.1.film_scale.bias") == bfloat16(part(film, "vision_backbone", own + "scale.bias")) + np.float32(1)).all()
    assert (values(bundle, "siglip.blk.1.film_shift.weight") == bfloat16(part(film, "vision_backbone", own + "shift.weight"))).all()
    assert not any(".blk.2.film" in name for name in bundle.tensors)
    plain = converter.bundle(saved(film, without=[FILE.format("vision_backbone")]), dtype="f32", **LIBERO)
    name = "vision_backbone.fused_featurizer.blocks.1.mlp.fc1.weight"
    assert (values(plain, "siglip.blk.1.ffn_up.weight") == film.value(name, film.shapes()[name], SEED)).all()
    assert plain.keys["policy.film"] == "none"


def test_a_platform_is_the_constants_of_the_authors(converter):
    keys = converter.bundle(saved(), **LIBERO).keys
    assert (keys["policy.horizon"], keys["policy.d_action"], keys["policy.d_state"]) == (8, 7, 8)
    recipe = json.loads(keys["processor.recipe"])
    assert [op["op"] for op in recipe["image"]] == ["jpeg", "lanczos3", "crop_and_resize", "size"]
    assert [op["op"] for op in recipe["state"]] == ["normalize", "clip", "pad"] and recipe["state"][0]["kind"] == "openpi_quantiles"
    assert [op["op"] for op in recipe["action"]] == ["unnormalize", "affine", "sign"] and recipe["action"][0]["columns"] == [0, 1, 2, 3, 4, 5]
    assert keys["observation.view_aliases"] == ["observation.images.full_image", "observation.images.wrist_image"]
    assert keys["tokenizer.suffix_ids"] == [EMPTY] and keys["policy.stop_token"] == 2 and keys["solver.kind"] == "direct"
    other = converter.bundle(saved(), platform="10,bounds", views=["a", "image"], plain_images=True)
    recipe = json.loads(other.keys["processor.recipe"])
    assert other.keys["policy.horizon"] == 10 and recipe["action"] == [{**recipe["action"][0], "kind": "openvla_bounds"}]
    assert other.keys["observation.view_aliases"] == ["", ""] and recipe["image"][0]["op"] == "lanczos3"
    expected = SMALL.statistics(SEED)[STATISTICS]
    for feature, key in (("observation.state", "proprio"), ("action", "action")):
        for name in ("min", "max"):
            assert other.dtypes[f"stats.{feature}.{name}"] == "f64" and other.tensors[f"stats.{feature}.{name}"].tolist() == expected[key][name]


def test_aloha_sees_what_its_client_makes_of_frames(converter):
    aloha = CASES["openvla_oft/aloha"].checkpoint
    bundle = converter.bundle(saved(aloha), platform="aloha", views=["cam_high", "cam_left_wrist", "cam_right_wrist"], stats=STATISTICS)
    recipe = json.loads(bundle.keys["processor.recipe"])
    assert recipe["image"][1] == {"op": "resize", "width": 256, "height": 256, "filter": "pillow_bicubic"}
    assert bundle.keys["policy.horizon"] == 25 and len(recipe["action"]) == 1 and recipe["action"][0]["columns"] == list(range(14))
    assert bundle.keys["observation.view_aliases"][1] == "observation.images.left_wrist_image"


def test_a_diffusion_head_has_the_schedulers_defaults(converter):
    noisy = replace(SMALL, steps=(50, 10))
    bundle = converter.bundle(saved(noisy), diffusion_steps="50,10", **LIBERO)
    keys = bundle.keys
    assert (keys["solver.kind"], keys["solver.steps"], keys["solver.n_train_step"], keys["solver.noise"]) == ("ddim", 10, 50, "normal")
    assert (keys["solver.beta_schedule"], keys["solver.predicts"], keys["solver.clip"]) == ("squaredcos_cap_v2", "noise", 1.0)
    assert bundle.tensors["noise_in.weight"].shape == (16, 1) and "noise_out.weight" in bundle.tensors


def test_a_policy_without_a_state_reads_none(converter):
    bundle = converter.bundle(saved(replace(SMALL, d_state=0)), **LIBERO)
    assert bundle.keys["policy.d_state"] == 0 and bundle.keys["observation.states"] == [] and "state_in.weight" not in bundle.tensors
    assert json.loads(bundle.keys["processor.recipe"])["state"] == [] and not any("observation.state" in name for name in bundle.tensors)


def test_statistics_are_chosen_by_their_data_set(converter):
    several = saved(replace(SMALL, other_stats=("fractal",)))
    assert "expected one of {}, fractal, found 2".format(STATISTICS) in str(converter.refusal(several, **LIBERO))
    bundle = converter.bundle(stats="fractal", **LIBERO)
    assert bundle.tensors["stats.action.q01"].tolist() == several.checkpoint.statistics(SEED)["fractal"]["action"]["q01"]


@pytest.mark.parametrize(
    "said, part",
    [
        ({"views": ["image"]}, "--platform: expected libero, aloha, bridge, or rows of a chunk and a normalization"),
        ({**LIBERO, "platform": "franka"}, "found franka"),
        ({**LIBERO, "platform": "0,bounds"}, "found 0,bounds"),
        ({**LIBERO, "platform": "8,normal"}, "found 8,normal"),
        ({"platform": "libero"}, "--views image,image2: as many as num_images_in_input"),
        ({**LIBERO, "diffusion_steps": "50,50"}, "expected a diffusion head, found one of L1 regression"),
    ],
)
def test_what_no_file_states_is_asked_for(converter, said, part):
    error = converter.refusal(saved(), **said)
    assert part in str(error) and error.code == Code.USAGE


def test_a_platform_of_another_robot_is_refused(converter):
    error = str(converter.refusal(saved(), platform="aloha", views=["image"]))
    assert "7 numbers of an action" in error and "8 numbers of a state" in error


@pytest.mark.parametrize("stated", ["", "50", "10,50", "50,0", "2000,50"])
def test_steps_of_a_diffusion_head_are_asked_for(converter, stated):
    error = converter.refusal(saved(replace(SMALL, steps=(50, 50))), diffusion_steps=stated, **LIBERO)
    assert "--diffusion-steps: expected TRAIN,INFERENCE" in str(error) and error.code == Code.USAGE


def test_files_of_a_policy_go_together(converter):
    assert "action_head--STEP_checkpoint.pt: expected one such file, found none" in str(converter.refusal(saved(without=[FILE.format("action_head")]), **LIBERO))
    noisy = replace(SMALL, steps=(50, 50))
    missing = converter.refusal(saved(noisy, without=[FILE.format("noisy_action_projector")]), diffusion_steps="50,50", **LIBERO)
    assert "noisy_action_projector--STEP_checkpoint.pt: expected one such file" in str(missing)
    converter.save(saved())
    (converter.folder / FILE.format("proprio_projector")).rename(converter.folder / "proprio_projector--5_checkpoint.pt")
    assert "expected the step of " + FILE.format("action_head") in str(converter.refusal(**LIBERO))


def statistics(**changes):
    return {"dataset_statistics": lambda s: s[STATISTICS]["action"].update(changes)}


REFUSED = [
    ({"config": lambda c: c.update(something="new")}, "config.json: something", Code.UNSUPPORTED),
    ({"config": lambda c: c["text_config"].update(hidden_act="gelu")}, "hidden_act", Code.UNSUPPORTED),
    ({"preprocessor_config": lambda c: c.update(image_resize_strategy="letterbox")}, "image_resize_strategy", Code.UNSUPPORTED),
    ({"tokenizer": lambda c: c.update(normalizer=None)}, "normalizer", Code.UNSUPPORTED),
    (statistics(q99=[1.0] * 6), STATISTICS + ".action.q99", Code.BAD_BUNDLE),
    (statistics(mask=[True] * 6), STATISTICS + ".action.mask", Code.BAD_BUNDLE),
    ({"dataset_statistics": lambda s: s[STATISTICS].pop("proprio")}, STATISTICS + ".proprio.q01", Code.BAD_BUNDLE),
    ({"dataset_statistics": lambda s: s[STATISTICS]["proprio"].update(mask=[False] * 8)}, "proprio.mask", Code.UNSUPPORTED),
]


@pytest.mark.parametrize("changes, part, code", REFUSED, ids=[part for _, part, _ in REFUSED])
def test_what_is_not_understood_is_refused_by_name(converter, changes, part, code):
    error = converter.refusal(saved(**changes), **LIBERO)
    assert part in str(error) and code in {problem.code for problem in error.problems}


def test_an_option_of_another_policy_is_refused(converter):
    assert "OpenVLA-OFT's authors" in str(converter.refusal(openvla_saved(), platform="libero"))


def openvla_saved():
    return saved(openvla.Checkpoint(SMALL.dino, SMALL.siglip, SMALL.text))
