# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The mappings of pi0, pi0.5 and pi0-FAST at the published size, against what the runtime declares."""

import pytest

from manifests import check_keys, check_parameters
from vla_cpp.convert.archs import pi0, pi0_fast, pi05
from vla_cpp.convert.archs.pi0 import mapping
from vla_cpp.convert.archs.pi0.mapping import network_keys, read_paligemma, read_towers
from vla_cpp.convert.checkpoint import Checkpoint
from vla_cpp.convert.errors import Problems
from vla_cpp.convert.section import Section

CONFIG = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}  # what configurations say of sizes


@pytest.fixture(params=[pi0, pi05], ids=["pi0", "pi05"])
def family(request):
    return request.param.FAMILY


@pytest.fixture
def sizes(family, tmp_path):
    problems = Problems("published")
    checkpoint = Checkpoint("published", str(tmp_path), "", {}, {}, {}, {}, None)
    sizes = read_towers(Section("config.json", CONFIG, {}, problems), checkpoint, problems)
    problems.raise_any()
    sizes.vision.image_size, sizes.horizon, sizes.n_step = 224, 50, 10
    sizes.d_state, sizes.d_action = (32 if family.state_token else 0), 32
    sizes.min_period, sizes.max_period = 4e-3, 4.0
    return sizes


def test_names_shapes_and_storage_are_those_that_the_runtime_declares(family, sizes, tmp_path):
    checkpoint = Checkpoint("published", str(tmp_path), "", {}, {}, {}, {}, None)
    check_parameters(family.arch, mapping.weights(family, sizes, checkpoint))


def test_sizes_at_the_published_config_are_those_of_the_runtimes_manifest(family, sizes):
    check_keys(family.arch, network_keys(sizes))


def test_names_and_sizes_of_pi0_fast_are_those_that_the_runtime_declares(tmp_path):
    problems, checkpoint = Problems("published"), Checkpoint("published", str(tmp_path), "", {}, {}, {}, {}, None)
    sizes = read_paligemma(Section("config.json", CONFIG, {}, problems), checkpoint, problems)
    problems.raise_any()
    sizes.vision.image_size, sizes.horizon, sizes.n_step, sizes.d_action = 224, 50, 256, 32
    check_parameters("pi0_fast", pi0_fast.weights(sizes, checkpoint))
    check_keys("pi0_fast", pi0_fast.network_keys(sizes), chosen=["solver.stop_token"])
