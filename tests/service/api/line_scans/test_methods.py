"""The settings that clients give are compute's: same fields, defaults and bounds."""

import json
from dataclasses import MISSING, fields
from typing import Any

import numpy as np
import pytest
from annotated_types import Ge, Gt, Le, Lt
from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from compute.errors import InvalidParameter
from compute.signal.detection.matched_filter import gaussian_filter
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from service.api.line_scans import chain_steps as steps
from service.api.line_scans import mask_method, methods
from service.api.line_scans.examples import NEW_LINE_SCANS
from service.api.line_scans.schema import LineScanRequest
from tests.service.api.line_scans.scan_lines import scenes

METHOD: TypeAdapter[methods.Method] = TypeAdapter(methods.Method)
OURS: tuple[Any, ...] = (
    methods.CentroidMethod, methods.FitMethod, methods.MatchedMethod, steps.ChainMethod,
    steps.Median, steps.Butterworth, steps.Fir, steps.Mask, steps.Polynomial, steps.Bridged,
    steps.Areas, steps.Valley, steps.Slope, mask_method.MaskMethod,
)  # fmt: skip
# What has no default, to make one of each.
NEEDED: dict[Any, dict[str, Any]] = {
    steps.Median: {"aperture": 3},
    steps.Butterworth: {"order": 4, "cutoff": 0.4},
    steps.Fir: {"taps": 5, "cutoff": 0.4},
    mask_method.MaskMethod: {"profile_id": "coda-mpx30"},
}
# Narrower than compute's, or compute's own bound lies elsewhere: tested below, or no bound there.
NARROWER = {
    "cutoff", "average", "width_log_sigma", "false_alarms_per_line", "length_px", "background",
    "separation", "mask", "smoothing", "search", "areas", "line_filter", "filter_after",
    "repeats", "rounds", "max_peaks", "aperture", "order", "ambiguity_probability",
    "misfit_probability",
}  # fmt: skip

# A part with compute's defaults; what a given width decides; what a request may cost.
DEFAULTS_OF_THEIR_OWN = {
    (steps.Bridged, "mask"), (methods.FitMethod, "further_peaks"), (steps.ChainMethod, "max_peaks")
}  # fmt: skip

# What compute is given beside its settings.
OF_THEIR_OWN = {
    "method", "kind", "width_px", "length_px", "shape", "estimator", "template", "profile_id",
    "sensors",
}  # fmt: skip


def base_of(ours: Any) -> Any:
    return ours.__mro__[1]


def default_of(field: Any) -> Any:
    return field.default_factory() if field.default_factory is not MISSING else field.default


@pytest.mark.parametrize("ours", OURS)
def test_fields_and_defaults_are_compute_s(ours: Any) -> None:
    own = {field.name: field for field in fields(ours)}
    for field in fields(base_of(ours)):
        default = default_of(field)
        found = default_of(own.pop(field.name))
        if hasattr(default, "__dataclass_fields__"):
            assert vars(found) == vars(default)
        elif (ours, field.name) not in DEFAULTS_OF_THEIR_OWN:
            assert found == default
    assert set(own) <= OF_THEIR_OWN


def bounds(info: FieldInfo) -> list[tuple[float, float]]:
    """Pairs of a value at a bound, which is allowed, and one beyond."""
    found: list[tuple[float, float]] = []
    whole = info.annotation is int
    for one in info.metadata:
        match one:
            case Ge(ge=limit):
                found.append((limit, limit - (1 if whole else 1e-9 * max(abs(limit), 1e-6))))
            case Le(le=limit):
                found.append((limit, limit + (1 if whole else 1e-9 * max(abs(limit), 1e-6))))
            case Gt() | Lt():
                raise AssertionError("an open bound has a test of its own")
    return found


def numbered(ours: Any) -> list[tuple[Any, str, float, float]]:
    return [
        (ours, name, at, beyond)
        for name, info in ours.__pydantic_fields__.items()
        if name not in NARROWER
        for at, beyond in bounds(info)
        if not (ours is methods.MatchedMethod and name == "width_px")
    ]


@pytest.mark.parametrize(
    ("ours", "name", "at", "beyond"), [case for ours in OURS for case in numbered(ours)]
)
def test_bounds_are_compute_s(ours: Any, name: str, at: float, beyond: float) -> None:
    given = NEEDED.get(ours, {})
    ours(**given | {name: at})
    with pytest.raises(ValidationError):
        ours(**given | {name: beyond})
    base_of(ours)(**given | {name: at})
    with pytest.raises(InvalidParameter, match=name):
        base_of(ours)(**given | {name: beyond})


def test_further_peaks_are_looked_for_where_the_width_is_known() -> None:
    for given, expected in (
        ({}, False),
        ({"width_px": 1.0}, True),
        ({"further_peaks": True}, True),
        ({"width_px": 1.0, "further_peaks": False}, False),
    ):
        assert methods.FitMethod(**given).further_peaks is expected
        method = METHOD.validate_json(json.dumps({"method": "fit", **given}), strict=True)
        assert isinstance(method, methods.FitMethod)
        assert method.further_peaks is expected


def test_the_matched_filter_s_width_has_its_bounds() -> None:
    for at, beyond in bounds(methods.MatchedMethod.__pydantic_fields__["width_px"]):
        methods.MatchedMethod(width_px=at)
        with pytest.raises(ValidationError):
            methods.MatchedMethod(width_px=beyond)
        with pytest.raises(InvalidParameter, match="width_px"):
            gaussian_filter(beyond)


def test_the_passive_chain_is_compute_s() -> None:
    ours, theirs = (chain.run(scenes()).peaks for chain in (steps.passive_chain(), PASSIVE))
    assert ours.count.tolist() == theirs.count.tolist()
    assert np.array_equal(ours.position_px, theirs.position_px, equal_nan=True)
    text = METHOD.dump_json(steps.passive_chain())
    assert METHOD.validate_json(text, strict=True) == steps.passive_chain()


PASSIVE = SignalChain.passive()


@pytest.mark.parametrize("name", NEW_LINE_SCANS)
def test_examples_are_of_their_methods(name: str) -> None:
    text = json.dumps(NEW_LINE_SCANS[name]["value"])
    request = TypeAdapter(LineScanRequest).validate_json(text, strict=True)
    assert request.method.method == name
    assert isinstance(request.method, OURS)
