"""Label errors in a calibration: reported, excluded or repaired."""

import numpy as np
import pytest

from compute.calibration.assessment.assess import cross_validate
from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings, LabelPolicy
from compute.errors import NoConvergence
from tests.compute.rig import control_points, geometry, project, rig

SIGMA = 0.3


@pytest.mark.parametrize("policy", ["report", "exclude", "repair"])
def test_an_exchanged_pair(policy: LabelPolicy) -> None:
    models, points = rig(), control_points(24)
    clean = project(models, points) + SIGMA * np.random.default_rng(2).standard_normal((24, 4))
    wrong = clean.copy()
    # Readings some way apart: it shows, and leaves a camera.
    order = clean[:, 1].argsort()
    low, high = int(order[8]), int(order[16])
    wrong[[low, high], 1] = clean[[high, low], 1]
    given = np.full(clean.shape, SIGMA)
    settings = CalibrationSettings(labels=policy)
    found = calibrate(points, wrong, geometry(models), given, settings)
    (finding,) = found.labels
    assert finding.kind == "exchanged"
    assert finding.sensor == "s2"
    assert set(finding.points) == {low + 1, high + 1}
    if policy == "report":
        assert found.sensors[1].rms_px > 10.0
        return
    expected = clean.copy()
    if policy == "exclude":
        expected[[low, high], 1] = np.nan
    right = calibrate(points, expected, geometry(models), given)
    assert found.models == right.models
    assert found.covariance == right.covariance
    # The checks mend the labels again, as the run did.
    checked = cross_validate(found, points, wrong, geometry(models), given, "points")
    assert all(rms is not None and rms < 1.0 for rms in checked.reading_rms_px)


def test_what_was_found_is_told_where_no_camera_fits() -> None:
    models, points = rig(), control_points(24)
    readings = project(models, points)
    low, high = int(readings[:, 1].argmin()), int(readings[:, 1].argmax())
    readings[[low, high], 1] = readings[[high, low], 1]
    given = np.full(readings.shape, SIGMA)
    settings = CalibrationSettings(labels="report")
    with pytest.raises(NoConvergence, match=rf"exchanged for sensor s2: .*{low + 1}.*repair") as e:
        calibrate(points, readings, geometry(models), given, settings)
    # Where labels are not searched for, the two readings are named all the same.
    assert e.value.context["points"] == tuple(sorted((low + 1, high + 1)))


def test_clean_labels_change_nothing() -> None:
    models, points = rig(), control_points(24)
    clean = project(models, points) + SIGMA * np.random.default_rng(2).standard_normal((24, 4))
    given = np.full(clean.shape, SIGMA)
    plain = calibrate(points, clean, geometry(models), given)
    searched = calibrate(
        points, clean, geometry(models), given, CalibrationSettings(labels="repair")
    )
    assert searched.labels == ()
    assert searched.models == plain.models
