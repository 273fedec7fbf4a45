"""Remarks to Table 1.1: the sources' figures of a device beside those of its plan."""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from compute.camera.model import Vector3
from compute.optics.coded_aperture.correlation_decoding import read_by_correlation
from compute.optics.coded_aperture.template_from_optics import mask_template
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import light_source, mask_optics
from compute.planning.plan_result import AxisSummary, Plan

PLACES: Final = 5
"""Points along X and Y in each plane in which templates are tried."""


def remark(profile: DeviceProfile, found: Plan) -> str:
    """Return what else belongs to a device's figures; empty: nothing.

    Args:
        profile: the device.
        found: its plan over its own volume.
    """
    return _REMARKS[profile.name](profile, found) if profile.name in _REMARKS else ""


def published(profile: DeviceProfile, quantity: str, axis: str) -> float:
    """Return the last published figure of a kind [mm]."""
    return [
        figure.value_mm
        for figure in profile.published
        if (figure.quantity, figure.axis) == (quantity, axis)
    ][-1]


def template_errors_px(
    profile: DeviceProfile, template_mm: float, distance_mm: float
) -> np.ndarray:
    """Return the errors of readings decoded with templates for another distance.

    Noiseless shadows of points all over the volume's width, in the plane at a distance, by
    templates of points on the sensors' axes.

    Args:
        profile: a device with coded windows.
        template_mm: distance of the templates' points, along Z [mm].
        distance_mm: of the points that are read, along Z [mm].

    Returns:
        Shape (PLACES^2, S) [px].
    """
    optics = mask_optics(profile, light_source(profile))
    assert optics is not None
    x, y, _ = (
        centre + size * np.linspace(-0.5, 0.5, PLACES)
        for centre, size in zip(profile.volume.centre_mm, profile.volume.size_mm, strict=True)
    )
    across, up = np.meshgrid(x, y)
    points = np.column_stack([across.ravel(), up.ravel(), np.full(PLACES**2, distance_mm)])
    lines, exact = optics.solid_angles(points).solid_angle_sr, optics.readings(points)
    errors = np.empty(exact.shape)
    for number, sensor in enumerate(profile.sensors):
        start, aim = np.array(sensor.position_mm), np.array(sensor.aim_mm)
        on_axis = start + (aim - start) * (template_mm - start[2]) / (aim - start)[2]
        read = read_by_correlation(lines[:, number], mask_template(optics, on_axis, number))
        errors[:, number] = read - exact[:, number]
    return errors


def _middle(summary: AxisSummary) -> Vector3:
    assert summary.centre is not None
    return summary.centre


def _half_pixel(found: Plan) -> tuple[float, float]:
    """Return what half a pixel in every reading makes in the middle: lateral, depth [mm]."""
    x, y, z = _middle(found.dilution)
    return 0.5 * max(x, y), 0.5 * z


def _mitchelson(profile: DeviceProfile, found: Plan) -> str:
    step = 2.0 * _half_pixel(found)[0]
    x, y, z = _middle(found.noise)
    figure = published(profile, "resolution", "lateral")
    return (
        f"A step of 12 bits is {step:.2g} mm laterally, the figure {figure / step:.2g} steps; the "
        f"rounding, 1/sqrt(12) of a step, makes {x:.2g} and {y:.2g} mm in X and Y, "
        f"{figure / y:.2g} to {figure / x:.2g} times less than the figure, and {z:.2g} mm in depth."
    )


def _leo(_: DeviceProfile, found: Plan) -> str:
    lateral, depth = _half_pixel(found)
    return (
        f"A whole pixel makes {2 * lateral:.2g} mm laterally and {2 * depth:.2g} mm in depth. "
        "The source gives the largest error for the sides of the field, before compensation; "
        "lens and focus are not known."
    )


def _macellari(_: DeviceProfile, found: Plan) -> str:
    lateral, depth = _half_pixel(found)
    return (
        f"Half a pixel, from which the source takes its resolution, makes {lateral:.2g} mm "
        f"laterally and {depth:.2g} mm in depth in the middle of the volume. Table 1.1 prints as "
        "the resolution what section 2.3 calls the largest depth error, at the side of the "
        "field, and section 2.3 names lens distortion as a possible reason."
    )


def _owen(profile: DeviceProfile, found: Plan) -> str:
    x, y, z = (published(profile, "accuracy", axis) for axis in "xyz")
    ours = _middle(found.dilution)
    misfits = ", ".join(f"{sensor.misfit_px:.2g}" for sensor in found.sensors)
    return (
        f"Depth is published {z / x:.2g} and {z / y:.2g} times worse than X and Y; equal errors "
        f"in all readings make it {ours[2] / ours[0]:.2g} and {ours[2] / ours[1]:.2g} times. The "
        "source takes distortion for the cause: errors of 20 px on the side sensors and 6 px on "
        f"the middle one. Our stopped lenses leave {misfits} px RMS."
    )


def _optotrak(profile: DeviceProfile, found: Plan) -> str:
    assert found.distortion.median is not None
    x, y, z = found.distortion.median
    lateral, depth = (published(profile, "accuracy", axis) for axis in ("lateral", "depth"))
    return (
        f"The published accuracy is {100 * lateral / max(x, y):.2g} % of the uncorrected "
        f"distortion laterally and {100 * depth / z:.2g} % in depth; a calibration with 19 "
        "parameters, made in the factory, is published."
    )


def _coda(profile: DeviceProfile, found: Plan) -> str:
    per_px = _middle(found.dilution)
    figures = [
        published(profile, "accuracy", axis) / one for axis, one in zip("xyz", per_px, strict=True)
    ]
    centre, half = profile.volume.centre_mm[2], profile.volume.size_mm[2] / 2.0
    fixed = [template_errors_px(profile, centre, z) for z in (centre - half, centre + half)]
    own = template_errors_px(profile, centre, centre)
    low, high = (f"{np.sqrt(np.square(one).mean()):.2g}" for one in fixed)
    return (
        "The published errors in X, Y and Z are those of errors of "
        f"{', '.join(f'{one:.2g}' for one in figures)} px in every reading. Noiseless shadows, "
        f"decoded by correlation with a template for {centre:g} mm, are misread by "
        f"{np.sqrt(np.square(own).mean()):.2g} px RMS at that distance, and by {low} and {high} px "
        f"at {centre - half:g} and {centre + half:g} mm. All sizes of the window are assumed."
    )


def _says(text: str) -> Callable[[DeviceProfile, Plan], str]:
    return lambda *_: text


_REMARKS: Final[Mapping[str, Callable[[DeviceProfile, Plan], str]]] = {
    "mitchelson-1971": _mitchelson,
    "leo-macellari-1981": _leo,
    "macellari-1983": _macellari,
    "owen-1995": _owen,
    "optotrak": _optotrak,
    "coda-mpx30": _coda,
    "thesis-5.1": _says(
        "Simulated with rays, so without noise, in whole pixels, and corrected by the cubic term "
        "of [5.2]. The source has no stop; ours is assumed."
    ),
    "thesis-5.2": _says(
        "Readings generated by the perspective equations: neither noise nor distortion are in "
        "the published figures."
    ),
    "thesis-5.9": _says(
        "Case test-5.4 calibrates the same readings with seven parameters a camera."
    ),
}
