"""Cameras with distortion by both field angles, fitted to readings from undistorted starts.

The offset along the slit, on which v depends, is fitted where a term has v in it. Readings say
little of it: it shifts v by its share of the depth, and all but the change of that with depth is
what tilt and the lower terms do too. So it has a prior: the lens sees the control points' centroid
at v = 0 +- OFFSET_SIGMA_V. That holds it where nothing else does, without distortion above all,
and gives way to readings that know better; its share of the covariance is that of the prior then.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.distortion_terms import depends_on_v
from compute.calibration.single_sensor.levenberg_marquardt import (
    MinimisationResult,
    OffsetPrior,
    minimise,
)
from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

OFFSET_SIGMA_V: Final = 0.1
"""Standard deviation of the v at which the centroid is seen: six degrees. A lens looks at the
middle of its volume as well as that, and its field is three times as wide."""
START_FIELD_ANGLES_V: Final = (0.0, -0.1, 0.1)
"""At which v of the centroid the search starts."""


@dataclass(frozen=True, eq=False)
class LensOffsets:
    """Where the slits lie that readings say little of.

    Args:
        row_behind_mm: see ``FieldDistortion``, shape (S,).
        prior: of the offsets along the slits.
    """

    row_behind_mm: Array
    prior: OffsetPrior

    @classmethod
    def of(
        cls,
        models: Sequence[SensorModel],
        pitch_um: Sequence[float | None],
        points_mm: Array,
        seen: NDArray[np.bool_],
    ) -> "LensOffsets":
        """Place them by cameras without distortion, or with that of an earlier fit.

        Args:
            models: S cameras.
            pitch_um: the sensors' pixel pitches [um]; None: not known.
            points_mm: control points, shape (N, 3).
            seen: which were read, shape (N, S).
        """
        centre_mm = (seen.T @ points_mm) / seen.sum(axis=0)[:, None]
        behind, mean, sigma = [], [], []
        for model, pitch, centre in zip(models, pitch_um, centre_mm, strict=True):
            _, y, z = (model.rotation @ centre).tolist()
            distortion = model.distortion
            if distortion is not None:
                behind.append(distortion.row_behind_mm)
            else:
                behind.append(0.0 if pitch is None else 1e-3 * pitch * model.principal_distance_px)
            mean.append(-y)
            sigma.append(OFFSET_SIGMA_V * (z + model.offset_z_mm + behind[-1]))
        return cls(np.array(behind), OffsetPrior(np.array(mean), np.array(sigma)))

    def at(self, models: Sequence[SensorModel], pitch_um: Sequence[float | None]) -> "LensOffsets":
        """Return them with the rows as far behind the lenses as the fitted cameras have them."""
        behind = self.row_behind_mm.copy()
        for row, (model, pitch) in enumerate(zip(models, pitch_um, strict=True)):
            if pitch is not None:
                behind[row] = 1e-3 * pitch * model.principal_distance_px
        return replace(self, row_behind_mm=behind)

    def scaled(self, sigma_px: Array) -> "LensOffsets":
        """Return them for readings whose weights are 1 and not 1 / sigma_px (S,)."""
        return replace(self, prior=replace(self.prior, sigma_mm=self.prior.sigma_mm / sigma_px))


def start_with_terms(
    models: Sequence[SensorModel], terms: Sequence[tuple[Term, ...]], lens_offsets: LensOffsets
) -> tuple[SensorModel, ...]:
    """Return the cameras with these terms (one set for each), starting from what they have.

    A sensor with no terms has no distortion.
    """
    given = []
    for row, (model, own) in enumerate(zip(models, terms, strict=True)):
        old = model.distortion
        known = {} if old is None else dict(zip(old.terms, old.coefficients, strict=True))
        distortion = None
        if own:
            distortion = FieldDistortion(
                own,
                tuple(known.get(term, 0.0) for term in own),
                float(lens_offsets.prior.mean_mm[row]) if old is None else old.offset_y_mm,
                float(lens_offsets.row_behind_mm[row]),
            )
        given.append(replace(model, distortion=distortion))
    return tuple(given)


def minimise_with_distortion(
    cameras: CameraStack,
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    prior: OffsetPrior,
    multi_start: bool = True,
) -> MinimisationResult:
    """Minimise from several offsets along the slit; the lowest for each camera.

    Args:
        cameras: B cameras at the prior's offsets.
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, B) [px].
        weights: 1 / sigma, shape (N, B), 0: not used.
        prior: of the offsets.
        multi_start: False: from where the cameras are only, which are near their minima.
    """
    if not multi_start or not depends_on_v(cameras.terms):
        return minimise(cameras, points_mm, readings_px, weights, prior)
    count, starts = len(cameras), len(START_FIELD_ANGLES_V)
    index = np.tile(np.arange(count), starts)
    stack = cameras.rows(index)
    step = np.zeros((len(index), cameras.width))
    away = np.repeat(np.array(START_FIELD_ANGLES_V) / OFFSET_SIGMA_V, count)
    step[:, PARAMETER_COUNT] = (
        away * prior.sigma_mm[index] * stack.parameter_mask[:, PARAMETER_COUNT]
    )
    ended = minimise(
        stack.retract(step), points_mm, readings_px[:, index], weights[:, index], prior.rows(index)
    )
    best = np.argmin(ended.squares.reshape(starts, count), axis=0) * count + np.arange(count)
    return MinimisationResult(ended.cameras.rows(best), ended.squares[best], ended.converged[best])
