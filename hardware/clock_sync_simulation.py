"""Accuracy of clock synchronisation on simulated arrivals, beside linear regression.

The peer is a decayed linear regression of the arrivals on the device's clock, as in Klipper's
bulk sensors, with the same memory as ours.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.clock_sync import DECAY_NS, DeviceClock

MIN_DELAY_S: Final = 0.0005
"""The delay that every arrival has, which no estimator can see."""
SETTLED_S: Final = 10.0
LOST_AT_S: Final = 30.0
_TICKS_PER_S: Final = 1_000_000

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedClock:
    """A simulated device clock and the delays of its link.

    Args:
        name: in words.
        rate_hz: exposures per second.
        jitter_s: mean of the exponential delay beyond the shortest [s].
        skew: by how much the device's clock is fast.
        stall_every_s: time between stalls of the host [s]; 0: none.
        stall_s: mean length of a stall [s], during which all arrivals wait.
        drift_per_s: change of the skew [1/s].
        lost_s: what the device's clock loses at once, half a minute after the begin [s].
    """

    name: str
    rate_hz: float
    jitter_s: float
    skew: float
    stall_every_s: float = 0.0
    stall_s: float = 0.0
    drift_per_s: float = 0.0
    lost_s: float = 0.0


CASES: Final = (
    SimulatedClock("1 kHz, jitter 0.1 ms, 50 ppm", 1000.0, 1e-4, 5e-5),
    SimulatedClock("1 kHz, jitter 0.5 ms, stalls of 20 ms each second", 1000.0, 5e-4, 5e-5, 1.0,
         0.02),
    SimulatedClock("100 Hz, jitter 2 ms, stalls of 100 ms each 2 s", 100.0, 2e-3, -8e-5, 2.0, 0.1),
    SimulatedClock("10 Hz, jitter 2 ms", 10.0, 2e-3, 3e-5),
    SimulatedClock("1 kHz, jitter 0.1 ms, a clock 1 % fast", 1000.0, 1e-4, 1e-2),
    SimulatedClock("1 kHz, jitter 0.1 ms, skew drifting by 0.1 ppm/s", 1000.0, 1e-4, 5e-5,
         drift_per_s=1e-7),
    SimulatedClock("200 Hz, jitter 0.1 ms, 4 ms lost at 30 s", 200.0, 1e-4, 5e-5, lost_s=0.004),
)  # fmt: skip


@dataclass(frozen=True)
class ClockErrors:
    """RMS errors of host times beyond the shortest delay, after SETTLED_S [us].

    Args:
        name: the case.
        hull_us: of DeviceClock.
        regression_us: of the decayed regression.
        arrival_us: of the arrivals themselves.
        stated_us: what DeviceClock says of itself, RMS.
    """

    name: str
    hull_us: float
    regression_us: float
    arrival_us: float
    stated_us: float


def arrivals(case: SimulatedClock, seconds: float, seed: int) -> tuple[Array, Array]:
    """Return the times of N exposures and of their arrivals, shapes (N,) [s]."""
    rng = np.random.default_rng(seed)
    true_s = np.arange(int(case.rate_hz * seconds)) / case.rate_hz
    arrived_s = true_s + MIN_DELAY_S + rng.exponential(case.jitter_s, len(true_s))
    if case.stall_every_s:
        for begin in np.arange(1.0, seconds, case.stall_every_s):
            begin += rng.uniform(0.0, 0.5 * case.stall_every_s)
            end = begin + rng.exponential(case.stall_s)
            arrived_s = np.where((arrived_s > begin) & (arrived_s < end), end, arrived_s)
    return true_s, np.maximum.accumulate(arrived_s)


def device_ticks(case: SimulatedClock, true_s: Array) -> NDArray[np.int64]:
    """Return the device clock's ticks at times, shape (N,)."""
    device_s = true_s * (1.0 + case.skew) + 0.5 * case.drift_per_s * true_s**2
    device_s = device_s - case.lost_s * (true_s > LOST_AT_S)
    return np.round(device_s * _TICKS_PER_S).astype(np.int64)


def map_ticks(
    clock: DeviceClock, ticks: NDArray[np.int64], arrived_s: Array
) -> tuple[Array, Array]:
    """Return a clock's host times and their stated standard deviations, shapes (N,) [s]."""
    host, stated = [], []
    for tick, arrived in zip(ticks.tolist(), np.round(arrived_s * 1e9).tolist(), strict=True):
        host.append(clock.stamp(tick, round(arrived)).host_ns)
        stated.append(clock.uncertainty_ns)
    return np.array(host) * 1e-9, np.array(stated) * 1e-9


def regression_estimate(ticks: NDArray[np.int64], arrived_s: Array, rate_hz: float) -> Array:
    """Return host times by decayed linear regression, shape (N,) [s]."""
    keep = math.exp(-1e9 / (rate_hz * DECAY_NS))
    w = x = y = xx = xy = 0.0
    host = []
    for tick, arrived in zip((ticks / _TICKS_PER_S).tolist(), arrived_s.tolist(), strict=True):
        late = arrived - tick
        w, x, y = w * keep + 1.0, x * keep + tick, y * keep + late
        xx, xy = xx * keep + tick * tick, xy * keep + tick * late
        determinant = w * xx - x * x
        slope = (w * xy - x * y) / determinant if determinant > 0.0 and w > 3.0 else 0.0
        host.append(tick + (y - slope * x) / w + slope * tick)
    return np.array(host)


def errors(case: SimulatedClock, seconds: float = 60.0, seed: int = 1) -> ClockErrors:
    """Simulate a case and return the RMS errors of the estimators."""
    true_s, arrived_s = arrivals(case, seconds, seed)
    ticks = device_ticks(case, true_s)
    host_s, stated_s = map_ticks(DeviceClock(_TICKS_PER_S, 32), ticks, arrived_s)
    settled = true_s > SETTLED_S

    def rms_us(values: Array) -> float:
        return float(np.sqrt(np.mean(values[settled] ** 2))) * 1e6

    return ClockErrors(
        case.name,
        rms_us(host_s - true_s - MIN_DELAY_S),
        rms_us(regression_estimate(ticks, arrived_s, case.rate_hz) - true_s - MIN_DELAY_S),
        rms_us(arrived_s - true_s - MIN_DELAY_S),
        rms_us(stated_s),
    )
