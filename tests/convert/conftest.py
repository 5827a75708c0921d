# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import json
import os
import shutil
import sys

import pytest

sys.path.insert(0, os.path.dirname(__file__))
pytest.register_assert_rewrite("manifests")
# The package under test is the one beside these tests, installed or not.
ROOT = os.path.join(os.path.dirname(__file__), "..", "..")
sys.path[:0] = [os.path.join(ROOT, name) for name in ("python", "tools", "tests/support")]

from goldens.files import write_json  # noqa: E402
from tiny import Tiny  # noqa: E402
from vla_cpp.convert import ConvertError, Options, convert_checkpoint, read_bundle  # noqa: E402
from vla_cpp.convert.archs import load  # noqa: E402
from vla_cpp.convert.checkpoint import open_checkpoint  # noqa: E402
from vla_cpp.convert.embodiments import plan_robots  # noqa: E402
from vla_cpp.convert.errors import Problems  # noqa: E402


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


# --- an architecture whose test file names it as ARCH, and a small checkpoint of it as SMALL ---------------------------------------------


@pytest.fixture(scope="module")
def folder(request, tmp_path_factory):
    """Where SMALL is saved, once for all tests of the file."""
    path = tmp_path_factory.mktemp(request.module.ARCH)
    request.module.SMALL.write(1, path)
    return path


@pytest.fixture
def planned(request, folder, tmp_path):
    """Plans SMALL with another value at a path of a JSON file, or without some of its files and folders."""

    def plan(file="config.json", path=None, value=None, options=None, without=()):
        policy = tmp_path / "policy"
        shutil.copytree(folder, policy)
        if path is not None:
            write_json(policy / file, put(json.loads((policy / file).read_text()), path, value))
        for gone in (policy / name for name in without):
            shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
        checkpoint, problems = open_checkpoint(str(policy), {}), Problems("test")
        made = plan_robots(load(request.module.ARCH), checkpoint, options or Options(), problems)
        problems.raise_any()
        return {key.name: key.value for key in made.keys}, made

    return plan


def put(content, path, value):
    """Of JSON. path: keys, and indices of lists, with / between them."""
    place = content
    *parents, last = path.split("/")
    for parent in parents:
        place = place[int(parent) if isinstance(place, list) else parent]
    place[int(last) if isinstance(place, list) else last] = value
    return content


@pytest.fixture
def refusal(planned):
    """The error of a plan that must not succeed."""

    def text(*args, **kwargs):
        with pytest.raises(ConvertError) as caught:
            planned(*args, **kwargs)
        return str(caught.value)

    return text
