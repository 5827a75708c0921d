# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A folder that `--policy.path` takes, made from a bundle: `lerobot-record` and `lerobot-rollout` want one."""

import argparse
import os
import sys
from pathlib import Path

import vla_cpp
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION

from .configuration_vla_cpp import VlaCppConfig
from .processor_vla_cpp import make_vla_cpp_pre_post_processors


def write(bundle: Path, folder: Path, n_action_steps: int, embodiment: str | None = None) -> VlaCppConfig:
    """Writes config.json and the processors' files; the bundle stays where it is and is named relative to the folder.

    Errors: those of `vla_cpp.Policy`; UsageError for n_action_steps beyond the horizon; FileExistsError
    """
    with vla_cpp.Policy(bundle, embodiment=embodiment) as policy:
        spec = vla_cpp.observation.robot_of(policy.spec, embodiment)
    if not 1 <= n_action_steps <= spec.horizon:
        raise vla_cpp.UsageError("n_action_steps", f"1 to {spec.horizon}", str(n_action_steps))
    config = VlaCppConfig(
        bundle=os.path.relpath(bundle.resolve(), folder.resolve()),
        n_action_steps=n_action_steps,
        embodiment=embodiment,
        device="cpu",
        input_features=_inputs(spec),
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (spec.d_action,))},
    )
    folder.mkdir(parents=True)
    config._save_pretrained(folder)
    for processor in make_vla_cpp_pre_post_processors(config):
        processor.save_pretrained(folder)
    return config


def _inputs(spec: vla_cpp.Spec) -> dict[str, PolicyFeature]:
    views = {view.name: PolicyFeature(FeatureType.VISUAL, (3, view.height, view.width)) for view in spec.views}
    return views | {state.name: PolicyFeature(FeatureType.STATE, (state.width,)) for state in spec.states}


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="vla-lerobot",
        description="Writes the folder that LeRobot's --policy.path takes: config.json and processors that leave numbers alone.",
        epilog="Then: lerobot-rollout --policy.path=FOLDER ..., lerobot-eval --policy.path=FOLDER --env.type=...",
    )
    parser.add_argument("bundle", type=Path, help="the .gguf file that vla-convert made")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="must not exist yet")
    parser.add_argument("--n-action-steps", type=int, required=True, metavar="N", help="rows of a chunk to execute before the next look")
    parser.add_argument("--embodiment", metavar="TAG", help="of a bundle for several robots, the one to drive")
    args = parser.parse_args()
    try:
        config = write(args.bundle, args.output, args.n_action_steps, args.embodiment)
    except (vla_cpp.VlaError, OSError) as e:
        print(f"vla-lerobot: {e}", file=sys.stderr)
        return 1
    print(f"{args.output}: takes {', '.join(config.input_features)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
