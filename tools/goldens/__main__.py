# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Golden cases.

    python tools/goldens make              checkpoints and bundles into build/goldens/, where they are not there yet
    python tools/goldens make --accept     the same after a change of checkpoints or converter: states their hashes anew
    python tools/goldens record NAME ...   what the reference computes, into tests/golden/NAME/expected.gguf
    python tools/goldens leftover NAME ... what it computes when it goes on from rows of a previous chunk

`make` needs numpy and vla_cpp's extra `convert`.  `record` needs torch, lerobot and gguf too; a case without an observation gets a
random one.  For the cases of Evo-1's authors and of GR00T also opencv-python-headless, for GR00T diffusers.
"""

import argparse
import sys
import warnings
from pathlib import Path

if not __package__:  # run as a folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    __package__ = "goldens"
    import goldens  # noqa: F401

from . import all_cases  # noqa: E402
from .build import make  # noqa: E402
from .cases import RECORDED, ROOT, write_observation  # noqa: E402


def record(name, case):
    import numpy as np

    from .recorder import write_expected

    recorded = RECORDED / name
    if not (recorded / "observation.json").is_file():
        write_observation(case, recorded)
    folder = make(accept=True) / name
    taps = write_expected(folder, name, case.seed, recorded)
    largest = np.abs(taps["chunk"]).max()
    print(f"{name}: {len(taps)} taps, chunk up to {largest:.2f}, published dtypes "
          f"{np.abs(taps['chunk.bf16'] - taps['chunk']).max() / largest:.1e} away")


def record_leftover(name, case):
    from .rtc import write_leftover

    write_leftover(make() / name, case.seed, RECORDED / name)


def main():
    parser = argparse.ArgumentParser(prog="goldens", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("make").add_argument("--accept", action="store_true")
    commands.add_parser("record").add_argument("name", nargs="+", choices=sorted(all_cases()))
    commands.add_parser("leftover").add_argument("name", nargs="+", choices=sorted(all_cases()))
    args = parser.parse_args()
    if args.command == "make":
        make(args.accept)
        return
    from .recorder import open_reference

    sys.path.insert(0, str(ROOT / "python"))
    open_reference()
    warnings.filterwarnings("ignore")
    for name in args.name:
        (record if args.command == "record" else record_leftover)(name, all_cases()[name])


if __name__ == "__main__":
    main()
