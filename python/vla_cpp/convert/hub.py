# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Downloads repositories of the hub into the cache of huggingface_hub.

The library sends the requests with the user's token and follows redirects. This module makes paths from the hub's answers, so it first
checks commits, digests and file names. The next run continues an interrupted download. A file is renamed to its digest only when it is
complete.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import logging
import os
import re
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path
from typing import Any, Iterator, List, NamedTuple, Optional, Sequence

from ..printable import printable
from .errors import Code, ConvertError, refuse
from .files import missing_extra, plain_name

HUB_PATTERNS = [
    "*.json",
    "*.safetensors",
    "mp_rank_00_model_states.pt",
    "*_checkpoint.pt",
    "*--checkpoint.pt",
    "tokenizer/*",
    "action_tokenizer/*",
    "vlm/*.json",
    "vlm/merges.txt",
    "processor/*.json",
    "assets/*",
    "params/*",
]
BACKBONE_PATTERNS = [
    "config.json",
    "tokenizer.json",
    "tokenizer_config.json",
    "vocab.json",
    "merges.txt",
    "added_tokens.json",
    "preprocessor_config.json",
    "processor_config.json",
    "chat_template.*",
]
ACTION_TOKENIZER_PATTERNS = ["processor_config.json", "tokenizer.json", "tokenizer_config.json", "bpe_tokenizer/*.json"]
HUB = "hub:"
HUB_FORM = "hub:OWNER/NAME@REVISION"
HUB_NAME = r"\w[\w.-]*/\w[\w.-]*"
MAX_NAME = 512  # characters of OWNER/NAME@REVISION
MAX_FILES = 100_000  # files in a repository


class HubFolder(NamedTuple):
    """A repository of the hub in the local cache. commit: the commit that the revision named when it was fetched."""

    folder: str
    repo: str
    commit: str


def hub_folder(source: str, patterns: Sequence[str], again: bool = False) -> Optional[HubFolder]:
    """The repository of a source hub:OWNER/NAME@REVISION, downloaded if missing; None for any other source, which is a folder. Without
    this form, revision included, nothing is downloaded. `again`: compares cached files with their digests. Errors: usage, io."""
    if not source.startswith(HUB):
        return None
    found = re.fullmatch(r"({})@(\w[\w.-]*(?:/\w[\w.-]*)*)".format(HUB_NAME), source[len(HUB) :][: MAX_NAME + 1], re.ASCII)
    if not found or len(source) > len(HUB) + MAX_NAME:
        hint = "a revision is a commit, tag or branch, such as main; the bundle records the commit"
        raise refuse(source[:MAX_NAME], HUB_FORM, "another form", hint, Code.USAGE)
    folder = fetched(source, found[1], found[2], patterns, again)
    return HubFolder(folder, found[1], os.path.basename(folder))


def fetched(source: str, repo: str, revision: str, patterns: Sequence[str], again: bool = False) -> str:
    """The folder with the repository's files that match the patterns, downloaded if missing."""
    try:
        import huggingface_hub
        import huggingface_hub.utils
    except ImportError:
        raise missing_extra("huggingface_hub")
    for handler in logging.getLogger("huggingface_hub").handlers:
        handler.addFilter(_shown)
    try:
        try:
            listing = _listing(huggingface_hub, repo, revision, patterns)
        except huggingface_hub.utils.RevisionNotFoundError:
            raise
        except Exception as unreachable:
            return _cached(huggingface_hub, repo, revision, patterns, unreachable)
        return _download(huggingface_hub, repo, revision, listing, again)
    except ConvertError:
        raise
    except Exception as error:  # noqa: BLE001 - the library has a class for every kind of failure
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise refuse(source, "a reachable hub repository", reason[:200], "download it and give the folder", Code.IO)


def _shown(record: logging.LogRecord) -> bool:
    """Makes a log message printable: the library's messages may contain text from the hub."""
    record.msg, record.args = printable(record.getMessage()), ()
    return True


def _cached(hub: Any, repo: str, revision: str, patterns: Sequence[str], unreachable: Exception) -> str:
    try:
        return hub.snapshot_download(repo, revision=revision, allow_patterns=list(patterns), local_files_only=True)
    except Exception:  # noqa: BLE001
        raise unreachable


class _File(NamedTuple):
    """A file of a repository. digest: for large files the SHA-256 of the bytes, for others git's blob hash."""

    path: str
    size: int
    digest: str
    is_large: bool

    def digest_of(self, file: Path) -> str:
        digest = hashlib.sha256() if self.is_large else hashlib.sha1(b"blob %d\0" % file.stat().st_size)
        with open(file, "rb") as data:
            for part in iter(lambda: data.read(1 << 20), b""):
                digest.update(part)
        return digest.hexdigest()


class _Listing(NamedTuple):
    commit: str
    files: List[_File]


