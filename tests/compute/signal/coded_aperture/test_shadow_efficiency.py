"""The fit of a shadow against the Cramer-Rao bound, and plain correlation beside it."""

import numpy as np
import pytest

from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.signal.coded_aperture.shadow_fit import ShadowFitter, ShadowSettings
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.coded_aperture.coded_aperture_scenes import (
    PIXELS,
    displaced,
    shadows,
    window_optics,
    woven,
)

GAIN, READ, AMBIENT, OFFSET = 4.0, 20.0, 200.0, 100.0
NOISE = SensorNoise.of(GAIN, READ, OFFSET)
PHASES = np.linspace(-0.45, 0.45, 10)
STEP = 0.01


def bounds(light: np.ndarray, scale: bool, place: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Least deviations of the shift at the phases; brightness, ambient (scale) unknown, or known.

    By differences of shadows that the optics form anew, and of what they are when magnified.
    """
    optics = window_optics()
    up, down = (shadows(optics, place + PHASES + step)[0] for step in (STEP, -STEP))
    here, reading = shadows(optics, place + PHASES)
    factor = light / here.max()
    slope = factor * (up - down) / (2.0 * STEP)
    mean = factor * here + AMBIENT
    columns = [slope, here / here.max(), np.ones_like(mean)]
    if scale:
        # Magnified about the reading: pixels move in proportion to their distance from it.
        columns.append(slope * (np.arange(PIXELS) - reading - place - PHASES[:, None]))
    jacobian = np.stack(columns, axis=2)
    weight = 1.0 / (mean + READ**2 + GAIN**2 / 12.0)
    information = np.einsum("kpi,kp,kpj->kij", jacobian, weight, jacobian)
    unit = np.sqrt(np.einsum("kii->ki", information))
    inverse = np.linalg.inv(information / unit[:, :, None] / unit[:, None, :])
    return np.sqrt(inverse[:, 0, 0]) / unit[:, 0], 1.0 / unit[:, 0]


def noisy(light: float, draws: int, place: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    lines, _ = shadows(window_optics(), place + PHASES)
    mean = np.repeat(light / lines.max() * lines + AMBIENT, draws, axis=0)
    rng = np.random.default_rng(int(light))
    electrons = rng.poisson(mean) + READ * rng.standard_normal(mean.shape)
    counts = np.rint(electrons / GAIN + OFFSET).clip(0, 65535).astype(np.uint16)
    return counts, np.repeat(place + PHASES, draws)


@pytest.mark.slow
@pytest.mark.parametrize("light", [150.0, 1000.0, 100000.0])
def test_it_reaches_the_bound_and_says_so(light: float) -> None:
    """Prints, by the electrons of the brightest pixel, the deviation beside the bound."""
    template = woven(window_optics(), 4)
    draws = 1300
    counts, shift = noisy(light, draws)
    fit = ShadowFitter(template, PIXELS, NOISE).fit(counts)
    bound, known = bounds(light, scale=False)
    level = np.sqrt(np.mean(bound**2))
    error = fit.shift_px - shift
    ratio = np.sqrt(np.mean(error**2)) / level
    honest = np.mean((error / fit.sigma_px) ** 2)
    plain = decode_mask(counts, template.pixel_values).shift_px + template.first_px - shift
    of_plain = np.sqrt(np.mean(plain**2)) / np.sqrt(np.mean(known**2))
    print(
        f"{light:.0f} electrons: bound {level:.5f} px, fit {ratio:.3f} of it, bias "
        f"{error.mean():+.6f} px, normalised squared error {honest:.3f}; plain correlation "
        f"{of_plain:.2f} of the bound with brightness known, {known.mean():.5f} px"
    )
    assert fit.found.all()
    assert not fit.flags.any()
    # 13,000 draws know a deviation to 0.6 %, a mean square to 1.2 %.
    assert ratio <= 1.05
    assert 0.95 <= honest <= 1.05
    by_phase = error.reshape(len(PHASES), draws).mean(axis=1)
    assert (abs(by_phase) < 4.5 * bound / np.sqrt(draws) + 2e-4).all()
    dof = PIXELS - 3
    assert fit.reduced_chi2.mean() == pytest.approx(1.0, abs=0.005 + 4.5 * (2 / dof / 13e3) ** 0.5)
    assert of_plain > 1.0


@pytest.mark.slow
def test_with_the_scale_free_too() -> None:
    """Off the axis, the pattern half off the line: there shift and scale are not independent."""
    place = 400.0
    counts, shift = noisy(3000.0, 600, place)
    settings = ShadowSettings(fit_scale=True)
    # The shadow is another there than on the axis: the template is of the place.
    template = woven(window_optics(), 4, displaced(window_optics(), [place])[0])
    shift = shift - place
    fit = ShadowFitter(template, PIXELS, NOISE, settings).fit(counts)
    bound, _ = bounds(3000.0, scale=True, place=place)
    error = fit.shift_px - shift
    ratio = np.sqrt(np.mean(error**2)) / np.sqrt(np.mean(bound**2))
    honest = np.mean((error / fit.sigma_px) ** 2)
    print(f"scale free: {ratio:.3f} of the bound, normalised squared error {honest:.3f}")
    # 6,000 draws: 0.9 % of a deviation, 1.8 % of a mean square.
    assert ratio <= 1.05
    assert 0.92 <= honest <= 1.08
    assert abs(fit.scale.mean() - 1.0) < 1e-4


@pytest.mark.slow
def test_where_the_noise_begins_to_hide_the_bars() -> None:
    """Prints how the fit goes past the bound, and is not found, as light fails."""
    fitter = ShadowFitter(woven(window_optics(), 4), PIXELS, NOISE)
    for light in (60.0, 40.0, 25.0, 15.0):
        counts, shift = noisy(light, 200)
        fit = fitter.fit(counts)
        error = (fit.shift_px - shift)[fit.found]
        bound, _ = bounds(light, scale=False)
        ratio = np.sqrt(np.mean(error**2)) / np.sqrt(np.mean(bound**2))
        print(
            f"{light:.0f} electrons: found {fit.found.mean():.3f}, bound {bound.mean():.3f} px, "
            f"fit {ratio:.2f} of it"
        )
        # A false reading in a thousand lines, at most: 2 of these, where more than 10 are
        # as unlikely as 1 in 100,000.
        assert (abs(error) > 10.0).sum() <= 10
