# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Files of torch.save, read without torch and without executing what they ask for."""

import re
import struct
import time
import zipfile

import numpy as np
import pytest

from goldens import files
from goldens.files import Call, Name, Persistent, Raw, bfloat16_bits, pickled, state_dict, tensor, write_archive, write_torch
from vla_cpp.convert import ConvertError
from vla_cpp.convert.errors import Code
from vla_cpp.convert.pickle_values import MAX_BYTES, MAX_STEPS
from vla_cpp.convert.safetensors_file import MAX_TENSORS
from vla_cpp.convert.torch_file import read_torch

GOOD = {"x": np.arange(6, dtype="<f4").reshape(2, 3), "y": bfloat16_bits([1.5, -2.0]), "z": np.ones(3, "<f2")}


def numbers(entry):
    return np.concatenate(list(entry.chunks(8))).reshape(entry.shape)


def refusal(path, member="module"):
    with pytest.raises(ConvertError) as info:
        read_torch(path, member)
    assert info.value.code == Code.BAD_BUNDLE
    return info.value.message()


def of_pickle(tmp_path, data):
    return write_archive(tmp_path / "f", data, {"0": bytes(24)})


def test_tensors_are_read_back_from_the_member_that_is_asked_for(tmp_path):
    path = write_torch(tmp_path / "f", GOOD, "model_state_dict", module={})
    entries = read_torch(path, "model_state_dict")
    assert {name: entry.dtype for name, entry in entries.items()} == {"x": "F32", "y": "BF16", "z": "F16"}
    for name, array in GOOD.items():
        np.testing.assert_array_equal(numbers(entries[name]), array)


def test_tensors_that_share_a_storage_start_where_they_say(tmp_path):
    values = {"a": tensor("0", (2, 2), n_element=6), "b": tensor("0", (2,), first=4, n_element=6)}
    entries = read_torch(write_archive(tmp_path / "f", {"module": values}, {"0": np.arange(6, dtype="<f4").tobytes()}), "module")
    assert numbers(entries["a"]).tolist() == [[0, 1], [2, 3]] and numbers(entries["b"]).tolist() == [4, 5]


def test_a_stride_of_a_dimension_of_one_does_not_count(tmp_path):
    values = {"a": tensor("0", (1, 3), stride=(99, 1))}
    assert numbers(read_torch(write_archive(tmp_path / "f", {"module": values}, {"0": bytes(12)}), "module")["a"]).shape == (1, 3)


def test_parameters_are_their_data(tmp_path):
    value = Call("torch._utils _rebuild_parameter", tensor("0", (2,)), True, Call("collections OrderedDict"))
    assert read_torch(write_archive(tmp_path / "f", {"module": {"p": value}}, {"0": bytes(8)}), "module")["p"].shape == (2,)


def test_a_state_dictionary_may_be_an_ordered_one_with_attributes(tmp_path):
    pairs = [("a", tensor("0", (2,)))]
    built = Raw(files.emit(Call("collections OrderedDict", pairs)) + files.emit({"_metadata": {"": {"version": 1}}}) + b"b")
    assert set(read_torch(write_archive(tmp_path / "f", {"module": built}, {"0": bytes(8)}), "module")) == {"a"}


def test_what_lies_beside_the_tensors_is_not_executed(tmp_path):
    values, data = state_dict(GOOD)
    namespace = Raw(files.emit(Name("argparse Namespace")) + b")\x81" + files.emit({"lr": 1e-5}) + b"b")
    scalar = Call("numpy.core.multiarray scalar", Call("numpy dtype", "f8", False, True), Raw(b"U\x08" + bytes(8)))
    others = {
        "ds_config": {("tuple", "key"): 1, "args": namespace},
        "loss": scalar,
        "shape": Call("torch Size", (1, 2)),
        "dtype": Name("torch bfloat16"),
        "set": Raw(b"\x8f(K\x01\x90"),
        "command": Call("posix system", "touch " + str(tmp_path / "executed")),
        "evaluated": Call("builtins eval", "open({!r}, 'w')".format(str(tmp_path / "executed"))),
        "storage of another kind": Persistent("storage", Name("torch QInt8Storage"), "9", "cpu", 3),
        "another id": Persistent("file", "x"),
    }
    path = write_archive(tmp_path / "f", {**others, "module": values}, data)
    assert set(read_torch(path, "module")) == set(GOOD)
    assert not (tmp_path / "executed").exists()


def test_another_call_under_the_needed_part_is_refused_with_its_name(tmp_path):
    value = Call("posix system", "touch " + str(tmp_path / "executed"))
    text = refusal(write_archive(tmp_path / "f", {"module": {"w": value}}, {}))
    assert "tensor w: expected a tensor, found posix.system" in text
    assert not (tmp_path / "executed").exists()


