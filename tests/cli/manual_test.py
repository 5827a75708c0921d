# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla manual: a man page and a completion that say what --help says; what a Debian package installs beside them."""

import re
import shutil
import subprocess

import pytest
from conftest import ROOT


@pytest.fixture(scope="module")
def helps(vla):
    """Help by command."""
    commands = re.findall(r"^  ([a-z]+) {2,}", vla("--help").out, re.M)
    assert {"run", "serve", "doctor", "manual"} <= set(commands)
    return {command: vla(command, "--help").out for command in commands}


def test_the_man_page_has_every_command_and_option(vla, helps):
    page = vla("manual").out.replace("\\-", "-")
    for command, text in helps.items():
        section = page.split(f".SS vla {command}\n")[1].split("\n.SS ")[0]
        options = set(re.findall(r"--[a-z][\w-]+", "\n".join(re.findall(r"^  .*", text, re.M))))
        assert all(option in section for option in options - {"--help"}), command


def test_the_man_page_is_sound(vla):
    if shutil.which("groff") is None:
        pytest.skip("no groff")
    done = subprocess.run(["groff", "-man", "-Tutf8", "-ww"], input=vla("manual").out, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "" and "NAME" in done.stdout


def completed(vla, *words):
    script = vla("manual", "--bash-completion").out
    call = f'COMP_WORDS=({" ".join(words)}); COMP_CWORD={len(words) - 1}; _vla; echo "${{COMPREPLY[@]}}"'
    return subprocess.run(["bash", "-c", script + call], capture_output=True, text=True, check=True).stdout.split()


def test_bash_completes_commands_options_and_their_values(vla):
    assert completed(vla, "vla", "se") == ["serve"]
    assert set(completed(vla, "vla", "doctor", "--")) == {"--help", "--threads", "--kernels", "--device", "--embodiment", "--json"}
    assert completed(vla, "vla", "serve", "--log", "j") == ["json"]
    assert completed(vla, "vla", "run", "pol") == []  # files, which bash itself completes


def test_the_unit_of_the_server_is_sound_and_exposes_little(vla, tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze")
    unit = tmp_path / "vla@.service"
    text = (ROOT / "packaging/vla@.service").read_text().replace("/usr/bin/vla", vla.path)
    assert "\nEnvironment=CUDA_CACHE_PATH=%S/vla/cuda\n" in text  # in what StateDirectory=vla lets it write to
    unit.write_text(text.replace("Documentation=man:vla(1)\n", ""))
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    told = [line for line in done.stderr.splitlines() if "vla@" in line]
    assert done.returncode == 0 and not told, done.stderr
    done = subprocess.run(["systemd-analyze", "security", "--offline=yes", "--threshold=20", unit], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout.splitlines()[-1]  # 2.0 of 10 at most
