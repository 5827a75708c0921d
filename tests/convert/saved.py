# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of tools/goldens, changed after they were written."""

import json
import shutil


class Saved:
    """A checkpoint without some of its files and folders. changes: what is done to the content of each JSON file, by its name without ending."""

    def __init__(self, checkpoint, seed, without=(), **changes):
        self.checkpoint, self.seed, self.without, self.changes = checkpoint, seed, without, changes

    def save(self, folder):
        shutil.rmtree(folder, ignore_errors=True)
        self.checkpoint.write(self.seed, folder)
        for name, change in self.changes.items():
            change_json(next(folder.glob("**/{}.json".format(name))), change)
        for name in self.without:
            path = folder / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()


class Changed:
    """A case's checkpoint, one of whose JSON files is changed."""

    def __init__(self, case, file="config.json", change=lambda content: None):
        self.case, self.file, self.change = case, file, change

    def save(self, folder):
        self.case.checkpoint.write(self.case.seed, folder)
        change_json(folder / self.file, self.change)


def change_json(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
