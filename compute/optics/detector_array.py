"""Detectors of a device: fixed pattern, background light, blooming, noise."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from compute.errors import InvalidParameter
from compute.optics.detector import Detector, check_signal
from compute.optics.pixel_noise import SMOOTH_READ_NOISE_ELECTRONS, PixelNoise
from compute.parameter_checks import require, require_shape

Array = NDArray[np.float64]


def bloom(
    charge: Array, linked: NDArray[np.bool_], full_well: float, share: float
) -> tuple[Array, Array]:
    """Distribute charge above the full well to the neighbours until none is above it.

    Of the charge that leaves a pixel, half the share goes to each of its neighbours and the
    rest is drained; what goes to a neighbour that is not there is lost. With q the charge and
    f >= 0 what leaves a pixel in all, the pixels keep ``q_i - f_i + share/2 (f_i-1 + f_i+1)``,
    at most the full well, and f is the smallest flow that does it: zero where the well is not
    full. The pixels above are linear equations, banded; those that they fill join them.

    Args:
        charge: electrons of the pixels, shape (P,).
        linked: whether pixel i + 1 is the right neighbour of pixel i, shape (P - 1,).
        full_well: what a pixel holds at most [electrons].
        share: share of the excess that flows on, 0 to 1.

    Returns:
        What the pixels keep, and what left each of them in all, both of shape (P,).
    """
    flow = np.zeros_like(charge)
    retained = charge
    full = charge > full_well
    added = full
    half = 0.5 * share
    while added.any():
        # The set only grows: more pixels that pass charge on fill no well less.
        full = full | added
        at = np.flatnonzero(full)
        # One unknown more, which is zero: the solver refuses a single one.
        band = np.zeros((2, len(at) + 1))
        band[0] = 1.0
        band[1, : len(at) - 1] = np.where((np.diff(at) == 1) & linked[at[:-1]], -half, 0.0)
        excess = np.append(charge[at] - full_well, 0.0)
        flow[at] = solveh_banded(band, excess, lower=True)[:-1]
        retained = charge - flow
        retained[1:] += half * np.where(linked, flow[:-1], 0.0)
        retained[:-1] += half * np.where(linked, flow[1:], 0.0)
        added = (retained > full_well) & ~full
    return np.minimum(retained, full_well), flow


_RESPONSE, _DARK, _OFFSET = range(3)


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """Fixed pattern of the pixels of S sensors: response, dark signal, offset.

    Args:
        response: electrons per electron of a nominal pixel, shape (S, P).
        dark_electrons: mean dark signal of an exposure, shape (S, P).
        offset_counts: the count without light and dark signal, shape (S, P).
    """

    response: Array
    dark_electrons: Array
    offset_counts: Array


def fixed_pattern(detector: Detector, sensors: int, pixels: int, seed: int) -> FixedPattern:
    """Draw the fixed pattern of S sensors; a sensor depends on its number and the seed alone.

    The response and the offset are normal; the dark signal is log-normal, as it is positive
    and has pixels that stand out. Terms as in EMVA 1288: PRNU, DSNU.

    Args:
        detector: nominal values and their deviations from pixel to pixel.
        sensors: S.
        pixels: P.
        seed: zero or positive.
    """

    def normal(kind: int) -> Array:
        seeds = [np.random.SeedSequence(seed, spawn_key=(n, kind)) for n in range(sensors)]
        rows = [np.random.default_rng(sequence).standard_normal(pixels) for sequence in seeds]
        return np.array(rows).reshape(sensors, pixels)

    response = 1.0 + detector.response_nonuniformity * normal(_RESPONSE)
    # exp of a normal number has the mean exp(s^2 / 2) and the relative variance exp(s^2) - 1.
    log_deviation = np.sqrt(np.log1p(detector.dark_nonuniformity**2))
    relative = np.exp(log_deviation * normal(_DARK) - 0.5 * log_deviation**2)
    offset = detector.offset_counts + detector.offset_nonuniformity_counts * normal(_OFFSET)
    return FixedPattern(response.clip(0.0), detector.dark_electrons * relative, offset)


_REACH_SIGMA: Final = 9.0  # beyond it lies less than 1e-18

_FIRST_REACH: Final = 8


class DetectorArray:
    """S sensors of P pixels of one kind, each with its own fixed pattern.

    An exposure goes: light times response; Poisson number of electrons of signal, background
    and dark signal; full well with blooming; read noise; conversion with the pixel's offset.

    Args:
        detector: the parameters.
        sensors: S, at least 1.
        pixels: P of each, at least 1.
        pattern_seed: seed of the pixels' differences, zero or positive; another device has
            another.
        background_electrons: mean electrons of ambient light in nominal pixels, on top of the
            detector's even ambient light, shape (S, P); None: none.

    Raises:
        InvalidParameter: a number out of range, a background of another shape or with values
            that are not zero or positive.
    """

    def __init__(
        self,
        detector: Detector,
        sensors: int,
        pixels: int,
        *,
        pattern_seed: int = 0,
        background_electrons: Array | None = None,
    ) -> None:
        require(sensors >= 1, "be at least 1", sensors=sensors)
        require(pixels >= 1, "be at least 1", pixels=pixels)
        require(pattern_seed >= 0, "be at least 0", pattern_seed=pattern_seed)
        self.detector = detector
        self.pattern: FixedPattern = fixed_pattern(detector, sensors, pixels, pattern_seed)
        shape = (sensors, pixels)
        ambient = np.full(shape, detector.ambient_electrons)
        if background_electrons is not None:
            _check_background(background_electrons, shape)
            ambient = ambient + background_electrons
        self._shape = shape
        self._response = self.pattern.response.ravel()
        self._offset = self.pattern.offset_counts.ravel()
        self._unlit = ambient.ravel() * self._response + self.pattern.dark_electrons.ravel()
        self._dark, stepped = _dark_counts(detector, self._unlit, self._offset)
        self._stepped = np.flatnonzero(stepped)

    @property
    def unlit_electrons(self) -> Array:
        """Mean electrons without signal: background and dark signal, shape (S, P)."""
        return self._unlit.reshape(self._shape)

    def expose(self, signal_electrons: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return the counts of exposures.

        Pixels with signal are simulated step by step, and so is what blooms. The many without
        draw their count from tables: exact where all pixels are the same, otherwise within
        what ``PixelNoise`` says. A detector whose pixels differ and whose read noise is below
        0.8 electrons, or a pixel near its full well without signal, goes step by step, too.

        Args:
            signal_electrons: mean electrons of the markers in nominal pixels, shape
                (..., S, P); background and dark signal come on top.
            rng: source of the noise.

        Returns:
            Counts of the same shape.

        Raises:
            InvalidParameter: a signal of another shape, or not zero or positive.
        """
        right = f"end with (sensors, pixels) {self._shape}"
        valid = signal_electrons.shape[-2:] == self._shape
        require_shape(valid, right, signal_electrons=signal_electrons)
        size = len(self._unlit)
        signal = signal_electrons.reshape(-1)
        exposures = len(signal) // size
        if self._dark is None:
            counts = np.empty(len(signal), dtype=np.uint16)
        else:
            counts = self._dark(exposures, rng).reshape(-1)
        stepped = signal != 0.0
        if len(self._stepped):
            stepped.reshape(exposures, size)[:, self._stepped] = True
        index = np.flatnonzero(stepped)
        lit = signal[index]
        check_signal(lit)
        pixel = index % size
        mean = lit * self._response[pixel] + self._unlit[pixel]
        charge = rng.poisson(mean).astype(np.float64)
        if self.detector.blooming > 0.0 and charge.max(initial=0.0) > self._full_well:
            index, charge = self._bloom(index, charge, rng)
            pixel = index % size
        else:
            np.minimum(charge, self._full_well, out=charge)
        charge += self.detector.read_noise_electrons * rng.standard_normal(len(charge))
        counts[index] = self.detector.convert(charge, self._offset[pixel])
        return counts.reshape(signal_electrons.shape)

    @property
    def _full_well(self) -> float:
        return self.detector.full_well_electrons

    def _bloom(
        self, index: NDArray[np.int64], charge: Array, rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], Array]:
        """Bloom, with the charge of pixels without signal where it flows to them.

        Args:
            index: ascending indices among all pixels, shape (M,).
            charge: electrons collected there, shape (M,).
            rng: source of the noise.

        Returns:
            The indices of all pixels with charge, and what they keep, both of shape (N,).
        """
        pixels = self._shape[1]
        reach = _FIRST_REACH
        while True:
            column = index % pixels
            linked = (np.diff(index) == 1) & (column[:-1] != pixels - 1)
            retained, flow = bloom(charge, linked, self._full_well, self.detector.blooming)
            over = flow > 0.0
            left = over & (column != 0) & ~np.concatenate([[False], linked])
            right = over & (column != pixels - 1) & ~np.concatenate([linked, [False]])
            if not (left.any() or right.any()):
                return index, retained
            # Charge flows to pixels that were not asked yet: draw what they collected.
            step = np.arange(1, reach + 1)
            to_left = np.minimum(step, column[left, None])
            to_right = np.minimum(step, (pixels - 1 - column)[right, None])
            neighbours = [
                (index[left, None] - to_left).ravel(),
                (index[right, None] + to_right).ravel(),
            ]
            new = np.setdiff1d(np.concatenate(neighbours), index)
            drawn = rng.poisson(self._unlit[new % len(self._unlit)]).astype(np.float64)
            index = np.concatenate([index, new])
            order = np.argsort(index)
            index, charge = index[order], np.concatenate([charge, drawn])[order]
            reach *= 2


