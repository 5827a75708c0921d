# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tests/cli")]

from bundle_keys import bundle_keys  # noqa: E402

from vla_cpp.convert.bundle import BundleWriter, Key, TensorInfo, read_bundle  # noqa: E402


@pytest.fixture(scope="session")
def bundle():
    return ROOT / "models/metaworld-tiny.gguf"


@pytest.fixture(scope="session")
def robots(bundle, tmp_path_factory):
    """The same weights for two robots, whose camera has different names."""
    keys = [Key("embodiments", "string[]", ["left", "right"])]
    for key in bundle_keys(bundle):
        if key.name == "observation.views":
            keys += [Key(f"embodiment.{tag}.{key.name}", key.kind, [f"observation.images.{tag}"]) for tag in ("left", "right")]
        else:
            keys.append(key)
    content = read_bundle(bundle)
    tensors = [TensorInfo(name, data.shape, content.dtypes[name]) for name, data in content.tensors.items()]
    path = tmp_path_factory.mktemp("robots") / "two.gguf"
    with BundleWriter(str(path), keys, tensors) as out:
        for name, data in content.tensors.items():
            out.write(name, data)
    return path


@pytest.fixture(scope="session")
def binary():
    path = Path(os.environ.get("VLA_BINARY", ROOT / "build/cpu/bin/vla"))
    if not path.is_file():
        pytest.fail(f"{path} is not built: run `make build`, or set VLA_BINARY")
    return path
