"""Label errors in simulated and measured control data: how many are found, and which."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from compute.calibration.labels.evidence import KNOWN
from compute.calibration.labels.find import find_label_errors
from compute.calibration.labels.finding import LabelFinding
from compute.calibration.labels.hypothesis import Hypothesis
from compute.calibration.labels.mend import repair
from compute.calibration.labels.sensor_search import SensorReadings, judge, search_labels
from compute.calibration.run import calibrate
from validation.label_frames import SIGMA_PX, Errors, Frame, LabelFrame, random_frames
from validation.tables import Cell, ResultTable, TablesCase
from validation.thesis_data import DFW_V500, load_test

SEED: Final = 514
SHARE: Final = 100
"""Frames of each of the ten kinds asked for."""
BESIDE_SHARE: Final = 25
CLEAN_SHARE: Final = 200


@dataclass(frozen=True)
class Question:
    """Frames of one kind.

    Args:
        frame: which points.
        errors: which errors.
        number: how many a frame.
        least_only: whether gross errors are ten standard deviations, no more.
        sigma_given: whether the noise is told to the search.
    """

    frame: Frame
    errors: Errors
    number: int = 0
    least_only: bool = False
    sigma_given: bool = True

    @property
    def name(self) -> str:
        """What is in the frames, in words."""
        what = {
            "none": "no error",
            "exchanged": "exchanged pairs of a sensor",
            "wrong": "gross errors of just 10 sigma" if self.least_only else "gross errors",
            "points": "exchanged points",
        }[self.errors]
        return what if self.errors == "none" else f"{self.number} {what}"


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    Args:
        frames: looked at.
        exact: found exactly: the same errors, no fewer and no more.
        surplus: with findings that are none of the errors.
        likelier: of those not exact, frames whose findings are likelier than the truth, given
            the readings: no search can tell.
    """

    frames: int
    exact: int
    surplus: int
    likelier: int


_KINDS: Final[tuple[tuple[Errors, int], ...]] = (
    ("exchanged", 1),
    ("exchanged", 2),
    ("wrong", 1),
    ("wrong", 2),
    ("wrong", 3),
)
_FRAMES: Final[tuple[Frame, ...]] = ("thesis", "random")

ASKED: Final = tuple(
    Question(frame, errors, number) for frame in _FRAMES for errors, number in _KINDS
)
"""The thousand frames."""

CLEAN: Final = tuple(
    Question(frame, "none", sigma_given=given) for frame in _FRAMES for given in (True, False)
)

BESIDE: Final = (
    *(Question(frame, "points", number) for frame in _FRAMES for number in (1, 2)),
    Question("random", "exchanged", 2, sigma_given=False),
    Question("random", "wrong", 3, sigma_given=False),
    *(Question(frame, "wrong", 3, least_only=True) for frame in _FRAMES),
)
"""What else is worth knowing."""


def ask(question: Question, frames: int, seed: int) -> Outcome:
    """Search ``frames`` simulated frames."""
    rng = np.random.default_rng(seed)
    exact = surplus = likelier = 0
    for frame in random_frames(
        rng, frames, question.frame, question.errors, question.number, question.least_only
    ):
        findings = findings_of(frame, question.sigma_given)
        surplus += any((f.kind, f.sensor, f.points) not in frame.errors for f in findings)
        if frame.found_exactly(findings):
            exact += 1
        elif question.sigma_given and question.errors != "points":
            likelier += _likelier(frame)
    return Outcome(frames, exact, surplus, likelier)


def findings_of(frame: LabelFrame, sigma_given: bool = True) -> tuple[LabelFinding, ...]:
    """Return what the search finds in a frame."""
    sigma = np.full(frame.readings_px.shape, SIGMA_PX) if sigma_given else None
    return find_label_errors(frame.points_mm, frame.readings_px, frame.sensors, sigma).findings


