# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""vla bench: what a script finds in its JSON, what a person finds in its table and image, and what it refuses."""

import json
import subprocess
from xml.etree import ElementTree

import pytest
from conftest import ROOT

DEMO = ROOT / "models/metaworld-tiny.gguf"
NETWORK = ["vision", "prefix", "steps"]
STAGES = ["decode", "preprocess", "tokenize", "plan", *NETWORK, "postprocess"]
FEW = ["--runs", "2", "--warmup", "1", "--threads", "2"]


@pytest.fixture(scope="module")
def plotted(tmp_path_factory):
    return tmp_path_factory.mktemp("bench") / "roofline.svg"


@pytest.fixture(scope="module")
def answer(vla, plotted):
    return vla("bench", DEMO, *FEW, "--steps", "1,3", "--tokens", "9", "--image-size", "48x64", "--json", "--plot", plotted)


@pytest.fixture(scope="module")
def report(answer):
    return answer.json()


def test_json_is_one_object_on_the_last_line_and_tells_the_conditions(answer, report):
    assert answer.out.count("\n") == 1 and "round 2/2" in answer.err
    conditions = report["conditions"]
    assert (conditions["policy"], conditions["weights"]) == ("smolvla", "bf16")
    assert [conditions[k] for k in ("views", "height", "width", "tokens", "steps")] == [1, 48, 64, 9, 3]
    assert report["threads"] == 2 and report["kernels"] in ("ggml", "portable", "neon", "neon_bf16", "avx2", "avx512", "avx512_bf16", "amx") and report["cpu"]
    assert report["load_ms"] > 0 and report["memory_bytes"]["predicted"] > 0 and report["memory_bytes"]["peak"] > 0


def test_the_stages_of_every_round_add_up_to_its_total(report):
    assert len(report["rounds"]) == 2
    for run in report["rounds"]:
        assert list(run["stages"]) == STAGES
        assert sum(run["stages"].values()) == pytest.approx(run["total_ms"], rel=1e-4)
        assert run["peak_gflops"] > 0 and run["cores"] > 0 and run["disturbed"] in (True, False)
    assert list(report["stages"]) == [*STAGES, "network", "total"]
    totals = [run["total_ms"] for run in report["rounds"]]
    assert report["total_ms"] == pytest.approx(sum(totals) / 2, rel=1e-4)  # the median of two
    assert report["stages"]["total"]["min_ms"] == pytest.approx(min(totals), rel=1e-4)


def test_rates_follow_from_work_and_time(report):
    for stage in [*NETWORK, "network"]:
        row = report["stages"][stage]
        assert row["gflops"] == pytest.approx(1e3 * row["gflop"] / row["p50_ms"], rel=1e-3)
        assert row["intensity"] == pytest.approx(row["gflop"] / row["gbytes"], rel=1e-3)
        assert row["regime"] == ("compute" if row["intensity"] >= report["ridge"] else "memory")
        assert 0 < row["share_of_peak_p50"] <= row["share_of_peak"]
        assert row["floor_ms"] > 0 and row["above_floor"] == pytest.approx(row["p50_ms"] / row["floor_ms"], rel=1e-3)
    network = report["stages"]["network"]
    assert network["gflop"] == pytest.approx(sum(report["stages"][s]["gflop"] for s in NETWORK), rel=1e-4)
    assert report["share_of_peak"] == network["share_of_peak"]
    assert all(report["stages"][s]["regime"] == "host" for s in STAGES if s not in NETWORK)


def test_the_threads_time_is_divided_among_kinds_of_operations(report):
    if report["kernels"] == "ggml":
        assert "shares" not in report
        return
    shares = report["shares"]
    assert list(shares) == ["products", "attention", "norms and codes", "others"]
    assert sum(shares.values()) == pytest.approx(1, abs=1e-5)
    assert shares["products"] > 0 and shares["attention"] > 0  # how large, a busy machine decides


