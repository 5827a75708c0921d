# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import os
import sys

import pytest

sys.path.insert(0, os.path.dirname(__file__))
pytest.register_assert_rewrite("manifests")
# The package under test is the one beside these tests, installed or not.
ROOT = os.path.join(os.path.dirname(__file__), "..", "..")
sys.path[:0] = [os.path.join(ROOT, "python"), os.path.join(ROOT, "tools")]

from tiny import Tiny  # noqa: E402
from vla_cpp.convert import ConvertError, Options, convert_checkpoint, read_bundle  # noqa: E402


class Converter:
    """Saves a checkpoint, converts it, reads the bundle back."""

    def __init__(self, folder):
        self.folder, self.out = folder / "policy", str(folder / "out.gguf")

    def save(self, tiny, **how):
        return tiny.save(self.folder, **how)

    def bundle(self, tiny=None, **options):
        how = {"shards": options.pop("shards")} if "shards" in options else {}
        if tiny is not None:
            self.save(tiny, **how)
        self.summary = convert_checkpoint(str(self.folder), self.out, Options(**options), force=True)
        return read_bundle(self.out)

    def refusal(self, tiny=None, **options):
        """The error of a conversion that must not succeed and must leave no file."""
        if tiny is not None:
            self.save(tiny)
        with pytest.raises(ConvertError) as info:
            convert_checkpoint(str(self.folder), self.out, Options(**options))
        assert [name for name in os.listdir(os.path.dirname(self.out)) if name.startswith("out.gguf")] == []
        return info.value


@pytest.fixture
def converter(tmp_path):
    return Converter(tmp_path)


@pytest.fixture
def tiny():
    return Tiny()
