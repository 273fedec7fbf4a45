"""Shadow of a coded mask with Fresnel diffraction, from a table."""

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, irfft, next_fast_len, rfft

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.coded_aperture.geometric_shadow import second_difference
from compute.parameter_checks import require

Array = NDArray[np.float64]

_REACH = 20.0  # Fresnel widths within which an edge counts in full
_MIN_ORDERS = 4.0
_SAMPLES_PER_FRINGE = 8.0
_DAMPED_ORDER = 0.48  # order x relative spectral deviation at which fringes are down to 1 %
_SPECTRUM_REACH = 4.0  # standard deviations
_SCALES = (0.25, 100.0)  # range of the squared Fresnel width, times wavelength x gap
_MAX_VALUES = 1 << 25
_ROWS_AT_ONCE = 16
_FWHM_PER_SD = 2.0 * np.sqrt(2.0 * np.log(2.0))


class DiffractedShadow:
    """Shadow with Fresnel diffraction, averaged over spectrum, penumbra and pixel.

    The field adds ``+-(C(v) + i S(v)) / (1 + i)``, ``v = (x - edge) sqrt(2) / fresnel_mm``, for
    each edge (Born and Wolf, Principles of Optics, section 8.7). It depends on the position s on
    the mask and on the squared Fresnel width ``q = wavelength / W`` alone, and its intensity is
    tabulated over both, as its second integral along s, so that any pixel and any penumbra is one
    second difference. The table's rows lie on a fixed lattice in ln q and are made when first
    needed, by the angular spectrum (on a lattice of bars the code's spectrum is exact); a spectral
    line averages rows.

    Limits. The table is within 0.005 of the full light of the closed form, averaged; an edge
    counts in full within 20 Fresnel widths; ``q`` is held within 0.25 and 100 times wavelength x
    gap (points nearer than a third of the gap, rays beyond 77 deg). The closed form itself
    keeps the optical path to second order: at 10 mm and 900 nm it is off Huygens' integral by at
    most 0.06 of the full light for one wavelength and 0.001 for a line of 50 nm in normal
    light; by 0.20 and 0.08 at 25 deg, where the path's third order tells at slits of 0.1 mm.
    (tests/compute/optics/coded_aperture/test_fresnel_shadow.py prints these.)

    Args:
        window: the window.
        wavelength_nm: central wavelength [nm].
        spectral_width_nm: full width at half maximum of the source's spectrum [nm], taken as
            Gaussian in the logarithm of the wavelength; 0: monochromatic.
        finest_mm: width of a pixel [mm]; finer fringes are not tabulated.

    Raises:
        InvalidParameter: wavelength or widths out of range, or a code too long for its fringes.
    """

    def __init__(
        self,
        window: CodedWindow,
        *,
        wavelength_nm: float,
        spectral_width_nm: float,
        finest_mm: float,
    ) -> None:
        require(0.0 < wavelength_nm < np.inf, "be positive", wavelength_nm=wavelength_nm)
        require(0.0 < finest_mm < np.inf, "be positive", finest_mm=finest_mm)
        require(
            0.0 <= spectral_width_nm <= wavelength_nm / 2.0,
            f"be from zero to half of the wavelength, {wavelength_nm / 2.0}",
            spectral_width_nm=spectral_width_nm,
        )
        self._wavelength_mm = wavelength_nm * 1e-6
        self._square = self._wavelength_mm * window.gap_mm
        deviation = spectral_width_nm / wavelength_nm / _FWHM_PER_SD
        self._row_step = 1.0 / (_SAMPLES_PER_FRINGE * self._orders(deviation, finest_mm))
        self._kernel = _spectral_kernel(deviation / self._row_step)
        self._lay_grid(window)
        self._spectrum = _code_spectrum(window, self._before, self._bars, self._per_bar)
        low, high = np.log(np.array(_SCALES) * self._square) / self._row_step
        self._low, self._high = int(np.floor(low)), int(np.ceil(high))
        # Of all light: what the spectrum leaves out has gone far away, and is spread evenly.
        self._mean = sum(window.code) / self._bars
        self._table = (0, np.empty((0, self._count)))

    def _orders(self, deviation: float, finest_mm: float) -> float:
        """Return the order of the finest fringes that spectrum and pixels leave."""
        orders = min(_REACH**2 / 2.0, self._square / (2.0 * finest_mm**2))
        if deviation > 0.0:
            orders = min(orders, _DAMPED_ORDER / deviation)
        return max(orders, _MIN_ORDERS)

    def _lay_grid(self, window: CodedWindow) -> None:
        width = np.sqrt(self._square)
        bar = window.bar_mm
        self._per_bar = int(np.ceil(bar * 2.0 * _REACH / width))
        self._step_mm = bar / self._per_bar
        self._before = int(np.ceil(2.0 * _REACH * width / bar))
        self._bars = next_fast_len(len(window.code) + 2 * self._before)
        self._count = self._bars * self._per_bar
        self._start_mm = -window.length_mm / 2.0 - self._before * bar
        if self._count / self._row_step > _MAX_VALUES:
            raise InvalidParameter(
                f"code is {window.length_mm:.6g} mm long and its fringes are {width:.3g} mm wide, "
                f"which takes a table of {self._count / self._row_step:.3g} values; at most "
                f"{_MAX_VALUES} are made: shorten the code, widen the gap, or leave out "
                "diffraction",
                length_mm=window.length_mm,
            )

    def mean_transmission(
        self, centre_mm: Array, width_mm: Array, blur_mm: Array, curvature_per_mm: Array
    ) -> Array:
        """Return the light on stretches relative to that without a mask.

        Args:
            centre_mm: middles of the stretches, along the readings from the middle of the code
                [mm].
            width_mm: their widths, of the same shape [mm].
            blur_mm: widths of the penumbra, of the same shape [mm].
            curvature_per_mm: curvatures of the optical paths, of the same shape [1/mm].
        """
        # Beyond the grid is frame, and the fringes there are too faint to count.
        half = self._count * self._step_mm / 2.0
        inside = abs(centre_mm - self._start_mm - half) < half - width_mm - blur_mm
        light = np.zeros(centre_mm.shape)
        if inside.any():
            stretches = (centre_mm, width_mm, blur_mm, curvature_per_mm)
            light[inside] = self._within(*(values[inside] for values in stretches))
        return light

    def _within(self, centre_mm: Array, width_mm: Array, blur_mm: Array, bend: Array) -> Array:
        """Return the same for stretches within the grid, shape (N,)."""
        row = np.log(self._wavelength_mm / bend) / self._row_step
        row = np.clip(row, self._low + 1, self._high - 2)
        before = np.floor(row).astype(np.int64)
        first, table = self._rows(int(before.min()) - 1, int(before.max()) + 2)
        weights = _lagrange(row - before)
        base = (before - 1 - first) * self._count

        def integral(position_mm: Array) -> Array:
            along = (position_mm - self._start_mm) / self._step_mm
            sample = np.floor(along)
            spline = _cubic_spline(along - sample)
            lower = sample.astype(np.int64) - 1
            total = np.zeros(position_mm.shape)
            for column in range(4):
                index = base + (lower + column) % self._count
                over_rows = weights[0] * table.take(index)
                for step in range(1, 4):
                    over_rows += weights[step] * table.take(index + step * self._count)
                total += spline[column] * over_rows
            return total

        return self._mean + second_difference(integral, centre_mm, width_mm, blur_mm)

    def _rows(self, low: int, high: int) -> tuple[int, Array]:
        """Return a table that holds the rows from low to high, and its first row's number."""
        first, table = self._table
        if len(table) and low >= first and high < first + len(table):
            return first, table
        if not len(table):
            first = low
        low, high = min(low, first), max(high, first + len(table) - 1)
        before, behind = self._make(low, first), self._make(first + len(table), high + 1)
        self._table = (low, np.concatenate([before, table, behind]))
        return self._table

    def _make(self, low: int, end: int) -> Array:
        """Return the rows from low to before end: spline coefficients of the integral."""
        rows = np.empty((end - low, self._count))
        reach = len(self._kernel) // 2
        frequency = np.arange(self._count // 2 + 1) / (self._count * self._step_mm)
        # Twice integrated, without the mean; the cubic spline through the samples.
        smooth = (2.0 + np.cos(2.0 * np.pi * frequency * self._step_mm)) / 3.0
        with np.errstate(divide="ignore"):
            factor = -1.0 / ((2.0 * np.pi * frequency) ** 2 * smooth)
        factor[0] = 0.0
        for start in range(low, end, _ROWS_AT_ONCE):
            stop = min(start + _ROWS_AT_ONCE, end)
            raw = self._intensity(start - reach, stop + reach)
            averaged = np.zeros((stop - start, self._count))
            for offset, share in enumerate(self._kernel):
                averaged += share * raw[offset : offset + stop - start]
            rows[start - low : stop - low] = irfft(rfft(averaged) * factor, self._count)
        return rows

    def _intensity(self, low: int, end: int) -> Array:
        """Return the monochromatic intensity of the rows from low to before end."""
        square = np.exp(np.arange(low, end) * self._row_step)
        cycles = np.fft.fftfreq(self._count, self._step_mm)
        chirp = np.exp(-1j * np.pi * square[:, None] * cycles**2)
        field = ifft(chirp * self._spectrum) * self._count
        return np.asarray(field.real**2 + field.imag**2)


def _code_spectrum(
    window: CodedWindow, before: int, bars: int, per_bar: int
) -> NDArray[np.complex128]:
    """Return the Fourier coefficients of the periodic code, exactly."""
    code = np.zeros(bars)
    code[before : before + len(window.code)] = window.code
    order = np.fft.fftfreq(bars * per_bar, 1.0 / (bars * per_bar))
    share = np.sinc(order / bars) * np.exp(-1j * np.pi * order / bars) / bars
    return np.asarray(np.tile(fft(code), per_bar) * share)


def _spectral_kernel(deviation_rows: float) -> Array:
    """Return a Gaussian's weights on rows; a narrower one keeps its variance."""
    if deviation_rows < 0.7:
        side = deviation_rows**2 / 2.0
        return np.array([side, 1.0 - 2.0 * side, side])
    reach = int(np.ceil(_SPECTRUM_REACH * deviation_rows))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation_rows) ** 2)
    return np.asarray(weights / weights.sum())


def _lagrange(part: Array) -> tuple[Array, Array, Array, Array]:
    """Return the weights of the samples at -1, 0, 1, 2 for cubic interpolation at part."""
    a, b, c = part + 1.0, part - 1.0, part - 2.0
    return -part * b * c / 6.0, a * b * c / 2.0, -a * part * c / 2.0, a * part * b / 6.0


def _cubic_spline(part: Array) -> tuple[Array, Array, Array, Array]:
    """Return the values at part of the four cubic B-splines that are not zero there."""
    rest = 1.0 - part
    return (
        rest**3 / 6.0,
        2.0 / 3.0 - part**2 * (1.0 + rest) / 2.0,
        2.0 / 3.0 - rest**2 * (1.0 + part) / 2.0,
        part**3 / 6.0,
    )
