"""Registration by paired points: honest errors, predicted and measured, and wrong pairs named."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import (
    CollinearPoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    TooFewPoints,
)
from compute.pose.registration.correspondence_errors import find_correspondence_errors
from compute.pose.registration.point_registration import Registration, register_points
from compute.transform import Transform, rotation_matrix
from tests.compute.pose.motions import Array, check_mean, drawn, point_covariance, transforms

TARGETS = np.array([[10.0, 20.0, 130.0], [0.0, 0.0, 0.0], [-200.0, 50.0, 10.0]])
AWAY = np.array([300.0, -500.0, 200.0])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [10.0, 70.0, 0.0], [20.0, 15.0, 60.0]])


def fiducials(p_value: np.random.Generator, count: int) -> Array:
    return p_value.uniform(-80.0, 80.0, (count, 3))


def anywhere(p_value: np.random.Generator) -> Transform:
    return Transform(rotation_matrix(p_value.normal(size=3)), 100.0 * p_value.normal(size=3))


@settings(max_examples=40)
@given(
    st.integers(0, 10_000),
    transforms(covariance=False),
    st.integers(3, 12),
    st.sampled_from([None, 0.5, 3.0]),
    st.sampled_from(["covariances", "isotropic"]),
)
def test_without_noise_it_is_exact(
    seed: int, truth: Transform, count: int, scale: float | None, weighting: str
) -> None:
    p_value = np.random.default_rng(seed)
    source = fiducials(p_value, count)
    values = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
    if values[1] < 0.05 * values[0]:
        return
    target = truth.apply(source * (scale or 1.0))
    covariances = np.array([point_covariance(p_value, 0.3) for _ in source])
    found = register_points(
        source,
        target,
        covariances,
        covariances[::-1],
        weighting=weighting,  # type: ignore[arg-type]
        scaled=scale is not None,
    )
    assert found.scale == pytest.approx(scale or 1.0, rel=1e-9)
    assert np.allclose(found.apply(TARGETS), truth.apply(TARGETS * (scale or 1.0)), atol=1e-6)
    assert found.correspondence_errors is None


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 5, 15])
def test_the_covariance_is_what_the_transform_errs_by(count: int) -> None:
    squares, misfits, targets = [], [], []
    for seed in range(60):
        p_value = np.random.default_rng(seed)
        truth, source = anywhere(p_value), fiducials(p_value, count)
        values = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
        if values[1] < 0.2 * values[0]:
            continue
        own = np.array([point_covariance(p_value, 0.3) for _ in source])
        other = np.array([point_covariance(p_value, 0.4) for _ in source])
        target = truth.apply(source) + drawn(p_value, other)
        found = register_points(source + drawn(p_value, own), target, own, other)
        error = found.transform.difference(truth)
        squares.append(error @ np.linalg.solve(found.parameter_covariance, error))
        assert found.residual_sigma is not None
        misfits.append(found.residual_sigma**2 * (3 * count - 6))
        off = found.apply(TARGETS) - truth.apply(TARGETS)
        targets.append(float((off**2).sum() / (found.target_error(TARGETS) ** 2).sum()))
    # To first order: with three points the turn is some 0.01 rad off, and their places matter.
    check_mean(squares, 6, 0.03)
    check_mean(misfits, 3 * count - 6, 0.03)
    # Measured over predicted target error, in squares: its own spread is some 1 per try.
    assert abs(np.mean(targets) - 1.0) < 4.0 * np.std(targets) / np.sqrt(len(targets)) + 0.03


def test_weights_are_worth_having() -> None:
    """Fiducials seen from afar err along the line of sight; weights leave that aside."""
    errors = []
    along = np.diag([0.01, 0.01, 4.0])
    for seed in range(60):
        p_value = np.random.default_rng(seed)
        truth, source = anywhere(p_value), fiducials(p_value, 8)
        covariances = np.broadcast_to(along, (8, 3, 3)).copy()
        covariances[::2] = along[::-1, ::-1]
        target = truth.apply(source) + drawn(p_value, covariances)
        found = [
            register_points(source, target, None, covariances, weighting=one)  # type: ignore[arg-type]
            for one in ("covariances", "isotropic")
        ]
        errors.append([((one.apply(TARGETS) - truth.apply(TARGETS)) ** 2).sum() for one in found])
        predicted = [one.target_error(TARGETS).sum() for one in found]
        assert predicted[0] < predicted[1]
    weighted, even = np.sqrt(np.mean(errors, axis=0))
    assert weighted < 0.5 * even


def isotropic(seed: int, count: int, sigma_mm: float) -> tuple[Array, Transform, Registration]:
    p_value = np.random.default_rng(seed)
    truth, source = anywhere(p_value), fiducials(p_value, count)
    target = truth.apply(source) + sigma_mm * p_value.normal(size=source.shape)
    return source, truth, register_points(source, target)


def target_registration_error(fiducials_mm: Array, targets_mm: Array, fle_mm: float) -> Array:
    """Return the expected RMS error at T targets, shape (T,) [mm].

    ``TRE^2 = FLE^2 / N (1 + 1/3 sum_k d_k^2 / f_k^2)`` with d_k the target's distance from the
    k-th principal axis of the N fiducials, and f_k their RMS distance from it
    (J. M. Fitzpatrick, J. B. West, C. R. Maurer, doi:10.1109/42.736021). For errors that are the
    same for all fiducials and in all directions, and without scale.

    Args:
        fiducials_mm: shape (N, 3) [mm].
        targets_mm: shape (T, 3) [mm], in the same frame.
        fle_mm: RMS error of a fiducial in space [mm], of both frames together.
    """
    centre = fiducials_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(fiducials_mm - centre)

    def distances(points: Array) -> Array:
        along = (points - centre) @ axes.T
        found: Array = (along**2).sum(axis=1, keepdims=True) - along**2
        return found

    ratio = (distances(targets_mm) / distances(fiducials_mm).mean(axis=0)).sum(axis=1)
    error: Array = fle_mm * np.sqrt((1.0 + ratio / 3.0) / len(fiducials_mm))
    return error


def test_errors_that_are_the_same_everywhere_are_those_of_the_published_formulas() -> None:
    measured, localised, before = [], [], []
    for seed in range(120):
        source, truth, found = isotropic(seed, 5, 0.4)
        # Fitzpatrick's formula is what the covariance of the transform comes to.
        published = target_registration_error(source, TARGETS, found.fle_mm)
        assert np.allclose(found.target_error(TARGETS), published, rtol=1e-9)
        known = target_registration_error(source, TARGETS, 0.4 * np.sqrt(3.0))
        off = np.linalg.norm(found.apply(TARGETS) - truth.apply(TARGETS), axis=1)
        measured.append((off / known) ** 2)
        localised.append(found.fle_mm**2 / 0.16 * 3.0)
        before.append(found.fre_mm**2)
    # Sibson: FRE^2 = (1 - 2 / N) FLE^2, here of nine degrees of freedom.
    check_mean(localised, 9)
    assert np.mean(before) == pytest.approx((1.0 - 2.0 / 5.0) * 3.0 * 0.16, rel=0.1)
    ratio = np.mean(measured, axis=0)
    assert np.allclose(ratio, 1.0, atol=4.0 * np.std(measured, axis=0) / np.sqrt(120))


@given(st.integers(0, 1000), transforms(covariance=False))
def test_fitzpatrick_is_the_same_in_any_frame(seed: int, other: Transform) -> None:
    source = fiducials(np.random.default_rng(seed), 5)
    here = target_registration_error(source, TARGETS, 0.5)
    assert np.allclose(
        target_registration_error(other.apply(source), other.apply(TARGETS), 0.5), here
    )
    assert (here >= 0.5 / np.sqrt(5) - 1e-12).all()


def test_the_scale_has_its_share_of_the_error() -> None:
    squares = []
    for seed in range(60):
        p_value = np.random.default_rng(seed)
        # Far from the origin, where turn, shift and scale are entangled.
        truth, source = anywhere(p_value), fiducials(p_value, 8) + AWAY
        target = truth.apply(1.01 * source) + 0.3 * p_value.normal(size=(8, 3))
        spread = 0.09 * np.eye(3)
        found = register_points(source, target, None, spread, scaled=True)
        targets = TARGETS + AWAY
        off = found.apply(targets) - truth.apply(1.01 * targets)
        covariance = found.target_covariance(targets)
        squares += [one @ np.linalg.solve(c, one) for one, c in zip(off, covariance, strict=True)]
        without = register_points(source, target, None, spread)
        assert (without.target_error(targets) <= found.target_error(targets) + 1e-12).all()
    # Three targets share an error; they count as one try of 3 x 3.
    check_mean(squares, 3, 0.12)


@settings(max_examples=20)
@given(transforms(covariance=False), st.booleans(), st.sampled_from(["covariances", "isotropic"]))
def test_predictions_do_not_depend_on_where_the_origin_is(
    motion: Transform, scaled: bool, weighting: str
) -> None:
    p_value = np.random.default_rng(0)
    source = fiducials(p_value, 7)
    covariances = np.array([point_covariance(p_value, 0.3) for _ in source])
    target = source + drawn(p_value, covariances)
    here, there = (
        register_points(
            one,
            target,
            None,
            covariances,
            weighting=weighting,  # type: ignore[arg-type]
            scaled=scaled,
        )
        for one in (source, motion.apply(source))
    )
    one, other = here.target_covariance(TARGETS), there.target_covariance(motion.apply(TARGETS))
    assert np.allclose(one, other, rtol=1e-4, atol=1e-6)
    assert here.fre_mm == pytest.approx(there.fre_mm, rel=1e-6)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("count", [4, 6, 10])
def test_exchanged_fiducials_are_named(count: int, known: bool) -> None:
    named = 0
    for seed in range(15):
        p_value = np.random.default_rng(seed)
        source = fiducials(p_value, count)
        order = np.arange(count)
        pair = np.sort(p_value.choice(count, 2, replace=False))
        order[pair] = order[pair[::-1]]
        target = anywhere(p_value).apply(source) + 0.3 * p_value.normal(size=source.shape)
        spread = 0.09 * np.eye(3) if known else None
        found = register_points(source, target[order], None, spread)
        assert found.correspondence_errors is not None
        if (
            found.correspondence_errors.kind == "exchanged"
            and found.correspondence_errors.pairs == tuple(pair)
        ):
            named += 1
            # What it says mends it does.
            mended = register_points(
                source, target[order][list(found.correspondence_errors.order)], None, spread
            )
            assert mended.correspondence_errors is None
            assert mended.fre_mm == pytest.approx(
                found.correspondence_errors.rms_after_mm, rel=0.01
            )
            assert "exchanged" in found.warnings[0]
    # Two that happen to lie near one another may be explained another way.
    assert named >= 14


@pytest.mark.parametrize(("count", "known"), [(5, True), (6, False), (10, True), (10, False)])
def test_a_fiducial_that_was_moved_is_named(count: int, known: bool) -> None:
    named = 0
    for seed in range(15):
        p_value = np.random.default_rng(seed)
        source = fiducials(p_value, count)
        target = anywhere(p_value).apply(source) + 0.2 * p_value.normal(size=source.shape)
        target[2] += [12.0, -9.0, 5.0]
        found = register_points(source, target, None, 0.04 * np.eye(3) if known else None)
        named += found.correspondence_errors is not None and found.correspondence_errors.pairs == (
            2,
        )
        if known:
            assert any('"3"' in one and "not where" in one for one in found.warnings)
    assert named >= 13


def test_good_pairs_are_not_accused() -> None:
    accused = sum(
        isotropic(seed, 7, 0.5)[2].correspondence_errors is not None for seed in range(60)
    )
    for seed in range(60):
        p_value = np.random.default_rng(seed)
        source = fiducials(p_value, 5)
        target = anywhere(p_value).apply(source) + 0.5 * p_value.normal(size=source.shape)
        accused += (
            register_points(source, target, None, 0.25 * np.eye(3)).correspondence_errors
            is not None
        )
    # One in a thousand.
    assert accused <= 3


def test_look_alikes_are_told_before_they_are_exchanged() -> None:
    p_value = np.random.default_rng(0)
    triangle = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [50.0, 86.6, 0.0]])
    target = anywhere(p_value).apply(triangle) + 0.1 * p_value.normal(size=(3, 3))
    found = register_points(triangle, target, None, 0.01 * np.eye(3))
    assert any("another order" in one for one in found.warnings)
    uneven = register_points(TETRAHEDRON, TETRAHEDRON, None, 0.01 * np.eye(3))
    assert uneven.warnings == ()


def test_a_mirrored_order_is_no_look_alike() -> None:
    """A regular tetrahedron is itself in every even order, and its mirror image in odd ones."""
    corners = 50.0 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    _, others = find_correspondence_errors(corners, corners, np.full(4, 0.01))
    assert len(others) == 11
    assert all(np.isclose(np.linalg.det(np.eye(4)[list(order)]), 1.0) for order in others)


def test_covariances_that_are_too_small_are_told() -> None:
    p_value = np.random.default_rng(0)
    target = TETRAHEDRON + p_value.normal(size=(4, 3))
    found = register_points(TETRAHEDRON, target, None, 0.0025 * np.eye(3))
    assert found.correspondence_errors is None
    assert any("covariances are too small" in one for one in found.warnings)


def test_collinear_fiducials_are_refused_and_nearly_collinear_ones_warned_of() -> None:
    line = np.outer(np.arange(5) * 30.0, [1.0, 2.0, 2.0]) / 3.0
    p_value = np.random.default_rng(0)
    with pytest.raises(CollinearPoints, match=r"0 mm RMS off one line, .* 42\.43 mm RMS"):
        register_points(line, line)
    near = line + 0.05 * p_value.normal(size=(5, 3))
    with pytest.raises(CollinearPoints, match=r"in the target .* at least 0\.42"):
        register_points(line + 5.0 * p_value.normal(size=(5, 3)), near)
    # The same places that are known to 1 mm leave the turn open, and to 0.01 mm do not.
    flat = line + 1.2 * p_value.normal(size=(5, 3))
    with pytest.raises(CollinearPoints) as caught:
        register_points(flat, flat, None, 4.0 * np.eye(3))
    assert caught.value.context["needed_mm"] == pytest.approx(6.0 / np.sqrt(5), rel=0.01)
    found = register_points(flat, flat, None, 0.01 * np.eye(3))
    (warning,) = found.warnings
    assert "off one line" in warning
    turn = float(np.sqrt(np.linalg.eigvalsh(found.parameter_covariance[:3, :3])[-1]))
    assert f"{np.degrees(turn):.2g} deg" in warning
    # What it says of targets is what is predicted there.
    away = flat.mean(axis=0) + 42.4 * np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0)
    assert found.target_error(away) == pytest.approx(42.4 * turn, rel=0.15)


def test_requests_that_cannot_be_served_are_told_why() -> None:
    other = TETRAHEDRON[::-1]
    with pytest.raises(TooFewPoints, match=r"2 pairs of points; .* at least 3"):
        register_points(TETRAHEDRON[:2], TETRAHEDRON[:2])
    with pytest.raises(DuplicatePoint, match='"a" and "c" are at one position in the source'):
        register_points(TETRAHEDRON[[0, 1, 0, 2]], other, names=["a", "b", "c", "d"])
    with pytest.raises(DuplicatePoint, match='"1" and "2" are at one position in the target'):
        register_points(other, TETRAHEDRON[[0, 0, 1, 2]])
    with pytest.raises(InvalidParameter, match="4 source points and 3"):
        register_points(TETRAHEDRON, TETRAHEDRON[:3])
    with pytest.raises(InvalidParameter, match="1 names for 4"):
        register_points(TETRAHEDRON, other, names=["a"])
    with pytest.raises(NonFiniteValue, match="point 1 of the target"):
        register_points(TETRAHEDRON, TETRAHEDRON * [[np.nan], [1], [1], [1]])
    with pytest.raises(InvalidParameter, match="must be positive"):
        register_points(TETRAHEDRON, other, None, np.diag([1.0, 1.0, 0.0]))
    with pytest.raises(InvalidParameter, match="source's covariance has shape"):
        register_points(TETRAHEDRON, other, np.ones((2, 3, 3)))
    with pytest.raises(InvalidParameter, match=r"shape \(4, 2\)"):
        register_points(TETRAHEDRON[:, :2], other)
