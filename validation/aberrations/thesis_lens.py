"""The lens of the thesis's section 3.4 with a stop, before the sensor of Figure 5.2."""

from typing import Final, Literal

from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Assembly, Element, Lens, Stop
from compute.optics.tracing.surfaces import Aperture, Cylinder, Plane
from validation.aberrations.paraxial import paraxial_system

StopPlace = Literal["8 mm in front", "on the plane face", "on the curved face", "4 mm behind"]

RADIUS_MM: Final = 16.54
THICKNESS_MM: Final = 4.0
INDEX: Final = 1.52
WIDTH_MM: Final = 19.0
HEIGHT_MM: Final = 42.25
"""Section 3.4: plano-convex, of BK7; in Appendix E the light meets the plane face first."""

FOCUSED_MM: Final = 1500.0
"""Distance for which the sensor is focused: where the thesis's sources stand (Figure 3.14)."""

ROW: Final = PixelRow(count=2048, pitch_um=12.0, height_um=12.0)
"""Figure 5.2: 2048 pixels on 24.58 mm."""

LENS: Final = Lens(
    shapes=(Plane(), Cylinder(-RADIUS_MM)),
    thicknesses_mm=(THICKNESS_MM,),
    indices=(INDEX,),
    aperture=Aperture(WIDTH_MM, HEIGHT_MM),
)

_STOP_Z_MM: Final[dict[StopPlace, float]] = {
    "8 mm in front": -8.0,
    "on the plane face": 0.0,
    "on the curved face": THICKNESS_MM,
    "4 mm behind": THICKNESS_MM + 4.0,
}
STOP_PLACES: Final[tuple[StopPlace, ...]] = tuple(_STOP_Z_MM)


def stopped_lens(
    width_mm: float, place: StopPlace = "on the plane face", focus_mm: float = 0.0
) -> Assembly:
    """Return the lens with a slit along its axis as the stop, and the sensor behind it.

    Args:
        width_mm: width of the stop [mm]; the lens's own width leaves the stop out.
        place: where the stop is.
        focus_mm: shift of the sensor from the paraxial image at FOCUSED_MM, positive away from
            the lens [mm].
    """
    z = _STOP_Z_MM[place]
    stop = Stop(Aperture(width_mm), z)
    elements: tuple[Element, ...] = (stop, LENS) if z <= 0.0 else (LENS, stop)
    if width_mm >= WIDTH_MM:
        elements = (LENS,)
    return Assembly(elements, paraxial_image_mm() + focus_mm)


def paraxial_image_mm() -> float:
    """Return where the lens images a point at FOCUSED_MM before its plane face [mm]."""
    stack = Assembly((LENS,), 2.0 * RADIUS_MM / (INDEX - 1.0)).stack()
    return paraxial_system(stack).image_of(-FOCUSED_MM)[0]


def row_behind_mm(assembly: Assembly) -> float:
    """Return how far the row is behind the entrance pupil, all glass taken as air [mm].

    The stop is the assembly's, or the lens's plane face where it has none.
    """
    elements = assembly.elements
    after = isinstance(elements[-1], Stop)
    pupil = paraxial_system(assembly.stack()).entrance_pupil_mm(2 if after else 0)
    glass = sum(
        thickness * (1.0 - 1.0 / index)
        for element in elements
        if isinstance(element, Lens)
        for thickness, index in zip(element.thicknesses_mm, element.indices, strict=True)
    )
    return assembly.sensor_z_mm - glass - pupil
