"""Rigid bodies among candidates: points with the distances of a tool's markers."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from math import log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_matrix
from compute.errors import InvalidParameter
from compute.reconstruction.correspondence.candidates import MISFIT_BANDS, Candidates, MisfitDensity
from compute.reconstruction.correspondence.settings import FALSE_REJECTION, MatchSettings
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

MAX_POINTS: Final = 1_200
"""Points whose distances are looked at; ten markers on three sensors make 1,000."""
MAX_BRANCHES: Final = 50_000
_GATE: Final = chi2_limit(1, FALSE_REJECTION) ** 0.5
_STEPS: Final = 5


@dataclass(frozen=True, eq=False)
class BodyMatch:
    """Candidates that match the markers of a rigid body.

    Args:
        rows: index of each marker's candidate, -1: that marker is not seen.
        score: log likelihood ratio to these peaks being no one's, as of ``Candidates.scores``.
        chi2: of the readings and of the rigid fit.
        dof: of freedom of ``chi2``.
    """

    rows: tuple[int, ...]
    score: float
    chi2: float
    dof: int


def body_matches(
    markers_mm: Array,
    candidates: Candidates,
    scores: Array,
    settings: MatchSettings,
    misfit_density: MisfitDensity,
) -> tuple[list[BodyMatch], int]:
    """Find a body among candidates: all its markers, or all but one of four or more.

    Distances are tried first, marker by marker; what holds them all is fitted as a rigid body,
    which its mirror image does not fit.

    Args:
        markers_mm: in the body's coordinates, shape (M, 3), M at least 3 [mm].
        candidates: C candidates.
        scores: of each, as markers on their own, shape (C,).
        settings: the model of peaks.
        misfit_density: counts distances that are near by chance.

    Returns:
        The matches, and how many candidates and branches were cut.

    Raises:
        InvalidParameter: fewer than three markers, or two at one place.
    """
    apart = np.linalg.norm(markers_mm[:, None] - markers_mm, axis=-1)
    count = len(markers_mm)
    if count < 3 or not (apart[np.triu_indices(count, 1)] > 0.0).all():
        raise InvalidParameter(
            f"a rigid body has {count} markers, {len(np.unique(markers_mm, axis=0))} of them "
            "apart; it needs three or more, all at different places"
        )
    cut = max(len(candidates) - MAX_POINTS, 0)
    kept = np.sort(np.argsort(-scores, kind="stable")[:MAX_POINTS])
    near = _Distances(candidates.take(kept), misfit_density)
    matches: list[BodyMatch] = []
    for size in (count, count - 1):
        if size < 3 or matches:
            break
        for subset in combinations(range(count), size):
            for tried, rows in enumerate(near.sets(apart[np.ix_(subset, subset)])):
                if tried >= MAX_BRANCHES:
                    cut += 1
                    break
                chosen = kept[list(rows)]
                match = _match(markers_mm, subset, candidates, chosen, scores, settings)
                if match is not None:
                    matches.append(match)
    return matches, cut


class _Distances:
    """Distances between candidates with their deviations, and which may be taken together."""

    def __init__(self, candidates: Candidates, misfit_density: MisfitDensity) -> None:
        place = candidates.position_mm
        away = place[:, None] - place
        self.length = np.sqrt((away**2).sum(axis=-1))
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.nan_to_num(away / self.length[..., None])
        by_first = np.einsum("abi,aij,abj->ab", unit, candidates.covariance_mm2, unit)
        self.sigma = np.sqrt(by_first + by_first.T)
        both = candidates.choice[:, None] == candidates.choice
        self.apart = ~(both & (candidates.choice >= 0)).any(axis=-1)
        self.misfit_density = misfit_density

    def sets(self, lengths: Array) -> Iterator[tuple[int, ...]]:
        """Yield the candidates, marker by marker, whose distances are these (M, M)."""
        count = len(lengths)
        fits: dict[tuple[int, int], NDArray[np.bool_]] = {}
        for a, b in combinations(range(count), 2):
            misfit = np.abs(self.length - lengths[a, b])
            inside = (misfit <= _GATE * self.sigma) & self.apart
            within = misfit <= _GATE * self.sigma * MISFIT_BANDS[:, None, None]
            hits = (within & self.apart).sum(axis=(1, 2)) - 1.0
            pairs = float(np.count_nonzero(self.apart))
            self.misfit_density.add(hits, 2.0 * _GATE * MISFIT_BANDS * pairs)
            fits[a, b] = inside

        def grown(rows: tuple[int, ...], open_to: NDArray[np.bool_]) -> Iterator[tuple[int, ...]]:
            if len(rows) == count:
                yield rows
                return
            for row in np.flatnonzero(open_to):
                chosen = (*rows, int(row))
                if len(chosen) == count:
                    yield chosen
                    continue
                left = np.ones(len(self.length), dtype=np.bool_)
                for marker, one in enumerate(chosen):
                    left &= fits[marker, len(chosen)][one]
                if left.any():
                    yield from grown(chosen, left)

        first = np.ones(len(self.length), dtype=np.bool_)
        for (a, _), matrix in fits.items():
            if a == 0:
                first &= matrix.any(axis=1)
        yield from grown((), first)


def _match(
    markers_mm: Array,
    subset: tuple[int, ...],
    candidates: Candidates,
    chosen: NDArray[np.intp],
    scores: Array,
    settings: MatchSettings,
) -> BodyMatch | None:
    """Fit candidates as a rigid body; None where they are none."""
    covariance = candidates.covariance_mm2[chosen]
    chi2, information = _rigid_fit(
        markers_mm[list(subset)], candidates.position_mm[chosen], covariance
    )
    dof = 3 * len(subset) - 6
    if not chi2 <= chi2_limit(dof, FALSE_REJECTION):
        return None
    # Instead of anywhere each, the markers are where one pose puts them, which may be any.
    _, log_information = np.linalg.slogdet(information)
    density = log(settings.markers_per_mm3)
    pose = density - log(8.0 * pi**2) + 3.0 * log(2.0 * pi) - 0.5 * float(log_information)
    spread = 0.5 * float(np.log(np.linalg.det(2.0 * pi * covariance)).sum()) + 0.5 * chi2
    missed = len(markers_mm) - len(subset)
    sensors = candidates.choice.shape[1]
    score = (
        float(scores[chosen].sum())
        - len(subset) * density
        + pose
        - spread
        + missed * sensors * settings.log_missed
    )
    rows = np.full(len(markers_mm), -1)
    rows[list(subset)] = chosen
    return BodyMatch(
        tuple(int(row) for row in rows),
        score,
        chi2 + float(candidates.chi2[chosen].sum()),
        dof + int(candidates.dof[chosen].sum()),
    )


def _rigid_fit(body_mm: Array, position_mm: Array, covariance_mm2: Array) -> tuple[float, Array]:
    """Return chi2 of the best pose of a body (M, 3) at places (M, 3), and its information."""
    middle, centre = body_mm.mean(axis=0), position_mm.mean(axis=0)
    u, _, vt = np.linalg.svd((body_mm - middle).T @ (position_mm - centre))
    turn = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = vt.T @ turn @ u.T
    shift = centre - rotation @ middle
    weight = np.linalg.inv(covariance_mm2)
    rows = np.zeros((len(body_mm), 3, 6))
    rows[:, :, 3:] = np.eye(3)
    for _ in range(_STEPS):
        turned = body_mm @ rotation.T
        # A left rotation w moves R b by w x R b.
        rows[:, 0, 1], rows[:, 0, 2] = turned[:, 2], -turned[:, 1]
        rows[:, 1, 0], rows[:, 1, 2] = -turned[:, 2], turned[:, 0]
        rows[:, 2, 0], rows[:, 2, 1] = turned[:, 1], -turned[:, 0]
        residual = position_mm - turned - shift
        information = np.einsum("mia,mij,mjb->ab", rows, weight, rows)
        pull = np.einsum("mia,mij,mj->a", rows, weight, residual)
        # Markers in a line leave the turn about it open.
        step = np.linalg.lstsq(information, pull, rcond=1e-12)[0]
        rotation = rotation_matrix(step[:3]) @ rotation
        shift = shift + step[3:]
    residual = position_mm - body_mm @ rotation.T - shift
    chi2 = float(np.einsum("mi,mij,mj->", residual, weight, residual))
    return chi2, information
