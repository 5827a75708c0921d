# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The plug-in beside LeRobot's own policy of the same checkpoint, on the same observations and the same seed of torch.

    pip install -e python -e plugins/lerobot && pytest plugins/lerobot/tests

Skips by name where torch or LeRobot is missing; checkpoints and bundles are the golden cases of build/goldens.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tools"), str(ROOT / "plugins/lerobot")]
torch = pytest.importorskip("torch", reason="torch is not installed")

import vla_cpp  # noqa: E402

try:
    from goldens import evo1, pi, smolvla
    from goldens.build import make
    from goldens.recorder import open_reference

    open_reference()
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
    from lerobot.policies.rtc.configuration_rtc import RTCConfig
    from lerobot.rollout.inference.rtc import _normalize_prev_actions_length, supports_rtc_inference
    from lerobot.utils.import_utils import register_third_party_plugins
except (ImportError, SystemExit) as e:
    pytest.skip(f"LeRobot is not installed: {e}", allow_module_level=True)

register_third_party_plugins()
CASES = {
    "smolvla/two_views": smolvla.load,
    "smolvla/one_view": smolvla.load,
    "pi0/two_views": pi.load,
    "pi05/two_views": pi.load,
    "evo1/lerobot": evo1.load_lerobot,
}
GUIDED = [name for name in CASES if not name.startswith("evo1")]
TOLERANCE = 1e-4  # in the robot's units


@pytest.fixture(scope="session")
def goldens():
    return make()


class Pair:
    """LeRobot's policy and ours of one golden case, each with its processors."""

    def __init__(self, goldens, name, n_action_steps=3):
        self.bundle = goldens / name / "bundle.gguf"
        policy, before, after = CASES[name](goldens / name / "checkpoint")
        policy.config.n_action_steps = n_action_steps
        self.config = make_policy_config("vla_cpp", bundle=str(self.bundle), n_action_steps=n_action_steps, device="cpu")
        ours = get_policy_class("vla_cpp")(self.config)
        self.features = policy.config.input_features
        self.sides = [(policy, before, after), (ours, *make_pre_post_processors(self.config))]
        for side, _, _ in self.sides:
            side.reset()

    def observation(self, random):
        batch = {"task": ["open the drawer"]}
        for name, feature in self.features.items():
            if feature.type.value == "VISUAL" and "empty_camera" not in name:
                frame = random.integers(0, 256, (1, *feature.shape), dtype=np.uint8)
                batch[name] = torch.from_numpy(frame).float() / 255
            elif feature.type.value == "STATE":
                batch[name] = torch.from_numpy(random.standard_normal((1, *feature.shape)).astype(np.float32))
        return batch

    def both(self, run):
        """What `run(policy, before, after, observations)` gives on either side from the same seeds."""
        results = []
        for side in self.sides:
            torch.manual_seed(5)
            random = np.random.default_rng(0)
            results.append(run(*side, lambda: self.observation(random)))
        return results


@pytest.mark.parametrize("name", CASES)
def test_select_action_gives_the_numbers_of_lerobot(goldens, name):
    pair = Pair(goldens, name)
    theirs, ours = pair.both(lambda policy, before, after, see: torch.stack([after(policy.select_action(before(see()))) for _ in range(7)]))
    assert theirs.shape == ours.shape and theirs.dtype == ours.dtype
    assert (theirs - ours).abs().max() < TOLERANCE


@pytest.mark.parametrize("name", GUIDED)
def test_real_time_chunking_gives_the_numbers_of_lerobot(goldens, name):
    pair = Pair(goldens, name)
    for policy, _, _ in pair.sides:
        policy.config.rtc_config = RTCConfig(execution_horizon=4)
        if hasattr(policy, "init_rtc_processor"):
            policy.init_rtc_processor()
    assert supports_rtc_inference(pair.sides[1][0])

    def run(policy, before, after, see):
        rows, previous = [], None
        for _ in range(4):  # the leftover is shorter than the execution horizon: padded with zeros, as lerobot-rollout does
            chunk = policy.predict_action_chunk(before(see()), inference_delay=1, prev_chunk_left_over=previous)
            previous = _normalize_prev_actions_length(chunk.squeeze(0)[2:], 4)
            rows.append(after(chunk.clone()).squeeze(0))
        return torch.stack(rows)

    theirs, ours = pair.both(run)
    assert (theirs - ours).abs().max() < TOLERANCE
    assert (theirs[1:] - theirs[:-1]).abs().max() > 100 * TOLERANCE