def _dark_counts(
    detector: Detector, mean_electrons: Array, offset_counts: Array
) -> tuple[Callable[[int, np.random.Generator], NDArray[np.uint16]] | None, NDArray[np.bool_]]:
    """Return what draws the counts of exposures without signal, and which pixels it cannot.

    None: it cannot draw any; these pixels are simulated step by step.
    """
    reach = mean_electrons + _REACH_SIGMA * np.sqrt(mean_electrons) + 40.0
    near_full = reach > detector.full_well_electrons
    alike = np.ptp(mean_electrons) == 0.0 and np.ptp(offset_counts) == 0.0
    if alike and not (near_full.any() and detector.blooming > 0.0):
        identical, pixels = detector.unlit_counts(float(mean_electrons[0])), len(mean_electrons)
        return lambda exposures, rng: identical.draw(exposures * pixels, rng), np.zeros_like(
            near_full
        )
    if detector.read_noise_electrons < SMOOTH_READ_NOISE_ELECTRONS or near_full.all():
        return None, np.ones_like(near_full)
    # Pixels near their full well have no table; any mean that has one will do for them.
    tabled = np.where(near_full, mean_electrons[~near_full].max(), mean_electrons)
    return PixelNoise(detector, tabled, offset_counts).draw, near_full


def _check_background(background_electrons: Array, shape: tuple[int, int]) -> None:
    right = f"be (sensors, pixels) {shape}"
    valid = background_electrons.shape == shape
    require_shape(valid, right, background_electrons=background_electrons)
    wrong = ~((background_electrons >= 0.0) & (background_electrons < np.inf))
    if wrong.any():
        value = float(background_electrons[wrong][0])
        raise InvalidParameter(
            f"background_electrons has {value}; it must be zero or positive",
            background_electrons=value,
        )
