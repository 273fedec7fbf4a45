"""Model of a window: expected counts by background, peaks and width; its Jacobian."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.sensor_noise import ScanNoise, SensorNoise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Layout:
    """Order of the parameters of K peaks: level, [slope], lights, positions, ln width.

    The width always has its place, known or not.

    Args:
        peaks: K.
        slope: the background has a slope.
    """

    peaks: int
    slope: bool

    @property
    def background(self) -> int:
        """Number of the background's parameters."""
        return 2 if self.slope else 1

    @property
    def light(self) -> slice:
        """The lights A_k [counts]."""
        return slice(self.background, self.background + self.peaks)

    @property
    def position(self) -> slice:
        """The positions x_k [px]."""
        return slice(self.background + self.peaks, self.background + 2 * self.peaks)

    @property
    def size(self) -> int:
        """Number of parameters, the logarithm of the width, the last, among them."""
        return self.background + 2 * self.peaks + 1


@dataclass(frozen=True, eq=False)
class Windows:
    """N windows of at most W pixels; shorter ones are padded with pixels that do not count.

    Args:
        values: counts, shape (N, W).
        used: pixels that count: of the window, and below full scale; shape (N, W).
        first_px: first pixels, shape (N,).
        last_px: last pixels, shape (N,).
        sensor: numbers of the sensors, shape (N,).
        noise: of the windows' scans.
    """

    values: Array
    used: NDArray[np.bool_]
    first_px: NDArray[np.int64]
    last_px: NDArray[np.int64]
    sensor: NDArray[np.int64]
    noise: ScanNoise

    @classmethod
    def cut(
        cls,
        scans: NDArray[np.uint16],
        scan: NDArray[np.int64],
        first_px: NDArray[np.int64],
        last_px: NDArray[np.int64],
        noise: SensorNoise,
    ) -> "Windows":
        """Cut windows out of scans.

        Args:
            scans: counts of the scans, uint16, shape (L, P).
            scan: scan of each window, shape (N,).
            first_px: first pixels, shape (N,).
            last_px: last pixels, shape (N,).
            noise: noise of the sensors.
        """
        width = int((last_px - first_px).max(initial=0)) + 1
        pixel = first_px[:, None] + np.arange(width)
        values = scans[scan[:, None], np.minimum(pixel, scans.shape[1] - 1)]
        sensor = scan % len(noise)
        full = noise.full_scale_counts[sensor][:, None]
        return cls(
            values.astype(np.float64),
            (pixel <= last_px[:, None]) & (values < full),
            first_px,
            last_px,
            sensor,
            noise.of_scans(sensor),
        )

    def __len__(self) -> int:
        """Return N."""
        return len(self.values)

    def __getitem__(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Windows":
        """Return some of the windows."""
        return Windows(*(values[rows] for values in vars(self).values()))

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of pixels that count, shape (N,)."""
        count: NDArray[np.int64] = self.used.sum(axis=1)
        return count

    @property
    def offset_from_centre(self) -> Array:
        """Places of the pixels from their window's middle, shape (N, W) [px]."""
        middle = 0.5 * (self.first_px + self.last_px)
        return (self.first_px - middle)[:, None] + np.arange(self.values.shape[1])


@dataclass(frozen=True, eq=False)
class ModelPrediction:
    """Expected counts, variances and Jacobian of the models of N windows.

    Args:
        mean: expected counts, shape (N, W).
        variance: of each pixel [counts^2], shape (N, W).
        jacobian: derivative of the expected counts by each parameter, shape (N, Q, W).
    """

    mean: Array
    variance: Array
    jacobian: Array


def evaluate(
    windows: Windows,
    parameters: Array,
    layout: Layout,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> ModelPrediction:
    """Evaluate the model of ``FitSettings``.

    Args:
        windows: N windows.
        parameters: shape (N, Q).
        layout: their order.
        settings: of the fit.
        shape: the line-spread function.
    """
    pixels = windows.values.shape[1]
    position, light = parameters[:, layout.position], parameters[:, layout.light]
    width = np.exp(parameters[:, -1:])
    edge_px = windows.first_px[:, None] - 0.5 + np.arange(pixels + 1)
    t = (edge_px[:, None, :] - position[..., None]) / width[..., None]
    below, density = shape.at(t, windows.sensor[:, None, None], position[..., None])
    share = np.diff(below, axis=2)
    jacobian = np.ones((len(windows), layout.size, pixels))
    if layout.slope:
        jacobian[:, 1] = windows.offset_from_centre
    jacobian[:, layout.light] = share
    bright = light[..., None]
    jacobian[:, layout.position] = np.diff(density, axis=2) * (-bright / width[..., None])
    jacobian[:, -1] = -(np.diff(t * density, axis=2) * bright).sum(axis=1)
    lit = (bright * share).sum(axis=1)
    mean = lit + parameters[:, :1]
    if layout.slope:
        mean += parameters[:, 1:2] * jacobian[:, 1]
    variance = windows.noise.variance(mean)
    variance += (settings.shape_error * lit) ** 2
    return ModelPrediction(mean, variance, jacobian)


def central_pixel_fraction(
    shape: LineSpreadFunction, width_px: Array, sensor: NDArray[np.int64], position_px: Array
) -> Array:
    """Return the share of a peak's light in a pixel centred on it; all arguments broadcast.

    Args:
        shape: the line-spread function.
        width_px: widths of the peaks [px].
        sensor: numbers of the sensors.
        position_px: positions of the peaks [px].
    """
    upper, lower = (shape.at(half / width_px, sensor, position_px)[0] for half in (0.5, -0.5))
    return np.asarray(upper - lower)
