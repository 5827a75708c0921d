# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Contracts of public repositories: each converts, or is refused for the reason that its row names. Their chunks are compared with the
references by tests/reference/corpus.py, which needs torch."""

import contracts
import pytest
from vla_cpp.convert import read_bundle


@pytest.mark.parametrize("row", contracts.ROWS, ids=contracts.name_of)
def test_a_public_contract_converts_or_is_refused_for_its_reason(row, tmp_path, capsys):
    if "jax_lora" in row:
        pytest.importorskip("tensorstore")
    _, checkpoint = contracts.write(row, tmp_path)
    code = contracts.convert(row, tmp_path, checkpoint)
    said = " ".join(capsys.readouterr().err.split())
    if "refused" in row:
        assert code != 0 and row["refused"] in said
        return
    assert code == 0, said
    keys = read_bundle(str(tmp_path / "bundle.gguf")).keys
    assert keys["policy.d_action"] >= (row["action"] if "action" in row else len(keys["action.names"]))
    views = [view.removeprefix(contracts.IMAGES) for view in keys["observation.views"]]
    assert {view.removeprefix(contracts.IMAGES) for view in contracts.views_of(row)} <= set(views)


def test_rows_are_told_apart_by_their_names():
    names = [contracts.name_of(row) for row in contracts.ROWS]
    assert len(contracts.ROWS) >= 60 and len({row["source"] for row in contracts.ROWS}) == len(names)
