"""Assemblies that line optics are tried on, each with its row of pixels."""

from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Alignment, Assembly, Lens, Stop
from compute.optics.tracing.surfaces import Aperture, Cylinder, Plane, Toroid

ROW = PixelRow(2048, 12.0, 200.0)
SQUARE_ROW = PixelRow(2048, 12.0, 12.0)
TALL_ROW = PixelRow(2048, 12.0, 1500.0)


def cylinder(*, flipped: bool = False, alignment: Alignment | None = None) -> Lens:
    """The lens of section 3.4; flipped: its plane side to the light."""
    shapes = (Plane(), Cylinder(-16.54)) if flipped else (Cylinder(16.54), Plane())
    return Lens(shapes, (4.0,), (1.52,), Aperture(19.0, 42.25), alignment=alignment or Alignment())


def slit(width_mm: float = 4.0, z_mm: float = -8.0, alignment: Alignment | None = None) -> Stop:
    return Stop(Aperture(width_mm, 40.0), z_mm, alignment or Alignment())


BAR = Assembly((slit(), cylinder(flipped=True)), 35.58)
CONVEX_FIRST = Assembly((slit(3.0, -0.01), cylinder()), 33.0)
OPEN_LENS = Assembly((cylinder(),), 33.0)
TOROID = Assembly(
    (
        Stop(Aperture(8.0, 40.0), -14.0),
        Lens((Plane(), Toroid(-27.3, -82.0)), (7.5,), (1.508,), Aperture(26.0, 40.0)),
    ),
    60.61,
)
ELLIPSE = Assembly((Stop(Aperture(6.0, 20.0, "elliptical"), -8.0), cylinder(flipped=True)), 35.58)
TILTED = Assembly(
    (
        slit(alignment=Alignment((0.3, 1.0), (0.05, -0.03, 0.04))),
        cylinder(flipped=True, alignment=Alignment((-0.4, 0.5), (0.02, 0.03, 0.01))),
    ),
    35.58,
    Alignment((0.1, -0.2), (0.03, 0.05, -0.02)),
)
DOUBLET = Assembly(
    (
        slit(6.0, -3.0),
        Lens(
            (Cylinder(30.0), Cylinder(-20.0), Cylinder(-80.0)),
            (6.0, 2.0),
            (1.517, 1.649),
            Aperture(20.0, 40.0),
        ),
        Lens((Plane(), Plane()), (1.0,), (1.5,), Aperture(30.0, 40.0), 40.0),
    ),
    44.0,
)
SENSOR_TILT = Assembly(
    (slit(), cylinder(flipped=True)), 35.58, Alignment((0.0, 0.0), (0.0, 0.2, 0.0))
)

SYSTEMS = {
    "bar": (BAR, ROW),
    "bar, square pixels": (BAR, SQUARE_ROW),
    "bar, tall pixels": (BAR, TALL_ROW),
    "convex side first": (CONVEX_FIRST, ROW),
    "open lens": (OPEN_LENS, ROW),
    "toroid": (TOROID, PixelRow(2048, 13.0, 200.0)),
    "ellipse": (ELLIPSE, ROW),
    "tilted": (TILTED, ROW),
    "doublet": (DOUBLET, ROW),
    "sensor tilt": (SENSOR_TILT, ROW),
}
REAR_SLIT = Assembly((cylinder(), Stop(Aperture(0.4, 40.0), 6.0)), 33.0)
TURNED_SLIT = Assembly(
    (slit(0.5, alignment=Alignment((0.0, 0.0), (0.0, 0.0, 0.3))), cylinder(flipped=True)), 35.58
)
SYSTEMS |= {"rear slit": (REAR_SLIT, ROW), "turned slit": (TURNED_SLIT, ROW)}
