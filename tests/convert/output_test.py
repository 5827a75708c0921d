# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What every program does with the name of its output: a file is replaced as a whole, anything else stays what it is."""

import os
import stat

import pytest
from vla_cpp.convert.cli import main
from vla_cpp.output import is_file, whole_file


def write(path, data=b"new"):
    with whole_file(path) as file:
        file.write(b"?" * len(data))
        file.seek(0)
        file.write(data)


def test_a_file_is_replaced_as_a_whole_and_keeps_its_mode(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"something longer")
    path.chmod(0o600)
    write(path)
    assert path.read_bytes() == b"new" and stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(KeyError), whole_file(path) as file:
        file.write(b"half")
        raise KeyError
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["a"]


def test_links_stay_and_lead_to_what_was_written(tmp_path):
    (tmp_path / "versions").mkdir()
    link, second, loop = tmp_path / "link", tmp_path / "second", tmp_path / "loop"
    link.symlink_to("versions/v3")
    second.symlink_to("link")
    for data in (b"new", b"newer"):
        write(second, data)
        assert second.is_symlink() and link.is_symlink() and (tmp_path / "versions/v3").read_bytes() == data
    loop.symlink_to("loop")
    with pytest.raises(OSError):
        write(loop)
    assert loop.is_symlink()


def test_a_pipe_a_device_and_an_open_file_are_written_to(tmp_path):
    pipe, link, log = tmp_path / "pipe", tmp_path / "link", tmp_path / "log"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write(pipe)
    assert os.read(reader, 10) == b"new" and stat.S_ISFIFO(pipe.stat().st_mode)
    os.close(reader)
    link.symlink_to("/dev/null")
    write(link)
    assert link.is_symlink() and stat.S_ISCHR(os.stat("/dev/null").st_mode)
    with log.open("ab") as file:
        file.write(b"so far ")
        file.flush()
        write(f"/dev/fd/{file.fileno()}")
        assert not is_file(f"/dev/fd/{file.fileno()}")
    assert log.read_bytes() == b"so far new"
    with pytest.raises(IsADirectoryError):
        write(tmp_path)


def test_a_checkpoint_is_converted_into_a_device_without_force_and_behind_a_link(converter, tiny, tmp_path, capsys):
    folder, link = converter.save(tiny), tmp_path / "policy.gguf"
    assert main([folder, "-o", "/dev/null"]) == 0
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode) and " 0 bytes" not in capsys.readouterr().out
    link.symlink_to("v3.gguf")
    assert main([folder, "-o", str(link), "--quiet"]) == 0
    assert link.is_symlink() and (tmp_path / "v3.gguf").stat().st_size > 1000
    assert main([folder, "-o", str(link), "--quiet"]) == 2 and "--force" in capsys.readouterr().err
