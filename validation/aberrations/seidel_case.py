"""Case seidel: coefficients [3.8]-[3.20] of the lens of section 3.4, by sums and by rays."""

from dataclasses import astuple, fields
from typing import Final

from compute.optics.tracing.assembly import Assembly, Element, Lens, Stop
from compute.optics.tracing.surfaces import Aperture, Conic, Cylinder, Plane, SurfaceStack
from validation.aberrations.paraxial import paraxial_system
from validation.aberrations.seidel import (
    AberrationFit,
    Conjugates,
    MeridionalCoefficients,
    SeidelCoefficients,
    fit_meridional,
    fit_seidel,
    meridional,
    seidel_sums,
)
from validation.aberrations.thesis_lens import FOCUSED_MM, INDEX, RADIUS_MM, THICKNESS_MM, WIDTH_MM
from validation.result_tables import Cell, ResultTable, TablesCase

STOPS: Final[dict[str, float]] = {
    "8 mm in front": -8.0,
    "on the plane face": 0.0,
    "on the curved face": THICKNESS_MM,
}
PUPIL_MM: Final = 0.1
HEIGHT_MM: Final = 5.0
"""Largest radius in the pupil and height of the object for the fits: small, for the third order."""

_MEANINGS: Final = {
    "spherical_b": "B, spherical aberration",
    "astigmatism_c": "C, astigmatism",
    "field_curvature_d": "D, curvature of field",
    "distortion_e": "E, distortion",
    "coma_f": "F, coma",
    "tangential_curvature_2c_d": "2C + D, tangential curvature",
}


def stack(stop_mm: float, *, spherical: bool) -> SurfaceStack:
    """Return the lens, or the sphere of its profile, plane face first, with a stop."""
    shape = Conic(-RADIUS_MM) if spherical else Cylinder(-RADIUS_MM)
    shapes = (Plane(), shape)
    lens = Lens(shapes, (THICKNESS_MM,), (INDEX,), Aperture(WIDTH_MM, WIDTH_MM, "elliptical"))
    stop = Stop(Aperture(WIDTH_MM), stop_mm)
    elements: tuple[Element, ...] = (stop, lens) if stop_mm <= 0.0 else (lens, stop)
    return Assembly(elements, 40.0).stack()


def conjugates(stop_mm: float) -> Conjugates:
    """Return the object at 1.5 m, and the number of the surface that is the stop."""
    return Conjugates(-FOCUSED_MM, 0 if stop_mm <= 0.0 else 2)


def fits(stop_mm: float, scale: float = 1.0) -> tuple[AberrationFit, AberrationFit]:
    """Return the fits of the sphere and of the cylinder, in a part of the pupil and field."""
    arguments = (conjugates(stop_mm), PUPIL_MM * scale, HEIGHT_MM * scale)
    return (
        fit_seidel(stack(stop_mm, spherical=True), *arguments),
        fit_meridional(stack(stop_mm, spherical=False), *arguments),
    )


def sums(stop_mm: float) -> SeidelCoefficients:
    """Return the coefficients of the sphere by Seidel's sums."""
    return seidel_sums(paraxial_system(stack(stop_mm, spherical=True)), conjugates(stop_mm))


def compute_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the coefficients, and the order of what they leave."""
    coefficients: list[tuple[Cell, ...]] = []
    orders: list[tuple[Cell, ...]] = []
    for name, stop_mm in STOPS.items():
        analytic = sums(stop_mm)
        sphere, cylinder = fits(stop_mm)
        for lens, fit, expected in (
            ("sphere", sphere, analytic),
            ("cylinder", cylinder, meridional(analytic)),
        ):
            coefficients += _compared(name, lens, fit.coefficients, expected)
        half = fits(stop_mm, 0.5)
        for lens, whole, part in zip(("sphere", "cylinder"), (sphere, cylinder), half, strict=True):
            orders.append(
                (
                    name, lens, whole.aberration_rms_mm * 1e6, whole.residual_rms_mm * 1e6,
                    whole.residual_rms_mm / part.residual_rms_mm,
                )
            )  # fmt: skip
    tables = (
        ResultTable(
            "coefficients of [3.8], object at 1.5 m [1/mm^2]",
            ("stop", "lens", "coefficient", "Seidel's sums", "fitted to rays", "relative"),
            tuple(coefficients),
        ),
        ResultTable(
            f"what the fits leave, of rays to {PUPIL_MM:g} mm in the pupil and {HEIGHT_MM:g} mm in "
            "the object, RMS [nm]",
            ("stop", "lens", "aberration", "left", "left, by left at half the size"),
            tuple(orders),
        ),
    )
    findings = (
        (
            "Fits and sums agree; what is left falls by 32 when pupil and field are halved, so it "
            "is of the fifth order."
        ),
        (
            "Coma all but vanishes for a stop 8 mm in front, distortion for one on the curved "
            "face: no place does for both."
        ),
        (
            "A cylinder has the sphere's coefficients in the plane of its power, and of C and D "
            "only 2C + D, as the text after [3.20] says. Its rays out of that plane are not in "
            "them: the skew effect is of the third order too (case skew-effect)."
        ),
        (
            "[3.14] and [3.15] print sin for the cosine in dy's spherical aberration; the "
            "derivative of [3.13] has the cosine. [3.22]'s h^4 is the aberration function with r = "
            "h; the image is displaced by E h^3, [3.20]."
        ),
    )
    return tables, findings


def _compared(
    stop: str,
    lens: str,
    found: SeidelCoefficients | MeridionalCoefficients,
    expected: SeidelCoefficients | MeridionalCoefficients,
) -> list[tuple[Cell, ...]]:
    return [
        (stop, lens, _MEANINGS[field.name], right, ours, ours / right - 1.0)
        for field, right, ours in zip(fields(found), astuple(expected), astuple(found), strict=True)
    ]


CASE: Final = TablesCase(
    "seidel",
    "third-order aberrations of the lens of section 3.4",
    "section 3.3.2, [3.8]-[3.22]",
    compute_tables,
)
