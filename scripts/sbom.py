#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""What `vla` and libvla.so of a build are made of, as a CycloneDX 1.5 document; then the checksums of all files beside it.

    python3 scripts/sbom.py BUILD OUT

Libraries that are loaded are told by the Debian packages that own them; what is compiled in, by the packages of headers, and ggml by its pin.
"""
import argparse
import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEADERS = ("libcli11-dev", "nlohmann-json3-dev", "libfmt-dev", "libboost-dev", "libmsgpack-cxx-dev", "cppzmq-dev")


def system():
    """The distribution, e.g. debian."""
    return re.search(r'^ID="?(\w+)', Path("/etc/os-release").read_text(), re.M)[1]


def output(*command):
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, check=True).stdout


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def debian(package):
    """A component for a Debian package, None where it is not installed."""
    query = subprocess.run(["dpkg-query", "-W", "-f", "${Package} ${Version} ${Architecture}", package], capture_output=True, text=True)
    if query.returncode:
        return None
    name, version, architecture = query.stdout.split()
    return {"type": "library", "name": name, "version": version, "purl": f"pkg:deb/{system()}/{name}@{version}?arch={architecture}"}


def owner(library):
    """The package that a file is from; /lib and /usr/lib are one folder that packages name either way."""
    for path in {library, library.replace("/usr/lib/", "/lib/", 1), str(Path(library).resolve())}:
        query = subprocess.run(["dpkg-query", "-S", path], capture_output=True, text=True)
        if query.returncode == 0:
            return query.stdout.split(": ")[0]
    raise SystemExit(f"sbom: expected a package that owns {library}, found none")


def loaded(build):
    files = [build / "bin/vla", build / "bin/vla-door-lerobot", next(build.glob("lib/libvla.so.?"))]
    found = {}
    for path in sorted(set(re.findall(r"=> (/\S+)", output("ldd", *files)))):
        component = found.setdefault(owner(path), {**debian(owner(path)), "properties": []})
        component["properties"].append({"name": "sha256:" + Path(path).name, "value": sha256(Path(path))})
    return list(found.values())


def ggml():
    text = (ROOT / "cmake/deps.cmake").read_text()
    archive, digest = (re.search(rf"set\(VLA_GGML_{key} (\S+)\)", text)[1] for key in ("ARCHIVE", "SHA256"))
    version = archive.rpartition("-")[2]
    return {"type": "library", "name": "ggml, of llama-cpp-python", "version": version, "purl": f"pkg:pypi/llama-cpp-python@{version}",
            "hashes": [{"alg": "SHA-256", "content": digest}]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("build", type=Path)
    parser.add_argument("out", type=Path)
    a = parser.parse_args()
    if shutil.which("dpkg-query") is None:
        print("sbom: no dpkg-query here, so no list of what is inside")
        return
    version = output(a.build / "bin/vla", "--version").strip()
    components = [ggml(), *filter(None, map(debian, HEADERS)), *loaded(a.build)]
    document = {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1,
                "metadata": {"component": {"type": "application", "name": "vla", "version": version, "licenses": [{"license": {"id": "Apache-2.0"}}]}},
                "components": components}
    (a.out / f"vla-{version}.cdx.json").write_text(json.dumps(document, indent=1) + "\n")
    files = sorted(path for path in a.out.iterdir() if path.suffix in (".whl", ".deb", ".json"))
    (a.out / "SHA256SUMS").write_text("".join(f"{sha256(path)}  {path.name}\n" for path in files))
    print(f"{a.out}: {len(components)} components; checksums of {', '.join(path.name for path in files)}")


if __name__ == "__main__":
    main()