def _listing(hub: Any, repo: str, revision: str, patterns: Sequence[str]) -> _Listing:
    api = hub.HfApi()
    commit = api.model_info(repo, revision=revision).sha
    if not isinstance(commit, str) or not re.fullmatch("[0-9a-f]{40}", commit):
        raise refuse(repo, "a commit of 40 hexadecimal digits", repr(commit)[:80], code=Code.IO)
    entries = list(islice(api.list_repo_tree(repo, revision=commit, recursive=True), MAX_FILES + 1))
    if len(entries) > MAX_FILES:
        raise refuse(repo, "at most {} files".format(MAX_FILES), "more", code=Code.IO)
    wanted = [e for e in entries if hasattr(e, "blob_id") and any(fnmatchcase(e.path, pattern) for pattern in patterns)]
    return _Listing(commit, [_file(repo, entry) for entry in wanted])


def _file(repo: str, entry: Any) -> _File:
    """A file from the hub's list. Errors: io for a name that leaves the folder or contains control characters, and for an invalid digest."""
    parts = entry.path.split("/")
    if not all(plain_name(part) and part == printable(part) and len(part) < 256 for part in parts):
        raise refuse(repo, "files with plain names", repr(entry.path)[:200], "the hub's answer is not used", Code.IO)
    large = entry.lfs is not None
    digest = entry.lfs.sha256 if large else entry.blob_id
    if not isinstance(digest, str) or not re.fullmatch("[0-9a-f]{64}" if large else "[0-9a-f]{40}", digest):
        raise refuse("{}: {}".format(repo, entry.path), "a digest in hexadecimal", repr(digest)[:200], code=Code.IO)
    size = entry.lfs.size if large else entry.size
    return _File(entry.path, int(size), digest, large)


def _download(hub: Any, repo: str, revision: str, listing: _Listing, again: bool) -> str:
    """Downloads the blobs, then makes the folder of links to them, and writes the revision's name last: a named revision is complete."""
    cache = Path(hub.constants.HF_HUB_CACHE) / "models--{}".format(repo.replace("/", "--"))
    blobs, snapshot = cache / "blobs", cache / "snapshots" / listing.commit
    blobs.mkdir(parents=True, exist_ok=True)
    snapshot.mkdir(parents=True, exist_ok=True)
    for file in listing.files:
        blob = blobs / file.digest
        if again and blob.exists() and file.digest_of(blob) != file.digest:
            blob.unlink()
        if not blob.exists():
            _fetch(hub, hub.hf_hub_url(repo, file.path, revision=listing.commit), file, blob)
    for file in listing.files:
        link = snapshot / file.path
        link.parent.mkdir(parents=True, exist_ok=True)
        if not os.path.lexists(link):
            link.symlink_to(os.path.relpath(blobs / file.digest, link.parent))
    if revision != listing.commit:
        name = cache / "refs" / revision
        name.parent.mkdir(parents=True, exist_ok=True)
        name.write_text(listing.commit)
    _remove_stale(blobs)
    return str(snapshot)


class _Part(io.FileIO):
    """A file with a size limit, so that a hub that sends too much cannot fill the disk."""

    def __init__(self, path: Path, limit: int) -> None:
        super().__init__(path, "ab")
        self._limit = limit

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self._limit:
            raise refuse(self.name.name, "{} bytes".format(self._limit), "more", "the hub sends another file than it lists", Code.IO)
        rest = memoryview(data)
        while len(rest):
            rest = rest[super().write(rest) :]
        return len(data)


@contextlib.contextmanager
def _held(path: Path, limit: int) -> Iterator[_Part]:
    """Opens the partial file and locks it for this program. If another program finished the file during the wait for the lock, opens a
    new one."""
    while True:
        with _Part(path, limit) as part:
            fcntl.flock(part, fcntl.LOCK_EX)
            if path.exists() and os.path.samestat(os.fstat(part.fileno()), path.stat()):
                yield part
                return


def _fetch(hub: Any, url: str, file: _File, blob: Path) -> None:
    """Downloads a file, continuing an interrupted download. Errors: io."""
    from huggingface_hub.file_download import http_get

    path = blob.with_name(blob.name + ".part")
    with _held(path, file.size) as part:
        if blob.exists():  # another program has finished the download
            path.unlink()
            return
        if part.tell() > file.size:
            part.truncate(0)
            part.seek(0)
        headers = {**hub.utils.build_hf_headers(), "Accept-Encoding": "identity"}
        http_get(url, part, resume_size=part.tell(), headers=headers, expected_size=file.size, displayed_filename=file.path)
        if (found := file.digest_of(path)) != file.digest:
            path.unlink()
            expected = "bytes of {} {}".format("SHA-256" if file.is_large else "git's SHA-1", file.digest)
            raise refuse(file.path, expected, found, "they were removed: run it again", Code.IO)
        path.replace(blob)


def _remove_stale(blobs: Path) -> None:
    """Removes partial files of earlier runs that no running program holds."""
    for path in blobs.glob("*.part"):
        with open(path, "rb") as part, contextlib.suppress(OSError):
            fcntl.flock(part, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