REFUSED = {
    "expected rows one after another, found strides \\(1, 2\\)": dict(value=tensor("0", (2, 3), stride=(1, 2))),
    "expected 24 bytes in data/1, found no such entry": dict(value=tensor("1", (2, 3))),
    "expected 28 bytes in data/0, found 24 bytes": dict(value=tensor("0", (7,))),
    "expected at most 6 elements, found 6 from 1 on": dict(value=tensor("0", (6,), first=1, n_element=6)),
    "expected a storage of .*, found torch.QUInt8Storage": dict(value=tensor("0", (6,), "QUInt8Storage")),
    "expected a tensor, found dict": dict(value={}),
    "expected a tensor, found torch.bfloat16": dict(value=Name("torch bfloat16")),
    "found a tensor without storage, offset": dict(value=Call("torch._utils _rebuild_tensor_v2", 1, 2)),
    "found a tensor without a storage": dict(value=Call("torch._utils _rebuild_tensor_v2", 1, 0, (1,), (1,))),
    "found a tensor without storage, offset, size": dict(value=tensor("0", (2,), first=-1, n_element=6)),
    "with a stride of another rank": dict(value=tensor("0", (2, 3), stride=(1,))),
    "found a parameter without data": dict(value=Call("torch._utils _rebuild_parameter")),
    "found an OrderedDict of something else": dict(value=Call("collections OrderedDict", 7)),
    "found a storage without key and size": dict(value=Persistent("storage", Name("torch FloatStorage"), 0, "cpu", 6)),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_tensor_that_is_not_a_run_of_the_file_is_refused(tmp_path, message):
    text = refusal(write_archive(tmp_path / "f", {"module": {"w": REFUSED[message]["value"]}}, {"0": bytes(24)}))
    assert re.search(message, text), text


HOSTILE = {
    "found no end": pickled({"module": {}})[:-1],
    "found a stack or a memo that lacks a value": b"\x80\x02.",
    "found a stack or a memo that lacks a value ": b"h\x07.",
    "found a stack or a memo that lacks a value  ": b"t.",
    "found the opcode INST": b"(iposix\nsystem\n.",
    "found the opcode INT": b"I" + b"9" * 100000 + b"\n.",
    "found the opcode NEXT_BUFFER": b"\x97.",
    "found expected 4611686018427387904 bytes in a bytearray8": b"\x96" + struct.pack("<Q", 1 << 62) + b".",
    "found the opcode b'\\xff'": b"\xff.",
    "found expected 4611686018427387904 bytes in a unicodestring8": b"\x8d" + struct.pack("<Q", 1 << 62) + b"x.",
    "found a value where another kind": b"(\x85.",
    "found a value where another kind ": b"K\x01K\x02R.",
    "found items for what is no list": b"K\x01(K\x02e.",
    "found items for what is no dictionary": b"K\x01(K\x02K\x03u.",
    "found a key without a value": b"}(K\x02u.",
    "found more than {} steps".format(MAX_STEPS): b"N0" * (MAX_STEPS // 2) + b"N.",
    "expected a dictionary with the tensors under module, found int": b"K\x01.",
    "expected a dictionary with the tensors under module, found dict": pickled({"module": {}}),
    "expected a dictionary with the tensors under module, found os.environ": pickled({"module": Name("os environ")}),
    "expected names of tensors, found int": pickled({"module": {1: 2}}),
}


@pytest.mark.parametrize("message", HOSTILE)
def test_a_hostile_pickle_is_refused(tmp_path, message):
    text = refusal(of_pickle(tmp_path, HOSTILE[message]))
    assert message.strip() in text


def test_a_huge_index_of_the_memo_takes_one_place(tmp_path):
    data = b"\x80\x02}r\xff\xff\xff\xff(" + files.emit("module") + files.emit({"w": tensor("0", (6,))}) + b"u."
    assert set(read_torch(of_pickle(tmp_path, data), "module")) == {"w"}


def test_nesting_without_end_is_refused_and_does_not_exhaust_the_stack(tmp_path):
    assert "found tuple" in refusal(of_pickle(tmp_path, b")" + b"\x85" * 300_000 + b"."))
    assert "found list" in refusal(of_pickle(tmp_path, b"]" * 300_000 + b"a" * 299_999 + b"."))
    deep_key = b"}" + b")" + b"\x85" * 300_000 + b"K\x01s."
    assert "found dict" in refusal(of_pickle(tmp_path, deep_key))


def test_keys_that_hash_alike_take_no_quadratic_time(tmp_path):
    keys = b"".join(b"\x8a\x0a" + ((2**61 - 1) * i).to_bytes(10, "little") + b"N" for i in range(1, 40_001))
    before = time.process_time()
    assert "found dict" in refusal(of_pickle(tmp_path, b"\x80\x02}(" + keys + b"u."))
    pairs = b"".join(b"\x8a\x0a" + ((2**61 - 1) * i).to_bytes(10, "little") + b"N\x86" for i in range(1, 40_001))
    ordered = files.emit(Name("collections OrderedDict")) + b"](" + pairs + b"e\x85R."
    assert "found dict" in refusal(of_pickle(tmp_path, b"\x80\x02" + ordered))
    assert time.process_time() - before < 5


def test_more_tensors_than_any_policy_has_are_refused_before_they_are_looked_at(tmp_path):
    names = b"".join(files.emit("t{}".format(i)) + b"N" for i in range(MAX_TENSORS + 1))
    data = b"\x80\x02}" + files.emit("module") + b"}(" + names + b"us."
    assert "expected at most {} tensors, found {}".format(MAX_TENSORS, MAX_TENSORS + 1) in refusal(of_pickle(tmp_path, data))


def test_a_compressed_entry_is_refused(tmp_path):
    values, data = state_dict(GOOD)
    path = write_archive(tmp_path / "f", {"module": values}, data, compression=zipfile.ZIP_DEFLATED)
    assert "expected an entry that is stored as it is, found a compressed" in refusal(path)


def test_numbers_of_the_other_byte_order_are_refused(tmp_path):
    values, data = state_dict(GOOD)
    assert "byteorder: expected little" in refusal(write_archive(tmp_path / "f", {"module": values}, data, byteorder=b"big"))


def test_an_archive_without_one_pickle_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "f", "w") as archive:
        archive.writestr("a/data.pkl", pickled({}))
        archive.writestr("b/data.pkl", pickled({}))
    assert "found 2 of them" in refusal(str(tmp_path / "f"))


def test_two_entries_of_one_name_are_refused(tmp_path):
    with pytest.warns(UserWarning), zipfile.ZipFile(tmp_path / "f", "w") as archive:
        archive.writestr("a/data.pkl", pickled({}))
        archive.writestr("a/data.pkl", pickled({}))
    assert "expected one entry of this name, found two" in refusal(str(tmp_path / "f"))


def test_a_pickle_above_the_limit_is_refused_without_reading_it(tmp_path):
    assert "expected at most {} bytes".format(MAX_BYTES) in refusal(of_pickle(tmp_path, bytes(MAX_BYTES + 1)))


@pytest.mark.parametrize("cut", [1, 30, 200, 600])
def test_a_truncated_archive_is_refused(tmp_path, cut):
    data = open(write_torch(tmp_path / "f", GOOD), "rb").read()
    (tmp_path / "g").write_bytes(data[:-cut])
    assert "truncated" in refusal(str(tmp_path / "g"))


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "f").write_bytes(b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.")  # how torch.save began before 1.6
    assert "before 1.6" in refusal(str(tmp_path / "f"))


def directory_field(data, offset, kind, value):
    """Overwrites a field in every record of the archive's directory."""
    data, at = bytearray(data), 0
    while True:
        at = data.find(b"PK\1\2", at)
        if at < 0:
            return bytes(data)
        struct.pack_into(kind, data, at + offset, value)
        at += 4


LIES = {
    "expected data up to byte": lambda data: directory_field(directory_field(data, 20, "<I", 1 << 30), 24, "<I", 1 << 30),
    "expected an entry that is stored": lambda data: directory_field(data, 24, "<I", 1 << 30),
    "expected bytes of its own": lambda data: directory_field(data, 42, "<I", 0),
    "expected a header at byte 1": lambda data: directory_field(data, 42, "<I", 1),
}


@pytest.mark.parametrize("message", LIES)
def test_an_archive_whose_directory_lies_is_refused(tmp_path, message):
    data = open(write_torch(tmp_path / "f", GOOD), "rb").read()
    (tmp_path / "g").write_bytes(LIES[message](data))
    assert message in refusal(str(tmp_path / "g"))


def test_random_damage_never_escapes_as_another_exception(tmp_path):
    rng = np.random.default_rng(3)
    data = open(write_torch(tmp_path / "f", GOOD), "rb").read()
    refused = 0
    for _ in range(600):
        broken = bytearray(data)
        for position in rng.integers(0, len(data), rng.integers(1, 4)):
            broken[position] = rng.integers(0, 256)
        (tmp_path / "g").write_bytes(bytes(broken))
        try:
            for entry in read_torch(str(tmp_path / "g"), "module").values():
                assert sum(part.nbytes for part in entry.chunks()) == entry.n_bytes
        except ConvertError:
            refused += 1
    assert refused > 200


def test_random_damage_to_a_pickle_never_escapes_as_another_exception(tmp_path):
    rng = np.random.default_rng(4)
    good = pickled({"module": state_dict(GOOD)[0]})
    refused = 0
    for _ in range(600):
        broken = bytearray(good)
        for position in rng.integers(0, len(good), rng.integers(1, 6)):
            broken[position] = rng.integers(0, 256)
        try:
            read_torch(of_pickle(tmp_path, bytes(broken)), "module")
        except ConvertError:
            refused += 1
    assert refused > 400
