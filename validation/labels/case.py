"""Case labels: detection of mislabelled control points in simulated and measured data."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from compute.calibration.calibrate import calibrate
from compute.calibration.mislabels.detector import find_label_errors
from compute.calibration.mislabels.evaluation import SensorReadings, evaluate
from compute.calibration.mislabels.hypothesis import KNOWN_SIGMA, Hypothesis
from compute.calibration.mislabels.repair import LabelFinding, repair
from compute.calibration.mislabels.sensor_search import search_sensor_labels
from validation.labels.simulated_data import (
    SIGMA_PX,
    WIDE_SIGMA_PX,
    Errors,
    Frame,
    LabelFrame,
    random_frames,
    wide_frames,
)
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.thesis_data import DFW_V500, load_test

SEED: Final = 514
SHARE: Final = 100
"""Frames of each of the ten kinds asked for."""
BESIDE_SHARE: Final = 25
CLEAN_SHARE: Final = 200
WIDE_SHARES: Final = ((40, 12), (100, 8), (300, 4))
"""Control points of a frame with a wide field, and frames of each kind with so many."""


@dataclass(frozen=True)
class Question:
    """Frames of one kind.

    Args:
        frame: which points; a number: of those of a wide field before lenses with distortion.
        errors: which errors.
        number: how many a frame.
        min_only: whether gross errors are ten standard deviations, no more.
        sigma_given: whether the noise is told to the search.
    """

    frame: Frame | int
    errors: Errors
    number: int = 0
    min_only: bool = False
    sigma_given: bool = True

    @property
    def wide(self) -> bool:
        """Whether lenses have distortion, and the noise is the frame's own."""
        return isinstance(self.frame, int)

    def frames(self, rng: np.random.Generator, count: int) -> Iterator[LabelFrame]:
        """Yield so many of them."""
        if isinstance(self.frame, int):
            return wide_frames(rng, count, self.frame, self.errors, self.number)
        return random_frames(rng, count, self.frame, self.errors, self.number, self.min_only)

    @property
    def name(self) -> str:
        """What is in the frames, in words."""
        what = {
            "none": "no error",
            "exchanged": "exchanged pairs of a sensor",
            "outlier": "gross errors of just 10 sigma" if self.min_only else "gross errors",
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
    ("outlier", 1),
    ("outlier", 2),
    ("outlier", 3),
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
    Question("random", "outlier", 3, sigma_given=False),
    *(Question(frame, "outlier", 3, min_only=True) for frame in _FRAMES),
)
"""What else is worth knowing."""


WIDE: Final = tuple(
    (Question(points, errors, number), share)
    for points, share in WIDE_SHARES
    for errors, number in (("none", 0), *(kind for kind in _KINDS if kind[1] < 3))
)
"""Wide fields, and how many frames."""


def ask(question: Question, frames: int, seed: int) -> Outcome:
    """Search ``frames`` simulated frames."""
    rng = np.random.default_rng(seed)
    exact = surplus = likelier = 0
    for frame in question.frames(rng, frames):
        findings = findings_of(frame, question.sigma_given)
        surplus += any((f.kind, f.sensor, f.points) not in frame.errors for f in findings)
        if frame.found_exactly(findings):
            exact += 1
        elif question.sigma_given and question.errors != "points" and not question.wide:
            likelier += _likelier(frame)
    return Outcome(frames, exact, surplus, likelier)


def findings_of(frame: LabelFrame, sigma_given: bool = True) -> tuple[LabelFinding, ...]:
    """Return what the search finds in a frame."""
    sigma = np.full(frame.readings_px.shape, frame.sigma_px) if sigma_given else None
    return find_label_errors(frame.points_mm, frame.readings_px, frame.sensors, sigma).findings


def _likelier(frame: LabelFrame) -> bool:
    """Return whether what is found is likelier than the truth in every sensor where it differs."""
    for column, sensor in enumerate(frame.sensors):
        truth = Hypothesis()
        for kind, name, points in sorted(frame.errors, key=str):
            if name == sensor.name and kind == "outlier":
                truth = truth.with_outlier(points[0] - 1)
            elif name == sensor.name:
                truth = truth.with_cycle(point - 1 for point in points)
        sigma = np.full(len(frame.points_mm), SIGMA_PX)
        readings = frame.readings_px[:, column]
        data = SensorReadings(frame.points_mm, readings, sigma, sensor, KNOWN_SIGMA)
        best = search_sensor_labels(data).best
        if best.hypothesis != truth:
            evaluated = evaluate(data, [truth], best.theta)
            if evaluated and evaluated[0].log_posterior > best.log_posterior:
                return False
    return True


