"""Sources inside of a lens are refused; those before, beside and behind it are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.tracing.assembly import Alignment, Assembly, Lens, Stop
from compute.optics.tracing.surfaces import Aperture, Conic, Cylinder, Plane

LENS = Lens((Plane(), Cylinder(-16.54)), (4.0,), (1.52,), Aperture(19.0, 42.25))
ASSEMBLY = Assembly((Stop(Aperture(4.0), -1.0), LENS), 36.0)


@pytest.mark.parametrize(
    ("point", "inside"),
    [
        ((0.0, 0.0, 2.0), True),
        ((9.0, 0.0, 0.5), True),
        ((9.0, 0.0, 2.0), False),  # behind the curved face, which is nearer at the edge
        ((0.0, 21.0, 3.9), True),
        ((0.0, 22.0, 2.0), False),
        ((0.0, 0.0, -0.1), False),
        ((0.0, 0.0, 4.1), False),
        ((30.0, 0.0, 2.0), False),
    ],
)
def test_the_glass_of_a_plano_convex_cylinder(
    point: tuple[float, float, float], inside: bool
) -> None:
    points = np.array([(0.0, 0.0, -300.0), point])
    if not inside:
        ASSEMBLY.check_source(points)
        return
    with pytest.raises(InvalidParameter, match="inside the glass of element 2") as refused:
        ASSEMBLY.check_source(points)
    assert refused.value.context["points_mm"] == point


@given(
    tilt=st.floats(-0.3, 0.3),
    decentre=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    share=st.floats(0.05, 0.95),
)
def test_a_misaligned_lens_takes_its_glass_along(
    tilt: float, decentre: tuple[float, float], share: float
) -> None:
    lens = Lens(
        (Conic(20.0), Conic(-20.0)),
        (5.0,),
        (1.5,),
        Aperture(16.0, 16.0, "elliptical"),
        alignment=Alignment(decentre, (0.0, tilt, 0.0)),
    )
    along = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    on_axis = np.array([*decentre, 0.0]) + 5.0 * share * along
    beyond = np.array([*decentre, 0.0]) + (5.0 + share) * along
    assert lens.holds(np.array([on_axis, beyond])).tolist() == [True, False]
