"""The pose benchmark compares like with like, and its tracker tracks."""

import pytest

from benchmarks import pose


@pytest.mark.slow
def test_all_methods_end_at_the_same_minimum() -> None:
    rows = pose.run(seconds=0.0)
    fits = [row for row in rows if "mean_chi2" in row]
    assert {row["job"] for row in fits} == {"fit", "without a start"}
    first = float(fits[0]["mean_chi2"])
    # Ten residuals more than unknowns.
    assert 5.0 < first < 16.0
    for row in fits:
        assert float(row["mean_chi2"]) == pytest.approx(first, rel=1e-5)
        assert float(row["worst_error_mm"]) < 1.0
    steps = [row for row in rows if str(row["job"]).startswith("step")]
    assert len(steps) == 3
    assert {row["method"] for row in steps} == {pose.OURS, f"{pose.OURS}, a single mode"}
    assert all(float(row["valid_poses"]) >= 9.0 for row in steps)


def test_the_peers_slopes_are_right() -> None:
    cameras = pose.rig()
    task = pose.tasks(cameras)[0]
    analytic = pose.by_scipy(cameras, task, task.start, analytic=True)
    numerical = pose.by_scipy(cameras, task, task.start, analytic=False)
    assert analytic.translation_mm == pytest.approx(numerical.translation_mm, abs=1e-4)
