"""Detector parameters, and exposures of nominal pixels."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.dark_counts import CountDistribution, count_distribution
from compute.parameter_checks import check_not_negative, check_positive, require

MAX_ELECTRONS: Final = 1e15
"""The largest mean of a pixel that is simulated; a float counts single electrons up to 9e15."""

_FULL_SIGMA: Final = 4.0  # of the read noise, below the mean count of a full well
_PIXEL_DIFFERENCES: Final = (
    "response_nonuniformity", "dark_nonuniformity", "offset_nonuniformity_counts", "blooming"
)  # fmt: skip


@dataclass(frozen=True)
class Detector:
    """Pixels of a line sensor and their analogue-to-digital converter.

    Light makes a Poisson number of electrons in a pixel, its mean the pixel's response times
    the light, plus the mean dark signal. A pixel holds at most the full well; of what is
    above, a share blooms into the neighbours. The amplifier adds Gaussian noise; the count is
    ``floor(electrons / electrons_per_count + offset_counts + 1/2)``, clipped to
    ``[0, 2**bits - 1]``. How the pixels differ is a matter of each device: ``DetectorArray``.

    Args:
        bits: resolution of the conversion, 8 to 16.
        electrons_per_count: gain of the conversion, positive.
        offset_counts: the count without light and noise, zero or positive.
        read_noise_electrons: standard deviation of the amplifier's noise.
        full_well_electrons: what a pixel holds at most, positive.
        ambient_electrons: mean electrons of even ambient light in each pixel and exposure.
        dark_electrons: mean electrons that a pixel collects in an exposure without light.
        response_nonuniformity: relative standard deviation of the response from pixel to pixel
            (PRNU), at most 0.2.
        dark_nonuniformity: that of the dark signal (DSNU), at most 10.
        offset_nonuniformity_counts: standard deviation of the offset from pixel to pixel.
        blooming: share of the charge above the full well that flows into the two neighbouring
            pixels, 0 to 1; the rest is drained.

    Raises:
        InvalidParameter: a value out of range.
    """

    bits: int
    electrons_per_count: float
    offset_counts: float
    read_noise_electrons: float
    full_well_electrons: float
    ambient_electrons: float
    dark_electrons: float = 0.0
    response_nonuniformity: float = 0.0
    dark_nonuniformity: float = 0.0
    offset_nonuniformity_counts: float = 0.0
    blooming: float = 0.0

    def __post_init__(self) -> None:
        require(8 <= self.bits <= 16, "be 8 to 16", bits=self.bits)
        check_positive(self, "electrons_per_count", "full_well_electrons")
        check_not_negative(
            self,
            "offset_counts",
            "read_noise_electrons",
            "ambient_electrons",
            "dark_electrons",
            "offset_nonuniformity_counts",
        )
        for name, highest in (
            ("response_nonuniformity", 0.2),  # five sigma below, a pixel sees nothing
            ("dark_nonuniformity", 10.0),
            ("blooming", 1.0),
        ):
            value = getattr(self, name)
            require(0.0 <= value <= highest, f"be from 0 to {highest:g}", **{name: value})

    @property
    def full_scale(self) -> int:
        """The largest count; a pixel that has it is saturated."""
        return int(2**self.bits) - 1

    @property
    def full_counts(self) -> int:
        """Lowest count at which a pixel may be saturated, 1 or more.

        A full well shows below full scale where the converter reaches farther than it.
        """
        well = self.full_well_electrons - _FULL_SIGMA * self.read_noise_electrons
        return min(
            self.full_scale, max(int(well / self.electrons_per_count + self.offset_counts), 1)
        )

    def convert(
        self, electrons: NDArray[np.float64], offset_counts: NDArray[np.float64] | None = None
    ) -> NDArray[np.uint16]:
        """Convert electrons, any shape, to counts of the same shape.

        Args:
            electrons: read noise included.
            offset_counts: the pixels' own offsets, same shape; None: the nominal one.
        """
        offset = self.offset_counts if offset_counts is None else offset_counts
        counts = np.floor(electrons / self.electrons_per_count + (offset + 0.5))
        return counts.clip(0, self.full_scale).astype(np.uint16)

    def upper_edges(self, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the electrons at which the count changes to the next one, same shape."""
        above = counts.astype(np.float64) + (0.5 - self.offset_counts)
        return above * self.electrons_per_count

    def expose(
        self, signal_electrons: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return the counts of one exposure of identical, nominal pixels.

        Every pixel has exactly the distribution of the model: pixels with signal are simulated
        step by step, and the many pixels without any draw their count from its distribution,
        worked out once.

        Args:
            signal_electrons: mean electrons of the markers, any shape; ambient light and dark
                signal come on top.
            rng: source of the noise.

        Returns:
            Counts of the same shape.

        Raises:
            InvalidParameter: the detector has non-uniformities or blooming, which need a
                device's pixels (``DetectorArray``); a signal that is not zero or positive.
        """
        for name in _PIXEL_DIFFERENCES:
            if (value := getattr(self, name)) != 0.0:
                raise InvalidParameter(
                    f"{name} is {value}; nominal pixels have 0, a DetectorArray has the others",
                    **{name: value},
                )
        counts = self.dark.draw(signal_electrons.size, rng)
        signal = signal_electrons.ravel()
        lit = np.flatnonzero(signal != 0.0)
        check_signal(signal[lit])
        collected = rng.poisson(signal[lit] + self._dark_mean).astype(np.float64)
        np.minimum(collected, self.full_well_electrons, out=collected)
        collected += self.read_noise_electrons * rng.standard_normal(len(lit))
        counts[lit] = self.convert(collected)
        return counts.reshape(signal_electrons.shape)

    @property
    def _dark_mean(self) -> float:
        return self.ambient_electrons + self.dark_electrons

    @cached_property
    def dark(self) -> CountDistribution:
        """The distribution of the counts of a nominal pixel without signal."""
        return self.unlit_counts(self._dark_mean)

    def unlit_counts(self, mean_electrons: float) -> CountDistribution:
        """Return the distribution of the counts of a pixel with nominal offset, without signal."""
        return count_distribution(
            self.convert,
            self.upper_edges,
            mean_electrons=mean_electrons,
            full_well_electrons=self.full_well_electrons,
            read_noise_electrons=self.read_noise_electrons,
        )


def check_signal(signal_electrons: NDArray[np.float64]) -> None:
    """Check mean electrons, of any shape.

    Raises:
        InvalidParameter: a value is negative, NaN or above ``MAX_ELECTRONS``.
    """
    wrong = ~((signal_electrons >= 0.0) & (signal_electrons <= MAX_ELECTRONS))
    if wrong.any():
        value = float(signal_electrons[wrong][0])
        raise InvalidParameter(
            f"signal_electrons has {value}; it must be zero or positive, and at most "
            f"{MAX_ELECTRONS:g}",
            signal_electrons=value,
        )
