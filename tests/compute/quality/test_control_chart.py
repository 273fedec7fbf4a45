"""Control charts: no alarm without a change, an alarm with one."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.quality.control_chart import ControlChart, ControlChartAlarm, control_chart


def first_signal(chart: ControlChart, kind: ControlChartAlarm | None = None) -> int | None:
    for index, signal in enumerate(chart.alarms):
        if signal is not ControlChartAlarm.NONE and kind in (None, signal):
            return index
    return None


def run_lengths(shift: float, kind: ControlChartAlarm, charts: int = 150) -> list[int]:
    """Values until the first signal, with a baseline so long that the limits are known."""
    lengths = []
    for seed in range(charts):
        values = np.random.default_rng(seed).standard_normal(1500)
        values[500:] += shift
        found = first_signal(control_chart(values, baseline=500), kind)
        lengths.append((found or len(values)) - 499)
    return lengths


def test_false_alarms_are_as_rare_as_the_limits_say() -> None:
    # Once in 370 for either kind, 345 when runs end after 1000 values; 28 is the mean's deviation.
    assert 260 < np.mean(run_lengths(0.0, ControlChartAlarm.JUMP)) < 430
    assert 260 < np.mean(run_lengths(0.0, ControlChartAlarm.DRIFT)) < 430


def test_with_few_values_to_tell_what_is_normal_alarms_are_as_rare() -> None:
    # By themselves the limits of 20 values are often too near: Student's are not.
    found = {ControlChartAlarm.JUMP: 0, ControlChartAlarm.DRIFT: 0}
    charts, judged = 400, 100
    for seed in range(charts):
        chart = control_chart(np.random.default_rng(seed).standard_normal(20 + judged))
        found[ControlChartAlarm.JUMP] += chart.alarms.count(ControlChartAlarm.JUMP)
        found[ControlChartAlarm.DRIFT] += chart.alarms.count(ControlChartAlarm.DRIFT)
    for count in found.values():
        assert count / (charts * judged) < 2 / 370


def test_nothing_stays_changed_by_chance() -> None:
    """Days of four charts with a value each ten minutes: a week alarms 3 times in a hundred."""
    days = 40
    alarmed = 0
    for day in range(days):
        random = np.random.default_rng(day)
        alarmed += any(
            control_chart(values[:end]).is_sustained
            for values in random.standard_normal((4, 164))
            for end in range(28, 165, 8)
        )
    assert alarmed <= 2


@pytest.mark.parametrize(("shift", "values"), [(12.0, 3), (7.0, 8), (-7.0, 16)])
def test_what_stays_changed_is_told(shift: float, values: int) -> None:
    for seed in range(30):
        series = np.random.default_rng(seed).standard_normal(20 + values)
        series[20:] += shift
        chart = control_chart(series)
        assert chart.is_sustained
        back = np.append(series, np.random.default_rng(seed + 100).standard_normal(8))
        assert not control_chart(back).is_sustained, "it was repaired"


@pytest.mark.slow
def test_a_small_shift_is_found_by_the_average_and_a_large_one_at_once() -> None:
    # Of one standard deviation: 10 values by the average (Lucas and Saccucci), 44 by single ones.
    assert 8 < np.mean(run_lengths(1.0, ControlChartAlarm.DRIFT)) < 12
    assert 35 < np.mean(run_lengths(1.0, ControlChartAlarm.JUMP)) < 55
    assert np.median(run_lengths(6.0, ControlChartAlarm.JUMP)) == 1


def test_a_slow_drift_is_found_before_it_is_a_jump() -> None:
    values = np.random.default_rng(3).standard_normal(200)
    values[20:] += 0.05 * np.arange(180)
    found = first_signal(control_chart(values))
    assert found is not None
    assert 0.05 * (found - 20) < 3.0


def test_without_a_baseline_there_is_no_signal() -> None:
    values = np.array([1.0, 2.0, 50.0])
    chart = control_chart(values, baseline=8)
    assert (chart.ready, chart.baseline, first_signal(chart)) == (False, 3, None)
    assert control_chart(np.empty(0)).ready is False
    assert control_chart(np.arange(8.0), baseline=8).ready is True


def test_values_that_hardly_scatter_are_measured_by_the_floor() -> None:
    values = np.full(40, 5.0)
    values[-1] = 5.001
    assert first_signal(control_chart(values)) == 39
    assert first_signal(control_chart(values, floor=0.01)) is None


def test_limits_do_not_depend_on_the_unit() -> None:
    values = np.random.default_rng(5).normal(3.0, 1.0, 60)
    values[40:] += 2.0
    one, other = control_chart(values), control_chart(1e3 * values - 7.0)
    assert one.alarms == other.alarms
    assert first_signal(one) is not None


@pytest.mark.parametrize(
    ("values", "baseline", "words"),
    [([1.0] * 9, 3, "at least 8"), ([1.0, np.nan] * 10, 20, "not a number")],
)
def test_what_is_refused(values: list[float], baseline: int, words: str) -> None:
    with pytest.raises(InvalidParameter, match=words):
        control_chart(np.array(values), baseline)
