# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
import pytest

pytest.importorskip("matplotlib", reason="matplotlib is not installed here: pip install matplotlib")
from vla_cpp.eval import plots  # noqa: E402


@pytest.mark.parametrize(
    "values, labels",
    [
        ([17.4, 9.4, 1.25], ["2", "5", "10", "20"]),
        ([58, 802, 80], ["50", "100", "200", "500"]),
        ([0.3, 0.3], ["0.2", "0.5"]),
        ([0.012, 0.9], ["0.02", "0.05", "0.1", "0.2", "0.5", "1"]),
    ],
)
def test_a_logarithmic_axis_is_labelled_in_plain_numbers(values, labels):
    figure, axes = plots.plt.subplots()
    axes.plot(values)
    plots.plain_log(axes, values)
    figure.canvas.draw()
    assert [label.get_text() for label in axes.get_yticklabels(which="both")] == labels
    low, high = axes.get_ylim()
    assert low <= min(values) and max(values) <= high
    plots.plt.close(figure)
