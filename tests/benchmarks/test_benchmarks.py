"""The benchmarks run, compare like with like, and their figures mean what they say."""

import numpy as np
import pytest

from benchmarks import cpu_cuda_agreement, mapped_reconstruction, signal, triangulation
from benchmarks.baseline_stream import running_baseline_stream
from benchmarks.live import measure, summarise
from benchmarks.mapped_reconstruction_peers import numba_method
from benchmarks.synthetic_scans import measured_lines
from compute.mapping.table import Degree
from compute.reconstruction.solver import PointSolver


@pytest.mark.slow
def test_points_methods_solve_the_same_problem() -> None:
    rows = triangulation.run(seconds=0.0)
    assert {row["points"] for row in rows} == set(triangulation.SIZES)
    errors = {(row["points"], row["method"]): float(row["rms_error_mm"]) for row in rows}
    for size in (1, 16):
        # All of the peer's points are ours: the same minimum.
        ours = errors[size, "lumiline reconstruct"]
        peer = errors[size, "scipy.optimize.least_squares, each point"]
        assert ours == pytest.approx(peer, rel=1e-3)
    # With one bad sensor the weights gain much over the linear solution.
    assert errors[4096, "lumiline reconstruct"] < errors[4096, "lumiline linear [5.24]"] / 3
    assert all(row["times_ours"] == 1.0 for row in rows if row["method"] == "lumiline reconstruct")


def test_signal_lines_have_their_peaks_where_they_say() -> None:
    lines, position = measured_lines(50, 2048)
    brightest = np.argmax(lines, axis=1)
    assert np.abs(brightest - position[:, 0]).max() < 6.0
    lines, position = measured_lines(20, 2048, peaks=8)
    found = signal.centroid_finder(20, 2048, "cpu").find(lines)
    assert (found.count == 8).all()
    assert np.abs(found.position_px - position).max() < 0.2


@pytest.mark.slow
def test_signal_methods_find_the_same_peaks() -> None:
    rows = signal.accuracy()
    errors = {str(row["method"]): float(row["rms_error_px"]) for row in rows}
    assert all(row["found"] == 1000 for row in rows)
    # A tenth of the width would be another peak; the fit is the best of all.
    assert max(errors.values()) < 0.2
    assert min(errors.values()) == errors["lumiline fit"]


@pytest.mark.slow
def test_signal_latency_times_a_whole_frame() -> None:
    rows = signal.latency("cpu", frames=20)
    assert {"lumiline on cpu", "lumiline fit on cpu"} <= {row["method"] for row in rows}
    assert all(0.0 < float(row["median_us"]) <= float(row["p99_us"]) for row in rows)


def test_agreement_knows_a_difference(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(cpu_cuda_agreement, "LINES", 2000)
    monkeypatch.setattr(cpu_cuda_agreement, "BLOCK", 1000)
    cpu_cuda_agreement.write(tmp_path / "peaks.npz", "cpu")
    same = cpu_cuda_agreement.compare(tmp_path / "peaks.npz", "cpu")
    for figures in same.values():
        assert figures["lines"] == 2000
        assert figures["peaks"] > 1000
        assert figures["lines_that_differ"] == figures["largest_sigmas"] == 0.0
    stored = dict(np.load(tmp_path / "peaks.npz"))
    stored["fit_position"][5] += 1e-3 * stored["fit_sigma"][5]
    stored["centroid_flags"][3] ^= 1
    np.savez(tmp_path / "other.npz", **stored)
    other = cpu_cuda_agreement.compare(tmp_path / "other.npz", "cpu")
    assert other["fit"]["largest_sigmas"] == pytest.approx(1e-3, rel=0.01)
    assert other["centroid"]["lines_that_differ"] == 1.0


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
    with running_baseline_stream() as url:
        figures = measure(url, 0.5)
    assert figures.lost == 0
    assert figures.frames > 10


@pytest.mark.slow
@pytest.mark.parametrize("degree", [1, 3])
def test_reconstruct_methods_solve_the_same_problem(degree: Degree) -> None:
    task = mapped_reconstruction.task_of(degree)
    readings = mapped_reconstruction.readings_of(task, 300)
    solver = PointSolver(task.cameras, None, task.corrections, "cpu")
    ours = solver.solve(readings, np.full(4, mapped_reconstruction.SIGMA_PX))
    assert (ours.flags == 0).all()
    if degree == 3:  # numba compiles for seconds, whatever the degree
        own = numba_method(task)
        assert own is not None
        position, covariance, setups = own(readings)
        assert np.abs(position - ours.position_mm).max() < 1e-6
        assert np.allclose(covariance, ours.covariance_mm2, rtol=1e-5, atol=1e-9)
        assert 4 <= setups.mean() <= 10
    # Weights without the correction's slope: the same within a tenth of the deviation.
    deviation = np.sqrt(np.trace(ours.covariance_mm2, axis1=1, axis2=2))
    peers = mapped_reconstruction.cpu_peers(task)
    assert len(peers) == (2 if degree == 1 else 1)
    for _, solve in peers:
        off = np.abs(solve(readings)[0] - ours.position_mm).max(axis=1)
        assert (off < 0.1 * deviation).all()


def test_reconstruct_counts_what_a_point_takes() -> None:
    assert mapped_reconstruction.flops_of_equations(3) == 1950
    assert mapped_reconstruction.flops_of_equations(1) == 630
