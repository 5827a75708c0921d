# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes the checkpoint that a bundle of train.py's policy was made from, for LeRobot to load: lerobot-eval --policy.path=checkpoint

    python checkpoint.py ../../models/metaworld-tiny.gguf --out checkpoint

How, and what it holds: ../restore.py.
"""
import sys

import train  # before torch and lerobot; it finds ../restore.py
import restore

if __name__ == "__main__":
    sys.exit(restore.main(__doc__, train.save_backbone, train.make_policy, train.describe))
