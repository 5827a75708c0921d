# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla-pull: downloads bundles from the hub into the cache of huggingface_hub. Every command finds them there by name.

The next run continues an interrupted download. A file is stored under its SHA-256, which every run checks; every load checks the bundle's own
checksum.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, Iterator, List, Optional, Tuple

from .convert.errors import Code, ConvertError
from .convert.hub import HUB, HUB_FORM, hub_folder
from .errors import IoError, UsageError, VlaError
from .installed import extra_hint
from .printable import printable

PATTERN = "*.gguf"
EPILOG = """examples:
  vla-pull hub:OWNER/NAME@main
  vla serve hub:OWNER/NAME@main
  vla-pull --list
Exit codes: 0 done, 2 usage, 9 a file or the hub."""


def pull(source: str) -> List[Path]:
    """Paths of a repository's bundles, downloaded if missing. Errors: UsageError and ConvertError (form of the name, hub, damaged bytes),
    IoError (no bundle)."""
    folder = hub_folder(source, [PATTERN], again=True)
    if folder is None:
        raise UsageError(source, HUB_FORM, "another form")
    files = sorted(Path(folder.folder).glob(PATTERN))
    if not files:
        raise IoError(source, "a repository with a .gguf file", "none")
    return files


def _bundles() -> Iterator[Tuple[str, Any, Any]]:
    """(name, repository, revision) of every cached revision with a bundle."""
    from huggingface_hub import scan_cache_dir
    from huggingface_hub.errors import CacheNotFound

    try:
        found = scan_cache_dir()
    except CacheNotFound:
        return
    for repo in sorted(found.repos, key=lambda r: r.repo_id):
        for revision in repo.revisions:
            if repo.repo_type == "model" and any(file.file_name.endswith(".gguf") for file in revision.files):
                for name in sorted(revision.refs) or [revision.commit_hash]:
                    yield f"{HUB}{repo.repo_id}@{name}", repo, revision


def show() -> None:
    for name, _, revision in _bundles():
        files = ", ".join(sorted(f.file_name for f in revision.files if f.file_name.endswith(".gguf")))
        print(printable(f"{name}  {revision.size_on_disk / 1e6:.1f} MB  {files}"))


def remove(source: str) -> None:
    """Deletes a cached revision. Errors: IoError for an unknown name, listing the known ones."""
    from huggingface_hub import scan_cache_dir

    names = {name: revision for name, _, revision in _bundles()}
    if source not in names:
        raise IoError(source, "one of " + (", ".join(names) or "none: the cache has no bundle"), "another name")
    plan = scan_cache_dir().delete_revisions(names[source].commit_hash)
    plan.execute()
    print(printable(f"removed {source}, {plan.expected_freed_size / 1e6:.1f} MB"))


def main(argv: Optional[List[str]] = None) -> int:
    parser = argparse.ArgumentParser("vla-pull", description=__doc__, epilog=EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("source", nargs="?", metavar=HUB_FORM, help="download the bundles of this repository")
    what.add_argument("--list", action="store_true", help="show the bundles of the cache, by the names that commands take")
    what.add_argument("--remove", metavar="NAME", help="delete a bundle from the cache")
    a = parser.parse_args(argv)
    try:
        if a.list:
            show()
        elif a.remove:
            remove(a.remove)
        else:
            print("\n".join(map(str, pull(a.source))))
    except ModuleNotFoundError as error:
        print(f"vla-pull: the module {error.name} is missing; {extra_hint('convert')}", file=sys.stderr)
        return 9
    except (ConvertError, VlaError) as error:
        print(f"vla-pull: {error}", file=sys.stderr)
        return 2 if error.code in (Code.USAGE, UsageError.code) else 9
    return 0


if __name__ == "__main__":
    sys.exit(main())
