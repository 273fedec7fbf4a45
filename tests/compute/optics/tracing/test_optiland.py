"""Our rays against those of optiland, an independent tracer.

optiland 0.6.3, NumPy backend: Plane, StandardGeometry (conics, closed form), BiconicGeometry with
an infinite radius in y (cylinders) and ToroidalGeometry (both by Newton's method; its tolerance
set to 1e-13 mm, below which rounding of the distance to the object is), IdealMaterial,
CoordinateSystem with tilts and decentres. At least 10,000 skew rays arrive in every case.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.optics.tracing.assembly import Alignment, Assembly, Lens
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
from compute.optics.tracing.surfaces import Aperture, Conic, Cylinder, Plane, Toroid

# Numba's own internal check, as it compiles optiland's functions.
pytestmark = pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaIRAssumptionWarning")

THESIS = Aperture(19.0, 42.25)
ROUND = Aperture(19.0, 19.0, "elliptical")
TILTED = Alignment((0.7, -0.4), (0.1, 0.05, 0.3))
CEMENTED = ((8.0, 2.0), (1.52, 1.62))
SENSOR = {"sensor_z_mm": 45.0}

CASES = {
    "plano-convex cylinder, thesis 3.4": Assembly(
        (Lens((Cylinder(16.54), Plane()), (4.0,), (1.52,), THESIS),), **SENSOR
    ),
    "the same, plane side to the light": Assembly(
        (Lens((Plane(), Cylinder(-16.54)), (4.0,), (1.52,), THESIS),), **SENSOR
    ),
    "biconvex sphere": Assembly(
        (Lens((Conic(30.0), Conic(-40.0)), (7.0,), (1.52,), ROUND),), **SENSOR
    ),
    "cemented doublet, one face an ellipsoid": Assembly(
        (Lens((Conic(30.0), Conic(-25.0), Conic(-90.0, -0.5)), *CEMENTED, ROUND),), **SENSOR
    ),
    "cylindrical doublet, tilted and decentred": Assembly(
        (
            Lens(
                (Cylinder(30.0), Cylinder(-25.0, 0.4), Cylinder(-90.0)),
                *CEMENTED,
                THESIS,
                alignment=TILTED,
            ),
        ),
        **SENSOR,
    ),
    "toroids, tilted, on a tilted sensor": Assembly(
        (
            Lens(
                (Toroid(30.0, 60.0, -0.3), Toroid(-50.0, -35.0, 0.2)),
                (8.0,),
                (1.52,),
                ROUND,
                alignment=TILTED,
            ),
        ),
        **SENSOR,
        sensor_alignment=Alignment((0.1, 0.3), (0.1, -0.1, 0.2)),
    ),
    "saddles": Assembly(
        (
            Lens(
                (Toroid(30.0, -60.0, -0.3), Toroid(-50.0, 45.0, 0.2)),
                (8.0,),
                (1.52,),
                ROUND,
                alignment=TILTED,
            ),
        ),
        **SENSOR,
    ),
}


def skew_rays(assembly, count, rng):
    """From places 30 to 1500 mm away to places all over the lens."""
    aperture = assembly.elements[0].aperture
    target = np.zeros((count, 3))
    target[:, 0] = rng.uniform(-0.5, 0.5, count) * aperture.width_mm
    target[:, 1] = rng.uniform(-0.5, 0.5, count) * aperture.height_mm
    distance = np.exp(rng.uniform(np.log(30.0), np.log(1500.0), count))
    field = Rotation.from_rotvec(
        np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), 0 * distance])
    )
    origin = target + field.apply(np.column_stack([0 * distance, 0 * distance, -distance]))
    return origin, (target - origin) / distance[:, None]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_same_places_and_directions_at_the_sensor(name):
    from benchmarks.ray_tracing_peer import optiland_tracer

    stack = CASES[name].stack()
    origins, directions = skew_rays(CASES[name], 40_000, np.random.default_rng(7))
    ours = trace_rays(stack, origins, directions)
    arrived = ours.status == RayStatus.ARRIVED
    assert arrived.sum() >= 10_000
    position, direction, path = optiland_tracer(stack)(origins[arrived], directions[arrived])
    np.testing.assert_allclose(ours.position_mm[arrived], position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.direction[arrived], direction, rtol=0, atol=1e-11)
    np.testing.assert_allclose(ours.path_mm[arrived], path, rtol=0, atol=1e-9)
