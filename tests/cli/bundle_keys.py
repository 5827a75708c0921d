# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The keys of a bundle, for tests that write another one like it."""

from typing import List

import gguf

from vla_cpp.convert.bundle import BundleWriter, Key, TensorInfo, read_bundle

KINDS = {4: "u32", 5: "u32", 6: "f32", 7: "bool", 8: "string", 10: "u32", 11: "u32", 12: "f64"}


def bundle_keys(path) -> List[Key]:
    """In the order of the file, without the checksum."""
    return [
        Key(name, KINDS[int(field.types[-1])] + ("[]" if field.types[0] == 9 else ""), field.contents())
        for name, field in gguf.GGUFReader(path).fields.items()
        if not name.startswith("GGUF.") and name != "vla.checksum"
    ]


def rewritten(source, path, values):
    """The bundle under another path with other values of some of its keys."""
    content = read_bundle(str(source))
    keys = [key._replace(value=values.get(key.name, key.value)) for key in bundle_keys(source)]
    tensors = [TensorInfo(name, array.shape, content.dtypes[name]) for name, array in content.tensors.items()]
    with BundleWriter(str(path), keys, tensors) as out:
        for name, array in content.tensors.items():
            out.write(name, array)
    return path
