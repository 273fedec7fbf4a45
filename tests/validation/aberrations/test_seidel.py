"""Third-order coefficients fitted to exact rays against Seidel's sums."""

import numpy as np
import pytest

from compute.errors import InvalidParameter, NoConvergence
from compute.optics.tracing.surfaces import Cylinder, Plane
from tests.validation.aberrations.lenses import SPHERES, cylindrical, lens_stack, relative
from validation.aberrations.paraxial import paraxial_system
from validation.aberrations.seidel import (
    Conjugates,
    MeridionalCoefficients,
    fit_meridional,
    fit_seidel,
    meridional,
    seidel_sums,
)

STOPS = {"before": -9.0, "the front face": None, "behind": 9.0}


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("name", SPHERES)
def test_fit_against_seidel_sums(name: str, stop: str) -> None:
    shapes, t = SPHERES[name]
    stack = lens_stack(shapes, t, STOPS[stop])
    conjugates = Conjugates(-1500.0, 2 if stop == "behind" else 0)
    wanted = seidel_sums(paraxial_system(stack), conjugates)
    errors, residuals = [], []
    for scale in (1.0, 0.5):
        fit = fit_seidel(stack, conjugates, 0.1 * scale, 5.0 * scale)
        errors.append(
            np.subtract(list(vars(fit.coefficients).values()), list(vars(wanted).values()))
        )
        residuals.append(fit.residual_rms_mm)
    # Against the largest of them: one may happen to vanish, as astigmatism does for some stop.
    largest = max(abs(value) for value in vars(wanted).values())
    for error, value in zip(errors[1], vars(wanted).values(), strict=True):
        assert abs(error) < 1e-3 * abs(value) or abs(error) < 1e-5 * largest
    # What is left is of the fifth order, and falls so, to the rays' rounding.
    assert residuals[0] / residuals[1] == pytest.approx(32.0, rel=0.05)


@pytest.mark.parametrize("name", ["plano-convex", "biconvex"])
def test_the_error_of_the_fit_is_of_second_order(name: str) -> None:
    shapes, t = SPHERES[name]
    stack = lens_stack(shapes, t, -9.0)
    conjugates = Conjugates(-1500.0, 0)
    wanted = np.array(list(vars(seidel_sums(paraxial_system(stack), conjugates)).values()))
    errors = [
        np.array(list(vars(fit_seidel(stack, conjugates, 0.5 * s, 25.0 * s).coefficients).values()))
        - wanted
        for s in (1.0, 0.5)
    ]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("name", ["plano-convex", "biconvex", "biconvex, figured"])
def test_a_cylinder_has_what_the_sphere_has_in_the_meridian(name: str) -> None:
    """After [3.22]: along the power axis only, and there the same."""
    shapes, t = SPHERES[name]
    conjugates = Conjugates(-1500.0, 0)
    wanted = meridional(seidel_sums(paraxial_system(lens_stack(shapes, t, -9.0)), conjugates))
    found = fit_meridional(
        lens_stack(cylindrical(shapes), t, -9.0), conjugates, 0.05, 2.5
    ).coefficients
    assert isinstance(found, MeridionalCoefficients)
    for one, other in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert relative(one, other) < 1e-3


def test_spherical_aberration_of_a_thin_lens() -> None:
    """Object at infinity, the textbook's form: a lens bent q = (r2 + r1) / (r2 - r1).

    LSA / h^2 = (n^3 + (3n + 2)(n - 1) q'^2 ...) of F. A. Jenkins and H. E. White, Fundamentals of
    Optics, section 9.5, with p = -1 for parallel light.
    """
    n, q = 1.52, 1.0
    shapes, _ = SPHERES["convex-plano"]
    stack = lens_stack(shapes, 1e-6)
    system = paraxial_system(stack)
    f = system.focal_length_mm
    far = -1e7
    found = seidel_sums(system, Conjugates(far, 0))
    p = -1.0
    bend = (n + 2.0) / (n - 1.0) * q**2 + 4.0 * (n + 1.0) * p * q
    shift = (bend + (3.0 * n + 2.0) * (n - 1.0) * p**2 + n**3 / (n - 1.0)) / (
        8.0 * f**3 * n * (n - 1.0)
    )
    # 1/s(h) - 1/s(0) = h^2 shift; transverse: -h f times it.
    assert found.spherical_b == pytest.approx(-f * shift, rel=1e-4)


def test_stop_before_the_lens_is_a_barrel_and_behind_it_a_pincushion() -> None:
    """Section 3.3.2, Figure 3.12."""
    shapes, t = SPHERES["biconvex"]
    before = seidel_sums(paraxial_system(lens_stack(shapes, t, -10.0)), Conjugates(-1500.0, 0))
    behind = seidel_sums(paraxial_system(lens_stack(shapes, t, 15.0)), Conjugates(-1500.0, 2))
    assert before.distortion_e > 0.0 > behind.distortion_e


def test_what_is_refused() -> None:
    shapes, t = SPHERES["biconvex"]
    stack = lens_stack(shapes, t)
    with pytest.raises(InvalidParameter, match="shape of surface 1"):
        fit_seidel(lens_stack((Plane(), Cylinder(-20.0)), t), Conjugates(-1500.0, 0), 0.1, 1.0)
    with pytest.raises(InvalidParameter, match=r"object_mm is 3\.0"):
        fit_seidel(stack, Conjugates(3.0, 0), 0.1, 1.0)
    with pytest.raises(NoConvergence, match="rays do not get through"):
        fit_seidel(stack, Conjugates(-1500.0, 0), 60.0, 1.0)
