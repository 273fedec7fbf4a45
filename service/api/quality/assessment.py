"""Assessment of a device's quality from control charts, with recommended actions."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from operator import attrgetter
from typing import Any, Final, Literal

import numpy as np
from sqlalchemy.orm import Session

from compute.quality.control_chart import ControlChart, ControlChartAlarm, control_chart
from service.api.devices.store import active
from service.api.quality import store
from service.api.quality.schema import Chart, ChartPoint, Quality
from service.database.models import QualityCheckRow, WatchSampleRow

WATCH_BASELINE: Final = 20
CHECK_BASELINE: Final = 8
_FLOOR_SIGMA: Final = 0.01  # of a residual: smaller changes say nothing of positions
_FLOOR_MM: Final = 0.002

_STILL_MM: Final = 1.0
"""A marker that scatters by more than this does not stand still."""

Recommendation = Literal["none", "observe", "check", "recalibrate"]


@dataclass(frozen=True)
class _Series:
    name: str
    meaning: str
    unit: str
    floor: float
    baseline: int
    at: tuple[datetime, ...]
    values: tuple[float, ...]
    acts: bool = True  # whether its signals are reasons to act


def quality(session: Session, device_id: str) -> Quality:
    """Return how a device does with the calibration and table that are active."""
    pointer = active(session, device_id)
    watch = store.watch_of(session, device_id)
    if pointer is None:
        return Quality(
            device_id=device_id,
            calibration_id=None,
            table_id=None,
            watch=watch,
            recommendation="observe",
            reasons=["no calibration is active: there are no points to judge by"],
            charts=[],
        )
    using = {"calibration_id": pointer.calibration_id, "table_id": pointer.table_id}
    seen = store.samples_with(session, device_id=device_id, **using)
    made = store.checks_with(session, device_id=device_id, **using)
    charts = [
        (series, control_chart(np.array(series.values), series.baseline, series.floor))
        for series in (*_of_watch(seen), *_of_checks(made))
    ]
    recommendation, reasons = _advice(charts, made)
    scatter = seen[-1].reference_scatter_mm if seen else None
    if scatter is not None and scatter > _STILL_MM:
        reasons.append(
            f"the reference marker does not stand still: it scatters by {scatter:.3g} mm; name one "
            "that does in the watch's settings"
        )
    return Quality(
        device_id=device_id,
        **using,
        watch=watch,
        recommendation=recommendation,
        reasons=reasons,
        charts=[_chart(series, chart) for series, chart in charts],
    )


def _of_watch(seen: Sequence[WatchSampleRow]) -> Iterable[_Series]:
    def series(
        name: str,
        meaning: str,
        unit: str,
        floor: float,
        value: Callable[[WatchSampleRow], Any],
        **options: bool,
    ) -> Iterator[_Series]:
        known = [(row.at, value(row)) for row in seen if value(row) is not None]
        if known:
            at, values = zip(*known, strict=True)
            yield _Series(name, meaning, unit, floor, WATCH_BASELINE, at, values, **options)

    meaning = "RMS residual of points with four or more sensors, in standard deviations"
    yield from series("residual", meaning, "sigma", _FLOOR_SIGMA, attrgetter("residual_sigma"))
    for axis, name in enumerate("xyz"):
        meaning = f"{name.upper()} of the reference marker"
        place = partial(_coordinate, axis=axis)
        yield from series(f"reference-{name}", meaning, "mm", _FLOOR_MM, place)
    meaning = "temperature of the device"
    warmth = attrgetter("temperature_c")
    yield from series("temperature", meaning, "degree Celsius", 0.1, warmth, acts=False)


def _coordinate(row: WatchSampleRow, axis: int) -> float | None:
    return None if row.reference_mm is None else row.reference_mm[axis]


def _of_checks(made: Sequence[QualityCheckRow]) -> Iterable[_Series]:
    names = dict.fromkeys(row.series for row in made)  # in the order of the first of each
    for name in names:
        own = [row for row in made if row.series == name]
        at = tuple(row.created_at for row in own)
        results = [row.result["result"] for row in own]
        if own[0].kind == "point-to-point":
            values = tuple(result["errors"]["mean"] for result in results)
            meaning = "mean error of the distance"
        elif results[0]["bias"] is not None:
            values = tuple(result["bias"] for result in results)
            meaning = "distance of the mean position from the reference"
        else:
            values = tuple(result["scatter"]["rms"] for result in results)
            meaning = "scatter of a still marker, RMS"
        yield _Series(name, meaning, "mm", _FLOOR_MM, CHECK_BASELINE, at, values)


def _advice(
    charts: Sequence[tuple[_Series, ControlChart]], made: Sequence[QualityCheckRow]
) -> tuple[Recommendation, list[str]]:
    lasting, brief, unknown = [], [], []
    for series, chart in charts:
        if not series.acts:
            continue
        if not chart.ready:
            unknown.append(
                f"{series.name}: {len(chart.values)} of {series.baseline} values that say what is "
                "normal"
            )
            continue
        value = f"{chart.values[-1]:.4g} {series.unit}, normally {chart.centre:.4g}"
        if chart.is_sustained:
            lasting.append(f"{series.name} stays changed: {value}")
        elif chart.alarms[-1] is not ControlChartAlarm.NONE:
            brief.append(f"{series.name} shows a {chart.alarms[-1].value}: {value}")
    for row in _failed(made):
        limit = row.asked["tolerance_mm"]
        lasting.append(f'{row.series}: the last check, "{row.id}", was not within {limit:g} mm')
    if lasting:
        return "recalibrate", lasting + brief
    if brief:
        return "check", brief
    if unknown or not charts:
        return "observe", unknown or ["nothing was watched or checked with this calibration yet"]
    return "none", []


def _failed(made: Sequence[QualityCheckRow]) -> list[QualityCheckRow]:
    """Return the checks that were not passed and after which none of the same markers was."""
    last = {
        (row.kind, str(row.asked.get("marker", row.asked.get("markers")))): row
        for row in made  # oldest first
        if row.passed is not None
    }
    return [row for row in last.values() if row.passed is False]


def _chart(series: _Series, chart: ControlChart) -> Chart:
    lower, upper = chart.limits
    known = bool(len(chart.values))
    return Chart(
        series=series.name,
        meaning=series.meaning,
        unit=series.unit,
        ready=chart.ready,
        baseline=chart.baseline,
        centre=chart.centre if known else None,
        lower=lower if chart.ready else None,
        upper=upper if chart.ready else None,
        points=[
            ChartPoint(
                measured_at=at, value=float(value), average=float(average), signal=signal.value
            )
            for at, value, average, signal in zip(
                series.at, chart.values, chart.ewma, chart.alarms, strict=True
            )
        ],
    )
