# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""GR00T N1.7 as LeRobot saves it, `type: groot`: what the authors' files would say.

LeRobot's class has the network under one attribute. Its sizes are those of the base, the policy that was fine-tuned. Cameras, states,
actions and statistics stand in the steps of the pipelines.
Reference: lerobot policies/groot/modeling_groot.py, processor_groot.py and configuration_groot.py of 0.6.1.
"""

from __future__ import annotations

import os
from typing import Dict, List

from ...checkpoint import Checkpoint
from ...errors import Code, Problems, refuse
from ...files import member, read_json
from ...hub import HUB_FORM
from ...section import Fixed, Section
from .. import Options
from .robot import EMBODIMENTS, PROCESSOR, STATISTICS

ARCH, PREFIX = "gr00t_n1_7", "_groot_model."
CONFIG, PRE, POST = "config.json", "policy_preprocessor.json", "policy_postprocessor.json"
RENAME, PACK, ENCODE, DECODE = (
    "rename_observations_processor",
    "groot_n1_7_pack_inputs_v1",
    "groot_n1_7_vlm_encode_v1",
    "groot_n1_7_action_decode_v1",
)
STEPS = {PRE: [RENAME, "to_batch_processor", PACK, ENCODE, "device_processor"], POST: [DECODE, "device_processor"]}
CONFIG_FIXED: Fixed = {"n_obs_steps": (1, 1), "lora_rank": (0, 0), "use_peft": (False, False)}
# Of training, of this machine and of the hub, and what the steps state once more.
CONFIG_IGNORED = set(
    """type input_features output_features device use_amp push_to_hub repo_id private tags license pretrained_path pretrained_revision
    chunk_size n_action_steps max_state_dim max_action_dim normalization_mapping base_model_path embodiment_tag tune_llm tune_visual
    tune_projector tune_diffusion_model tune_vlln tune_top_llm_layers num_inference_timesteps rtc_ramp_rate use_flash_attention
    use_relative_actions relative_exclude_joints optimizer_lr optimizer_betas optimizer_eps optimizer_weight_decay warmup_ratio use_bf16
    model_params_fp32 image_size tokenizer_assets_repo lora_alpha lora_dropout lora_full_model video_backend balance_dataset_weights
    balance_trajectory_weights dataset_paths output_dir save_steps max_steps batch_size dataloader_num_workers report_to resume
    action_decode_transform rtc_config""".split()
)
PACK_FIXED: Fixed = {"state_horizon": (1, 1), "language_key": ("task", "task"), "normalize_min_max": (True, True)}
PACK_READ = """formalize_language embodiment_tag embodiment_mapping clip_outliers use_percentiles video_modality_keys raw_stats modality_config
    max_state_dim max_action_dim""".split()
# Of training's masks and noise; and how many moments of the cameras there are, which modality_config lists.
PACK_IGNORED = {"action_horizon", "valid_action_horizon", "state_dropout_prob", "video_horizon"}
ENCODE_READ = ("image_crop_size", "image_target_size", "shortest_image_edge", "crop_fraction", "use_albumentations", "letter_box_transform")
DECODE_READ = ("env_action_dim", "raw_stats", "modality_config", "use_percentiles", "use_relative_action", "action_decode_transform")
OTHERS = {  # steps by which other releases and other ways of training are told
    "groot_action_unpack_unnormalize": "its actions are normalized by the data set's statistics as one vector",
    "groot_pack_inputs": "GR00T N1.5 of LeRobot up to 0.5.1",
    "relative_actions_processor": "its actions are made relative outside of GR00T's own statistics",
}


def as_published(checkpoint: Checkpoint, options: Options) -> Options:
    """Makes of LeRobot's checkpoint one of the authors' layout. Returns the options, with the only robot that there is."""
    problems = Problems(checkpoint.name)
    steps = _steps(checkpoint)
    pack, encode, decode = (Section("{}: {}".format(PRE if name != DECODE else POST, name), steps[name], {}, problems) for name in (PACK, ENCODE, DECODE))
    _check(checkpoint.config, steps, pack, encode, decode, problems)
    problems.raise_any()
    tag, robot = pack.get("embodiment_tag"), dict(member(pack.values, "modality_config", dict, pack.where))
    robot["action"] = _cut(member(robot, "action", dict, pack.where), checkpoint.config)
    settings = {name: encode.get(name) for name in ENCODE_READ}
    settings |= {name: pack.get(name) for name in ("formalize_language", "clip_outliers", "use_percentiles", "max_state_dim")}
    settings |= {"use_relative_action": decode.get("use_relative_action"), "modality_configs": {tag: robot}}
    checkpoint.documents = {
        PROCESSOR: {"processor_class": "Gr00tN1d7Processor", "processor_kwargs": settings},
        STATISTICS: {tag: pack.get("raw_stats")},
        EMBODIMENTS: member(pack.values, "embodiment_mapping", dict, pack.where),
    }
    own = {name: checkpoint.config[name] for name in ("num_inference_timesteps", "rtc_ramp_rate") if checkpoint.config.get(name) is not None}
    checkpoint.config, checkpoint.layout = {**_base_config(checkpoint), **own}, ARCH
    checkpoint.tensors = {name[len(PREFIX) :]: entry._replace(name=name[len(PREFIX) :]) for name, entry in checkpoint.tensors.items()}
    checkpoint.aliases = {name[len(PREFIX) :]: other[len(PREFIX) :] for name, other in checkpoint.aliases.items()}
    if options.embodiment not in ("", tag):
        raise refuse("--embodiment", "{}, the only robot of this policy".format(tag), options.embodiment, code=Code.USAGE)
    return options.replaced(embodiment=tag)


def _steps(checkpoint: Checkpoint) -> Dict[str, dict]:
    """The settings of the steps by their names. Errors: unsupported for other steps than those of N1.7."""
    found: Dict[str, dict] = {}
    base = str(checkpoint.config.get("base_model_path"))
    if "n1.5" in base.lower():
        raise refuse("config.json: base_model_path", "GR00T N1.7", base, OTHERS["groot_pack_inputs"], Code.UNSUPPORTED)
    if checkpoint.processors is None:
        raise refuse(checkpoint.path(PRE), "LeRobot's pipelines", "none", "save the policy with its processors", Code.UNSUPPORTED)
    for (file, wanted), pipeline in zip(STEPS.items(), checkpoint.processors):
        steps = [step if isinstance(step, dict) else {} for step in member(pipeline, "steps", list, file)]
        names: List[str] = [str(step.get("registry_name")) for step in steps]
        if names != wanted:
            other = next((why for name, why in OTHERS.items() if any(n.startswith(name) for n in names)), "")
            raise refuse(file + ": steps", ", ".join(wanted), ", ".join(names)[:300], other, Code.UNSUPPORTED)
        found.update({name: member(step, "config", dict, file) for name, step in zip(names, steps)})
    return found


def _check(config: dict, steps: Dict[str, dict], pack: Section, encode: Section, decode: Section, problems: Problems) -> None:
    policy = Section(CONFIG, config, {}, problems)
    policy.refuse_unknown({*CONFIG_FIXED, *CONFIG_IGNORED})
    policy.check_fixed(CONFIG_FIXED)
    pack.refuse_unknown({*PACK_FIXED, *PACK_READ, *PACK_IGNORED})
    pack.check_fixed(PACK_FIXED)
    encode.refuse_unknown({*ENCODE_READ, "model_name", "device"})
    decode.refuse_unknown(DECODE_READ)
    if decode.get("action_decode_transform") is not None:
        hint = "convert the gripper by --gripper-sign from a policy without one"
        decode.bad("action_decode_transform", "None", hint=hint, unsupported=True)
    if steps[RENAME].get("rename_map"):
        problems.unsupported(PRE + ": rename_map", "{}, since cameras are found by the checkpoint's names", str(steps[RENAME]["rename_map"])[:120])
    for name in PACK_READ:
        if pack.get(name) is None:
            pack.bad(name, "a value", hint="the policy was saved without GR00T's own statistics", unsupported=True)
    for name in ("modality_config", "use_percentiles", "raw_stats"):
        if name in decode.values and decode.get(name) is not None and decode.get(name) != pack.get(name):
            decode.bad(name, "the same as of " + PACK, "another")
    robot = pack.get("modality_config")
    video = robot.get("video") if isinstance(robot, dict) else None
    if isinstance(video, dict) and video.get("modality_keys") != pack.get("video_modality_keys"):
        pack.bad("video_modality_keys", "those of modality_config")


def _cut(action: dict, config: dict) -> dict:
    """LeRobot answers no more rows than chunk_size and n_action_steps."""
    steps = action.get("delta_indices")
    limits = [n for n in (config.get("chunk_size"), config.get("n_action_steps")) if type(n) is int and n > 0]
    return {**action, "delta_indices": steps[: min([len(steps), *limits])]} if isinstance(steps, list) else action


def _base_config(checkpoint: Checkpoint) -> dict:
    path = os.path.join(checkpoint.base, CONFIG) if checkpoint.base else ""
    if os.path.isfile(path):
        return read_json(path)
    named = str(checkpoint.config.get("base_model_path"))[:100]
    hint = "--base DIR or {} with the config.json of {}".format(HUB_FORM, named)
    raise refuse(checkpoint.path(CONFIG), "the sizes of the network, which are those of the policy that was fine-tuned", "none", hint, Code.IO)
