"""The detector: photon noise, full well, read noise and conversion to counts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.dark import CountDistribution, count_distribution


@dataclass(frozen=True)
class Detector:
    """The pixels of a line sensor and their converter.

    A pixel collects a Poisson number of electrons, at most the full well; the amplifier adds
    Gaussian noise; the count is ``floor(electrons / electrons_per_count + offset_counts + 1/2)``,
    clipped to ``[0, 2**bits - 1]``.

    Args:
        bits: resolution of the conversion, 8 to 16.
        electrons_per_count: gain of the conversion, positive.
        offset_counts: the count without light and noise, zero or positive.
        read_noise_electrons: standard deviation of the amplifier's noise.
        full_well_electrons: what a pixel holds at most, positive.
        ambient_electrons: mean electrons of ambient light in each pixel and exposure.

    Raises:
        InvalidParameter: a value is outside of what is said here.
    """

    bits: int
    electrons_per_count: float
    offset_counts: float
    read_noise_electrons: float
    full_well_electrons: float
    ambient_electrons: float

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16:
            raise InvalidParameter(f"bits is {self.bits}; it must be 8 to 16", bits=self.bits)
        for name, positive in (
            ("electrons_per_count", True),
            ("offset_counts", False),
            ("read_noise_electrons", False),
            ("full_well_electrons", True),
            ("ambient_electrons", False),
        ):
            value = getattr(self, name)
            if not (0.0 <= value < np.inf) or (positive and value == 0.0):
                right = "positive" if positive else "zero or positive"
                raise InvalidParameter(f"{name} is {value}; it must be {right}", **{name: value})

    @property
    def full_scale(self) -> int:
        """The largest count; a pixel that has it is saturated."""
        return int(2**self.bits) - 1

    def convert(self, electrons: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Convert electrons, any shape, to counts of the same shape."""
        counts = np.floor(electrons / self.electrons_per_count + (self.offset_counts + 0.5))
        return counts.clip(0, self.full_scale).astype(np.uint16)

    def upper_edges(self, counts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the electrons from which on a count is larger than these, same shape."""
        above = counts.astype(np.float64) + (0.5 - self.offset_counts)
        return above * self.electrons_per_count

    def expose(
        self, signal_electrons: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Return the counts of one exposure.

        Every pixel has exactly the distribution of the model: pixels with signal are simulated
        step by step, and the many pixels without any draw their count from its distribution,
        worked out once.

        Args:
            signal_electrons: mean electrons of the markers, any shape; ambient light comes on top.
            rng: source of the noise.

        Returns:
            Counts of the same shape.
        """
        counts = self.dark.draw(signal_electrons.size, rng)
        signal = signal_electrons.ravel()
        lit = np.flatnonzero(signal != 0.0)
        collected = rng.poisson(signal[lit] + self.ambient_electrons).astype(np.float64)
        np.minimum(collected, self.full_well_electrons, out=collected)
        collected += self.read_noise_electrons * rng.standard_normal(len(lit))
        counts[lit] = self.convert(collected)
        return counts.reshape(signal_electrons.shape)

    @cached_property
    def dark(self) -> CountDistribution:
        """The distribution of a pixel without signal."""
        return count_distribution(
            self.convert,
            self.upper_edges,
            mean_electrons=self.ambient_electrons,
            full_well_electrons=self.full_well_electrons,
            read_noise_electrons=self.read_noise_electrons,
        )