def compute_tables(
    share: int = SHARE,
    clean_share: int = CLEAN_SHARE,
    beside_share: int = BESIDE_SHARE,
    wide: Sequence[tuple[Question, int]] = WIDE,
    seed: int = SEED,
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Ask everything, with so many frames of each kind."""
    asked = _answers([(one, share) for one in ASKED], seed, (0.0, 0.4))
    clean = _answers([(one, clean_share) for one in CLEAN], seed + 100, (0.4, 0.55))
    beside = _answers([(one, beside_share) for one in BESIDE], seed + 200, (0.55, 0.65))
    fields = _answers(wide, seed + 300, (0.65, 1.0))
    frames, exact = _sum(asked, "frames"), _sum(asked, "exact")
    clean_frames, alarms = _sum(clean, "frames"), _sum(clean, "surplus")
    wrong = [(question, outcome) for question, outcome in fields if question.number > 0]
    right = [(question, outcome) for question, outcome in fields if question.number == 0]
    low, high = WIDE_SIGMA_PX
    tables = (
        _table("errors that must be found, noise 1 px, known", asked),
        _table("clean frames, noise 1 px", clean),
        _table("beside them, noise 1 px", beside),
        _table(f"wide fields of lenses with distortion, noise {low:g} to {high:g} px", fields),
        _measured_table(),
    )
    return tables, (
        (
            f"Found exactly: {exact} of {frames} frames ({100.0 * exact / frames:.1f} %). "
            f"Clean frames with a finding: {alarms} of {clean_frames}."
        ),
        (
            f"Wide fields, seen through distortions of tens to a hundred pixels: "
            f"{_sum(wrong, 'exact')} of {_sum(wrong, 'frames')} frames with errors are found "
            f"exactly, and {_sum(right, 'surplus')} of {_sum(right, 'frames')} clean ones have a "
            "finding."
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


def _answers(
    questions: Sequence[tuple[Question, int]], seed: int, part: tuple[float, float]
) -> list[tuple[Question, Outcome]]:
    """Ask questions with so many frames each, the share ``part`` of the case's work."""
    found = []
    for k, (question, frames) in enumerate(questions):
        done = part[0] + (part[1] - part[0]) * k / len(questions)
        report_progress(done, f"{question.name}, {question.frame} points")
        found.append((question, ask(question, frames, seed + k)))
    return found


def _sum(outcomes: Sequence[tuple[Question, Outcome]], name: str) -> int:
    return sum(getattr(outcome, name) for _, outcome in outcomes)


def _table(title: str, outcomes: Sequence[tuple[Question, Outcome]]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = [
        (
            question.name,
            f"{question.frame} points",
            "known" if question.sigma_given else "not known",
            outcome.frames,
            outcome.exact,
            outcome.surplus,
            outcome.likelier
            if question.sigma_given and question.errors != "points" and not question.wide
            else None,
        )
        for question, outcome in outcomes
    ]
    headings = ("errors", "frame", "noise", "frames", "exact", "with others", "likelier than true")
    return ResultTable(title, headings, tuple(rows))


def _measured_table() -> ResultTable:
    """Return what is found in the measured frames, and what repairing it does to the residuals."""
    rows: list[tuple[Cell, ...]] = []
    geometry = [scale.geometry for scale in DFW_V500]
    for number in ("5.3", "5.4"):
        test = load_test(number)
        readings = np.column_stack(
            [scale.to_px(test.readings_mm[:, k]) for k, scale in enumerate(DFW_V500)]
        )
        findings = find_label_errors(test.points_mm, readings, geometry).findings
        repaired, _ = repair(findings, geometry, readings)
        before = calibrate(test.points_mm, readings, geometry).sensors
        after = calibrate(test.points_mm, repaired, geometry).sensors
        for k, scale in enumerate(DFW_V500):
            own = [f for f in findings if f.sensor in (scale.name, None)]
            text = "; ".join(f"{f.kind} {', '.join(map(str, f.points))}" for f in own)
            sure = min((f.probability for f in own), default=None)
            rows.append(
                (f"{number} {scale.name}", text or None, sure, before[k].rms_px, after[k].rms_px)
            )
    headings = ("test, sensor", "found", "probability", "RMS before, px", "RMS repaired, px")
    return ResultTable("measured frames (Appendix G), noise not known", headings, tuple(rows))


CASE: Final = TablesCase(
    "labels",
    "exchanged labels and outliers in 1,000 simulated frames and in the measured ones",
    "section 5.5, Appendix G (Tests 5.3 and 5.4)",
    compute_tables,
)
