#!/usr/bin/env python3
# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Runs every suite of both builds and ends with one line that counts the tests.

make test                       the usual way
scripts/test.py --preset cpu    one build only
"""

import argparse
import os
import re
import subprocess
import sys
from collections import Counter

# What the test programs print about themselves; ctest -V passes it on with a number in front of each line.
DOCTEST = re.compile(r"\[doctest\] test cases:\s*(\d+)\s*\|\s*(\d+) passed\s*\|\s*(\d+) failed\s*\|\s*(\d+) skipped")
FAILED = re.compile(r"^\s*\d+/\d+ Test\s+#(\d+): (\S+) \.*\*\*\*.*", re.M)
PYTEST = re.compile(r"^\d+: (?:=+ )?(\d+ (?:passed|failed|skipped|deselected|error).*) in [\d.]+s", re.M)


def run_preset(preset):
    """Runs ctest of one build. Returns (counts of tests by outcome, whether ctest was content)."""
    print(f"== {preset}", flush=True)
    # Suites of clients and servers mostly wait for each other. Under sanitizers they time what needs the cores.
    jobs = len(os.sched_getaffinity(0)) + (preset == "cpu")
    process = subprocess.Popen(
        ["ctest", "--preset", preset, "-V", "--no-tests=error", "-j", str(jobs)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    counts, lines = Counter(), []
    for line in process.stdout:
        lines.append(line)
        if re.match(r"^\s*\d+/\d+ Test|^\d+: SKIP|^The following|^\d+: .*(ERROR|FAILED|error:)", line):
            print(line, end="", flush=True)
    content = process.wait() == 0
    text = "".join(lines)
    for _, *numbers in DOCTEST.findall(text):
        counts.update(dict(zip(("passed", "failed", "skipped"), map(int, numbers))))
    for summary in PYTEST.findall(text):
        for number, outcome in re.findall(r"(\d+) (passed|failed|skipped|error)", summary):
            counts["failed" if outcome == "error" else outcome] += int(number)
    if not content:
        print_failures(text)
        counts["failed"] = max(counts["failed"], 1)
    return counts, content


def print_failures(text, n_line=150):
    """The end of what each failed suite printed, for a reader who has nothing but the end of a log."""
    for failed in FAILED.finditer(text):
        number, suite = failed[1], failed[2]
        lines = re.findall(rf"^{number}: .*", text, re.M)
        print(f"-- {suite}: the last {n_line} of its {len(lines)} lines", *lines[-n_line:], failed[0].strip(), sep="\n")
    if not FAILED.search(text):
        print(text[-20000:])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", action="append", help="builds to test; default: cpu and asan")
    total, content = Counter(), True
    for preset in parser.parse_args().preset or ["cpu", "asan"]:
        counts, ok = run_preset(preset)
        print(f"   {preset}: {counts['passed']} passed, {counts['failed']} failed, {counts['skipped']} skipped")
        total += counts
        content &= ok
    if total["passed"] == 0:
        sys.exit("no test ran")
    print(f"{total['passed']} passed, {total['failed']} failed, {total['skipped']} skipped")
    return 0 if content else 1


if __name__ == "__main__":
    sys.exit(main())
