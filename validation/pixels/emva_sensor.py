"""A sensor after EMVA 1288's model, with defects: photons in, counts out.

It is the oracle of radiometric calibration and shares no code with what it judges.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorDesign:
    """What is bought: the figures of a data sheet.

    Args:
        pixels: number of pixels.
        electrons_per_count: reciprocal of EMVA's system gain K.
        read_electrons: dark temporal noise.
        offset_counts: mean dark offset.
        full_well_electrons: full well.
        full_scale_counts: largest count of the converter.
        prnu: standard deviation of the responses.
        dsnu_counts: standard deviation of the dark offsets.
        saturation_curve: electrons e are converted as ``e - saturation_curve e^2 / full well``.
        hot: pixels with additional dark electrons.
        hot_electrons: their dark electrons, with shot noise.
        dead: pixels that respond to a hundredth of the light.
        stuck: pixels with a constant count.
        stuck_counts: that count.
    """

    pixels: int = 512
    electrons_per_count: float = 10.0
    read_electrons: float = 20.0
    offset_counts: float = 100.0
    full_well_electrons: float = 60_000.0
    full_scale_counts: int = 65535
    prnu: float = 0.0
    dsnu_counts: float = 0.0
    saturation_curve: float = 0.0
    hot: tuple[int, ...] = ()
    hot_electrons: float = 300.0
    dead: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    stuck_counts: int = 400


@dataclass(frozen=True, eq=False)
class Sensor:
    """One sensor as it came from the factory.

    Args:
        design: what it should be.
        response: responses of its pixels beside one, shape (N,).
        offset: dark offsets, shape (N,) [counts].
        rng: of its noise.
    """

    design: SensorDesign
    response: Array
    offset: Array
    rng: np.random.Generator = field(repr=False)

    @classmethod
    def make(cls, design: SensorDesign, rng: np.random.Generator) -> "Sensor":
        """Make a sensor.

        Args:
            design: its figures.
            rng: of its unevenness and its noise.
        """
        response = 1.0 + design.prnu * rng.standard_normal(design.pixels)
        response[list(design.dead)] *= 0.01
        offset = design.offset_counts + design.dsnu_counts * rng.standard_normal(design.pixels)
        return cls(design, response, offset, rng)

    @property
    def bad(self) -> NDArray[np.bool_]:
        """Pixels with a defect, shape (N,)."""
        bad = np.zeros(self.design.pixels, bool)
        bad[[*self.design.hot, *self.design.dead, *self.design.stuck]] = True
        return bad

    def expose(self, electrons: Array) -> NDArray[np.uint16]:
        """Return the counts of exposures.

        Args:
            electrons: mean electrons of a pixel with response 1, shape (F, N).
        """
        design = self.design
        mean = electrons * self.response
        mean[:, list(design.hot)] += design.hot_electrons
        charge = np.minimum(self.rng.poisson(mean), design.full_well_electrons)
        bent = charge - design.saturation_curve * charge**2 / design.full_well_electrons
        volt = bent + design.read_electrons * self.rng.standard_normal(mean.shape)
        counts = np.rint(volt / design.electrons_per_count + self.offset)
        counts = np.clip(counts, 0, design.full_scale_counts).astype(np.uint16)
        counts[:, list(design.stuck)] = design.stuck_counts
        return np.asarray(counts)

    def position_bound_px(
        self,
        line: Callable[[float], Array],
        position_px: float,
        light_electrons: float,
        ambient_electrons: float,
    ) -> float:
        """Return the Cramer-Rao bound of a line's position in the good pixels [px].

        The light and a level of the background are unknown too; shape, offsets and responses are
        known. Of counts with a mean m and variance V both of which move, the information is
        ``m'm'/V`` (the variance's own is left out).

        Args:
            line: returns the pixels' shares of the light of a line by its position, shape (N,).
            position_px: of the line.
            light_electrons: its light.
            ambient_electrons: light in each pixel beside it.
        """

        def mean_of(values: Array) -> Array:
            position, light, ambient = values
            return np.asarray((light * line(float(position)) + ambient) * self.response)

        truth = np.array([position_px, light_electrons, ambient_electrons])
        steps = np.array([1e-4, 1e-4 * light_electrons, 1e-3])
        rows = [
            (mean_of(truth + step * unit) - mean_of(truth - step * unit)) / (2.0 * step)
            for step, unit in zip(steps, np.eye(3), strict=True)
        ]
        gain = self.design.electrons_per_count
        variance = mean_of(truth) + self.design.read_electrons**2 + gain**2 / 12.0
        used = ~self.bad & (np.abs(np.arange(self.design.pixels) - position_px) < 60)
        jacobian = np.array(rows)[:, used]
        information = (jacobian / variance[used]) @ jacobian.T
        return float(np.sqrt(np.linalg.inv(information)[0, 0]))