def test_a_folder_is_loaded_as_lerobot_loads_a_checkpoint(goldens, tmp_path):
    from lerobot_policy_vla_cpp.folder import write

    pair = Pair(goldens, "smolvla/two_views")
    write(pair.bundle, tmp_path / "policy", 3)
    config = PreTrainedConfig.from_pretrained(tmp_path / "policy")
    config.pretrained_path = tmp_path / "policy"
    policy = get_policy_class(config.type).from_pretrained(config.pretrained_path, config=config)
    overrides = {"rename_observations_processor": {"rename_map": {"observation.images.top": "observation.images.camera1"}}}
    before, after = make_pre_post_processors(config, pretrained_path=str(tmp_path / "policy"), preprocessor_overrides=overrides)
    views = [name for name in pair.features if "camera1" in name]
    batch = pair.observation(np.random.default_rng(0))
    renamed = {("observation.images.top" if key in views else key): value for key, value in batch.items()}
    torch.manual_seed(1)
    first = after(policy.select_action(before(renamed)))
    torch.manual_seed(1)
    assert torch.equal(first, pair.sides[1][0].select_action(batch))


def test_a_batch_is_acted_on_row_by_row(goldens):
    pair = Pair(goldens, "smolvla/two_views")
    policy = pair.sides[1][0]
    rows = [pair.observation(np.random.default_rng(i)) for i in range(2)]
    batch = {key: torch.cat([row[key] for row in rows]) if key != "task" else ["open the drawer"] * 2 for key in rows[0]}
    noise = torch.randn(2, policy.spec.noise_rows, policy.spec.d_noise)
    together = policy.predict_action_chunk(batch, noise)
    assert torch.equal(together, torch.cat([policy.predict_action_chunk(row, noise[i : i + 1]) for i, row in enumerate(rows)]))


def test_what_the_bundle_does_not_take_is_refused_with_both_lists(goldens):
    pair = Pair(goldens, "smolvla/two_views")
    policy = pair.sides[1][0]
    batch = pair.observation(np.random.default_rng(0))
    with pytest.raises(vla_cpp.BadObservation, match=r"observation.images.top.*one of .*camera1.*the batch has .*top.*rename_map"):
        policy.select_action(batch | {"observation.images.top": batch["observation.images.camera1"]})
    policy.config.ignore = ["observation.images.top"]
    policy.select_action(batch | {"observation.images.top": batch["observation.images.camera1"]})
    policy.reset()
    with pytest.raises(vla_cpp.BadObservation, match="divided by 255"):
        policy.select_action(batch | {"observation.images.camera1": batch["observation.images.camera1"] * 0.999})


def test_rows_of_another_chunk_are_refused(goldens):
    pair = Pair(goldens, "smolvla/two_views")
    policy = pair.sides[1][0]
    policy.config.rtc_config = RTCConfig()
    batch = pair.observation(np.random.default_rng(0))
    chunk = policy.predict_action_chunk(batch)
    with pytest.raises(vla_cpp.BadObservation, match="rows of the chunk that this policy returned last"):
        policy.predict_action_chunk(batch, inference_delay=1, prev_chunk_left_over=chunk.squeeze(0) + 1)


@pytest.mark.parametrize("steps", [None, 0, 1000])
def test_the_replan_interval_has_no_default(goldens, steps):
    config = make_policy_config("vla_cpp", bundle=str(goldens / "smolvla/two_views/bundle.gguf"), n_action_steps=steps, device="cpu")
    with pytest.raises(vla_cpp.UsageError, match="policy.n_action_steps: expected 1 to"):
        get_policy_class("vla_cpp")(config)
