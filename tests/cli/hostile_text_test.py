# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Text that comes from a bundle, a recording or a server cannot act on the terminal that shows it, nor pass for a line of ours."""

import pytest
from golden_cases import replaced, sealed

NAME = b"observation.images.camera1"


@pytest.mark.parametrize(
    "text",
    [b"x\nready address=tcp://1:1", b"\x1b[2Jcamera1", b"camera1\x7f", b"camera\xc2\x9b2J", b"camera\xe2\x80\xae1", b"camera\xff1"],
    ids=["line", "escape", "delete", "c1", "right_to_left", "not_utf8"],
)
def test_a_name_with_control_characters_is_refused_at_load_and_shown_escaped(vla, golden, tmp_path, text):
    path = tmp_path / "policy.gguf"
    path.write_bytes(sealed(replaced(golden.bundle.read_bytes(), NAME, text.ljust(len(NAME), b"x"))))
    for answer in (vla("inspect", path), vla("serve", path, "--bind", "tcp://127.0.0.1:0"), vla(*golden.arguments(bundle=path))):
        answer.refused("bad_bundle", "text without control characters")
        assert answer.err[:-1].isprintable()


def test_a_key_or_a_tensor_with_control_characters_is_refused(vla, golden, tmp_path):
    path = tmp_path / "policy.gguf"
    for name in (b"vla.source.name", b"action_in_proj.weight"):
        data = golden.bundle.read_bytes()
        if name not in data:
            continue
        path.write_bytes(sealed(replaced(data, name, b"\x1b]0;" + name[4:])))
        vla("inspect", path).refused("bad_bundle", "text without control characters", "\\x1b]0;")


def test_the_name_of_a_file_is_escaped_on_the_ready_line_and_in_errors(vla, tmp_path):
    hostile = tmp_path / "a\x1b[2J\nready address=x"
    answer = vla("serve", hostile, "--bind", "tcp://127.0.0.1:0")
    answer.refused("io")
    assert answer.err[:-1].isprintable() and "\\x1b[2J\\x0aready" in answer.err