def _likelier(frame: LabelFrame) -> bool:
    """Return whether what is found is likelier than the truth in every sensor where it differs."""
    for column, sensor in enumerate(frame.sensors):
        truth = Hypothesis()
        for kind, name, points in sorted(frame.errors, key=str):
            if name == sensor.name and kind == "wrong":
                truth = truth.with_wrong(points[0] - 1)
            elif name == sensor.name:
                truth = truth.with_cycle(point - 1 for point in points)
        sigma = np.full(len(frame.points_mm), SIGMA_PX)
        readings = frame.readings_px[:, column]
        data = SensorReadings(frame.points_mm, readings, sigma, sensor, KNOWN)
        best = search_labels(data).best
        if best.hypothesis != truth:
            judged = judge(data, [truth], best.theta)
            if judged and judged[0].log_posterior > best.log_posterior:
                return False
    return True


def work_out(
    share: int = SHARE, clean_share: int = CLEAN_SHARE, beside_share: int = BESIDE_SHARE
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Ask everything, with so many frames of each kind."""
    asked = [(one, ask(one, share, SEED + k)) for k, one in enumerate(ASKED)]
    clean = [(one, ask(one, clean_share, SEED + 100 + k)) for k, one in enumerate(CLEAN)]
    beside = [(one, ask(one, beside_share, SEED + 200 + k)) for k, one in enumerate(BESIDE)]
    frames, exact = (sum(getattr(o, name) for _, o in asked) for name in ("frames", "exact"))
    clean_frames, alarms = (sum(getattr(o, n) for _, o in clean) for n in ("frames", "surplus"))
    tables = (
        _table("errors that must be found, noise 1 px, known", asked),
        _table("clean frames, noise 1 px", clean),
        _table("beside them, noise 1 px", beside),
        _measured_table(),
    )
    return tables, (
        (
            f"Found exactly: {exact} of {frames} frames ({100.0 * exact / frames:.1f} %). "
            f"Clean frames with a finding: {alarms} of {clean_frames}."
        ),
        (
            "Gross errors are 10 to 300 standard deviations, evenly in the logarithm; exchanged "
            "readings 10 apart or more; in half of the frames all in one sensor. Errors of just "
            "10 are often hidden where a point is one of few that hold its sensor's parameters: "
            "19 readings and 7 parameters leave 12 to spare, and a camera bends towards such a "
            "reading. What is found then is likelier than the truth in the column beside."
        ),
        (
            "Measured: cam4 of Test 5.3 has the labels 14 and 16 exchanged. In Test 5.4 the "
            "reading of point 17 by cam1 is off, and cam4's next best explanation is the same "
            "point: its given place may be what is wrong."
        ),
    )


def _table(title: str, outcomes: Sequence[tuple[Question, Outcome]]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = [
        (
            question.name,
            f"{question.frame} points",
            "known" if question.sigma_given else "not known",
            outcome.frames,
            outcome.exact,
            outcome.surplus,
            outcome.likelier if question.sigma_given and question.errors != "points" else None,
        )
        for question, outcome in outcomes
    ]
    headings = ("errors", "frame", "noise", "frames", "exact", "with others", "likelier than true")
    return ResultTable(title, headings, tuple(rows))


def _measured_table() -> ResultTable:
    """Return what is found in the measured frames, and what mending it does to the residuals."""
    rows: list[tuple[Cell, ...]] = []
    geometry = [scale.geometry for scale in DFW_V500]
    for number in ("5.3", "5.4"):
        test = load_test(number)
        readings = np.column_stack(
            [scale.to_px(test.readings_mm[:, k]) for k, scale in enumerate(DFW_V500)]
        )
        findings = find_label_errors(test.points_mm, readings, geometry).findings
        mended, _ = repair(findings, geometry, readings)
        before = calibrate(test.points_mm, readings, geometry).sensors
        after = calibrate(test.points_mm, mended, geometry).sensors
        for k, scale in enumerate(DFW_V500):
            own = [f for f in findings if f.sensor in (scale.name, None)]
            text = "; ".join(f"{f.kind} {', '.join(map(str, f.points))}" for f in own)
            sure = min((f.probability for f in own), default=None)
            rows.append(
                (f"{number} {scale.name}", text or None, sure, before[k].rms_px, after[k].rms_px)
            )
    headings = ("test, sensor", "found", "probability", "RMS before, px", "RMS mended, px")
    return ResultTable("measured frames (Appendix G), noise not known", headings, tuple(rows))


CASE: Final = TablesCase(
    "labels",
    "wrong and exchanged labels in 1,000 simulated frames and in the measured ones",
    "section 5.5, Appendix G (Tests 5.3 and 5.4)",
    work_out,
)
