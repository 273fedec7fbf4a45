"""The benchmarks run, compare like with like, and their figures mean what they say."""

import numpy as np
import pytest

from benchmarks import centroids, points
from benchmarks.bare_stream import running_bare_stream
from benchmarks.live import measure, summarise


def test_points_methods_solve_the_same_problem() -> None:
    rows = points.run(seconds=0.0)
    assert {row["points"] for row in rows} == set(points.SIZES)
    errors = {(row["points"], row["method"]): float(row["rms_error_mm"]) for row in rows}
    for size in (1, 16):
        # All of the peer's points are ours: the same minimum.
        ours = errors[size, "lumiline reconstruct"]
        peer = errors[size, "scipy.optimize.least_squares, each point"]
        assert ours == pytest.approx(peer, rel=1e-3)
    # With one bad sensor the weights gain much over the linear solution.
    assert errors[4096, "lumiline reconstruct"] < errors[4096, "lumiline linear [5.24]"] / 3
    assert all(row["times_ours"] == 1.0 for row in rows if row["method"] == "lumiline reconstruct")


def test_centroid_lines_have_their_peaks_where_they_say() -> None:
    lines, position = centroids.measured_lines(50, 2048)
    brightest = np.argmax(lines, axis=1)
    assert np.abs(brightest - position).max() < 6.0


def test_live_figures() -> None:
    sequences = [10, 11, 13, 14]
    figures = summarise(sequences, [1_000_000, 2_000_000, 3_000_000, 4_000_000], 0, 4_000_000, 7, 2)
    assert (figures.frames, figures.lost, figures.missed, figures.without_position) == (4, 1, 7, 2)
    assert figures.frames_per_s == pytest.approx(750.0)
    assert figures.latency_ms["p50"] == pytest.approx(2.5)
    assert figures.latency_ms["max"] == pytest.approx(4.0)
    with pytest.raises(RuntimeError, match="1 frames"):
        summarise([1], [1], 0, 0)


def test_the_bare_websocket_is_a_stream_like_ours() -> None:
    with running_bare_stream() as url:
        figures = measure(url, 0.3)
    assert figures.lost == 0
    assert figures.frames > 100
