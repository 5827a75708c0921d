# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Random damage to the files of Evo-1 checkpoints: converted or refused, never a fault of the converter."""

import json

import numpy as np
import pytest

from cli_test import mutate
from tiny_evo1 import TinyEvo1, TinyEvo1Lerobot
from vla_cpp.convert.cli import main

FLAGS = "--variant r2 --views front,wrist --max-views 3 --masked-rows zero_attention".split()
BACKBONE = ["vlm/config.json", "vlm/tokenizer.json", "vlm/tokenizer_config.json"]


@pytest.mark.parametrize(
    "layout, file",
    [
        *((TinyEvo1, file) for file in ("config.json", "norm_stats.json", "dims.json", *BACKBONE)),
        *((TinyEvo1Lerobot, file) for file in ("config.json", "policy_preprocessor.json", "policy_postprocessor.json", *BACKBONE)),
    ],
)
def test_damaged_json_is_converted_or_refused_but_never_a_fault(converter, capsys, layout, file):
    rng = np.random.default_rng(len(file))
    converter.save(layout())
    path = converter.folder / file
    good = json.loads(path.read_text())
    codes = set()
    for _ in range(25):
        path.write_text(json.dumps(mutate(rng, good)))
        flags = FLAGS if layout is TinyEvo1 else []
        codes.add(main([str(converter.folder), "-o", converter.out, "--force", "--quiet", *flags]))
        assert 1 not in codes, (capsys.readouterr().err, path.read_text()[:3000])
    assert codes & {2, 3, 6}
