"""Label errors and outliers at Student's noise, judged by their true errors."""

import numpy as np
import pytest

from compute.calibration.calibrate import calibrate
from compute.calibration.mislabels.detector import LabelReport
from compute.calibration.mislabels.repair import LabelFinding
from validation.labels.heavy_tails import STUDENT_DOF, Outcome, judge, random_rigs


def test_rigs_are_cameras_with_the_noise_that_they_state() -> None:
    (rig,) = random_rigs(np.random.default_rng(1), 1, np.inf, "none")
    exact = rig.readings_px - rig.error_px
    fit = calibrate(rig.points_mm, exact, rig.sensors)
    assert max(sensor.rms_px for sensor in fit.sensors) < 1e-6 * rig.core_px + 1e-9
    seen = np.isfinite(rig.readings_px)
    assert np.std(rig.error_px[seen]) == pytest.approx(rig.core_px, rel=0.3)


def test_findings_are_judged_by_the_true_errors() -> None:
    (rig,) = random_rigs(np.random.default_rng(2), 1, np.inf, "exchanged")
    assert rig.label_error is not None
    _, sensor, points = rig.label_error
    sigma = (rig.core_px,) * len(rig.sensors)
    right = LabelFinding("exchanged", sensor, points, 0.95, (1.0, 1.0), (20.0, 20.0))
    other = next(one.name for one in rig.sensors if one.name != sensor)
    false = LabelFinding("outlier", other, (1,), 0.7, (1.0,), (6.0,))
    outcome = Outcome()
    outcome.add(rig, LabelReport((right, false), sigma))
    assert (outcome.exact, outcome.false_labels, outcome.with_outliers) == (1, 0, 1)
    assert outcome.stated["label", 3, "true"] == 1
    assert (outcome.stated["outlier", 2, "count"], outcome.stated["outlier", 2, "true"]) == (1, 0)
    outcome.add(rig, LabelReport((), sigma))
    assert outcome.exact == 1
    wrong = LabelFinding("wrong-label", sensor, points, 0.95, (1.0, 1.0), (20.0, 20.0))
    outcome.add(rig, LabelReport((wrong,), sigma))
    assert outcome.false_labels == 1


@pytest.mark.slow
@pytest.mark.parametrize("given", ["core", "rms", "none"])
def test_clean_rigs_with_heavy_tails_have_no_label_errors(given: str) -> None:
    found = judge(1907, 12, STUDENT_DOF, given, "none")  # type: ignore[arg-type]
    assert found.false_labels == 0
    assert found.far_found >= found.far - 1
    assert found.with_outliers > 0


@pytest.mark.slow
def test_an_exchanged_pair_among_outliers_is_found() -> None:
    found = judge(1909, 12, STUDENT_DOF, "core", "exchanged")
    assert found.exact >= 11
    assert found.false_labels == 0
