"""Calibration settings: allowed values; documents without settings load."""

import json
from typing import Any, get_args

import pytest
from pydantic import TypeAdapter

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.calibration.settings import (
    PRESETS,
    CalibrationSettings,
    Preset,
    check_order,
    free_parameters,
    preset_terms,
)
from compute.camera.field_distortion import check_terms
from compute.errors import InvalidParameter
from tests.compute.rig import control_points, geometry, project, rig


@pytest.mark.parametrize("name", get_args(Preset))
def test_no_named_set_has_a_degenerate_term(name: Preset) -> None:
    check_terms(PRESETS[name])
    assert preset_terms(name) == PRESETS[name]


def test_terms_up_to_the_highest_order_are_taken() -> None:
    terms = ((9, 0), (0, 9), (5, 4))
    assert CalibrationSettings(distortion=terms).distortion == terms
    for name in get_args(Preset):
        check_order(PRESETS[name])


def test_the_factory_set_makes_nineteen_parameters() -> None:
    assert free_parameters(PRESETS["factory-19"]) == 19
    assert free_parameters(()) == 7
    assert free_parameters(PRESETS["odd-powers"]) == 10
    assert free_parameters(PRESETS["symmetric-3"]) == 10


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"loss": "huber"}, "robust"),
        ({"labels": "guess"}, "repair"),
        ({"distortion": "brown"}, "symmetric-3"),
        ({"distortion": ((1, 1),)}, "tilt"),
        ({"distortion": ((3, 0), (50, 50))}, r"u\^50 v\^50, of the order 100"),
        ({"distortion": ((6, 4),)}, "may add up to 9"),
        ({"position_sigma_mm": 0.0}, "1e-06"),
        ({"position_sigma_mm": float("nan")}, "nan"),
    ],
)
def test_settings_that_mean_nothing(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidParameter, match=message):
        CalibrationSettings(**given)


def test_a_document_without_settings_still_loads() -> None:
    models, points = rig(), control_points()
    found = calibrate(points, project(models, points), geometry(models))
    adapter = TypeAdapter(Calibration)
    document = json.loads(adapter.dump_json(found))
    assert adapter.validate_python(document) == found
    for name in ("settings", "distortion", "reading_weights", "point_shifts_mm", "labels"):
        del document[name]
    for name in ("cross_validation", "diagnosis"):
        del document[name]
    # Of the choice among sets by cross-validation, before scales were estimated.
    chosen = {"chosen": "none", "reason": "best", "candidates": [], "blocks": 5}
    assert adapter.validate_python(document | {"distortion": chosen}).distortion is not None
    old = adapter.validate_python(document)
    assert old.settings is None
    assert old.models == found.models