def test_the_machine_is_measured_before_and_after(report):
    assert report["peak_name"] in [peak["name"] for peak in report["peaks"]]
    for peak in report["peaks"]:
        assert all(rate > 0 for rate in peak["one_thread_gflops"] + peak["all_threads_gflops"])
    assert len(report["bandwidth_gbytes_per_s"]) == 2 and min(report["bandwidth_gbytes_per_s"]) > 0


def test_the_line_over_the_steps_goes_through_two_points(report):
    fit = report["fit"]
    assert [point[0] for point in fit["points"]] == [1, 3]
    for n_step, ms in fit["points"]:
        assert fit["prefix_ms"] + n_step * fit["step_ms"] == pytest.approx(ms, rel=1e-3)


def test_the_plot_is_xml_with_a_label_for_every_roof_and_stage(report, plotted):
    root = ElementTree.parse(plotted).getroot()
    texts = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {*NETWORK, "network"} <= set(texts)
    for peak in report["peaks"]:
        assert any(text.startswith(peak["name"] + ", all threads: ") for text in texts)
    assert any(text.startswith("memory: ") for text in texts) and any(report["cpu"] in text for text in texts)


def test_markdown_has_a_row_for_every_stage_and_an_earlier_run_is_compared_with(vla, report, tmp_path):
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps({**report, "peak_gflops": 100 * report["peak_gflops"]}))
    same = ["--steps", "3", "--tokens", "9", "--image-size", "48x64"]
    out = vla("bench", DEMO, *FEW, *same, "--markdown", "--vs", earlier).out
    rows = [line.split(" | ")[0] for line in out.splitlines() if line.startswith("| ")]
    assert rows == [f"| {name}" for name in ["stage", "---", *STAGES, "network", "total"]]
    assert "times as fast" in out and "warning: the machine's own peak" in out and "budget" not in out
    other = vla("bench", DEMO, *FEW, "--steps", "1", "--vs", earlier)
    assert other.code == 2 and other.out == "" and "measuring" not in other.err
    assert all(part in other.err.splitlines()[-1] for part in ("error: usage: --vs", "1 steps", "found smolvla", "3 steps"))


def test_random_weights_of_an_unknown_architecture_are_refused(vla):
    vla("bench", "--arch", "octo", "--size", "full").refused("unsupported", "octo")


def test_a_paced_run_waits_for_a_line_before_each_round(vla):
    command = [vla.path, "bench", str(DEMO), *FEW, "--paced", "--json"]
    process = subprocess.run(command, input="\n\n\n", capture_output=True, text=True)
    assert process.returncode == 0 and len(json.loads(process.stdout)["rounds"]) == 2
    short = subprocess.run(command, input="\n\n", capture_output=True, text=True)
    assert short.returncode == 2 and "--paced" in short.stderr and short.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ([], "neither"),
        ([DEMO, "--arch", "smolvla", "--size", "full"], "both"),
        (["--arch", "smolvla"], "--size"),
        ([DEMO, "--json", "--markdown"], "both"),
        ([DEMO, "--image-size", "48"], "48"),
        ([DEMO, "--image-size", "0x64"], "0x64"),
        ([DEMO, "--image-size", "48x64x3"], "48x64x3"),
        ([DEMO, "--runs", "0"], "--runs"),
        ([DEMO, "--steps", "0"], "--steps"),
        ([DEMO, "--views", "0"], "--views"),
        ([DEMO, "--kernels", "fast"], "fast"),
    ],
)
def test_nonsense_is_refused_before_anything_is_measured(vla, arguments, found):
    answer = vla("bench", *arguments)
    assert answer.code == 2 and answer.out == "" and found in answer.err
    assert "measuring" not in answer.err


@pytest.mark.parametrize(
    ("options", "found"), [(["--views", "4"], "--views"), (["--tokens", "4000"], "--tokens"), (["--vs", "none.json"], "none.json")]
)
def test_what_the_bundle_cannot_take_is_refused_with_what_it_can(vla, options, found):
    answer = vla("bench", DEMO, *options)
    assert answer.code in (2, 9) and answer.out == "" and found in answer.err.splitlines()[-1]
    assert "measuring" not in answer.err
