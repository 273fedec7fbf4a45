"""Gaussian prior of what readings of a distorting lens determine weakly.

In a narrow field the principal distance and the depth, the principal point and a rotation, and the
terms of high order act nearly alike. So does the offset along the slit, on which the field angle v
depends. ``LensPrior`` holds what readings leave open; cameras without distortion have no prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import WEAK_STRENGTH
from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

OFFSET_SIGMA_V: Final = 0.1
"""Standard deviation of the field angle v (tangent) of the centroid: six degrees. Operators aim a
lens at the centre of its volume at least as well; its field is three times as wide."""
PRINCIPAL_POINT_SIGMA: Final = 0.25
"""Standard deviation of a distorting lens's principal point about the sensor's middle, relative to
its length."""
HIGHER_TERM_SCALE: Final = 0.3
"""Expected size of terms of the next two orders, and of terms that a centred lens has not got,
relative to those of the order below and to those that it has."""


@dataclass(frozen=True, eq=False)
class LensPrior:
    """Gaussian prior of what readings determine weakly where a lens distorts.

    Independent normal distributions: the offset along the slit, the principal point, and each
    coefficient about 0. The standard deviation of a coefficient is what makes its term
    ``strength * relative_term_scale`` of half the field at the field's edge.

    Args:
        row_behind_mm: see ``FieldDistortion``, shape (S,) [mm]; known.
        offset_mm: mean offset along the slit, shape (S,) [mm].
        offset_sigma_mm: its standard deviation, shape (S,) [mm]; infinite: no prior.
        principal_point_px: mean principal point, shape (S,) [px].
        principal_point_sigma_px: its standard deviation, shape (S,) [px].
        half_field_u: tangent of half the field of view, shape (S,).
        strength: share of half the field, shape (S,); infinite: no prior.
    """

    row_behind_mm: Array
    offset_mm: Array
    offset_sigma_mm: Array
    principal_point_px: Array
    principal_point_sigma_px: Array
    half_field_u: Array
    strength: Array

    @classmethod
    def of(
        cls,
        models: Sequence[SensorModel],
        pitch_um: Sequence[float | None],
        points_mm: Array,
        measured: NDArray[np.bool_],
        strength: float = WEAK_STRENGTH,
        stack: CameraStack | None = None,
    ) -> "LensPrior":
        """Derive the prior from cameras and the control points that they saw.

        Args:
            models: S cameras, without distortion or with that of an earlier fit.
            pitch_um: the sensors' pixel pitches [um]; None: not known.
            points_mm: control points, shape (N, 3) [mm].
            measured: which of them each sensor saw, shape (N, S).
            strength: see the class.
            stack: the same cameras as a stack; None: made here.
        """
        centre_mm = (measured.T @ points_mm) / measured.sum(axis=0)[:, None]
        if stack is None:
            stack = CameraStack.of(models)
        centre = (stack.rotation @ centre_mm[:, :, None])[..., 0]
        behind = np.array(
            [
                (0.0 if pitch is None else 1e-3 * pitch * model.principal_distance_px)
                if model.distortion is None
                else model.distortion.row_behind_mm
                for model, pitch in zip(models, pitch_um, strict=True)
            ]
        )
        pixels = np.array([model.pixels for model in models], dtype=np.float64)
        return cls(
            behind,
            -centre[:, 1],
            OFFSET_SIGMA_V * (centre[:, 2] + stack.offset_mm[:, 2] + behind),
            0.5 * (pixels - 1.0),
            PRINCIPAL_POINT_SIGMA * pixels,
            0.5 * pixels / stack.principal_distance_px,
            np.full(len(models), strength),
        )

    def rows(self, index: NDArray[np.intp]) -> "LensPrior":
        """Return the prior of the cameras with these indices."""
        return LensPrior(*(getattr(self, field.name)[index] for field in fields(self)))

    def at(self, models: Sequence[SensorModel], pitch_um: Sequence[float | None]) -> "LensPrior":
        """Return the prior with the pixel rows at the fitted principal distances.

        Args:
            models: the S fitted cameras.
            pitch_um: the sensors' pixel pitches [um]; None: not known, the row stays.
        """
        behind = self.row_behind_mm.copy()
        for row, (model, pitch) in enumerate(zip(models, pitch_um, strict=True)):
            if pitch is not None:
                behind[row] = 1e-3 * pitch * model.principal_distance_px
        return replace(self, row_behind_mm=behind)

    def scaled(self, sigma_px: Array) -> "LensPrior":
        """Return the prior in units for weights of 1, where noise is ``sigma_px`` (S,) [px]."""
        return replace(
            self,
            offset_sigma_mm=self.offset_sigma_mm / sigma_px,
            principal_point_sigma_px=self.principal_point_sigma_px / sigma_px,
            strength=self.strength / sigma_px,
        )

    def with_strength(self, strength: float | Array) -> "LensPrior":
        """Return the prior with another strength, one for all or shape (S,)."""
        return replace(self, strength=np.broadcast_to(strength, self.strength.shape).copy())

    def gaussian(self, cameras: CameraStack) -> tuple[Array, Array]:
        """Return means and information (1 / variance) by the stack's columns, both (S, width).

        Args:
            cameras: the S cameras; those without distortion have no prior, nor do parameters that
                a camera has not got.
        """
        mean = np.zeros((len(cameras), cameras.width))
        information = np.zeros_like(mean)
        if not cameras.has_distortion:
            return mean, information
        mean[:, 1], mean[:, PARAMETER_COUNT] = self.principal_point_px, self.offset_mm
        information[:, 1] = self.principal_point_sigma_px**-2.0
        information[:, PARAMETER_COUNT] = self.offset_sigma_mm**-2.0
        for column, (i, j) in enumerate(cameras.terms, start=PARAMETER_COUNT + 1):
            edge = self.half_field_u ** (i + j - 1)
            information[:, column] = (edge / (self.strength * relative_term_scale((i, j)))) ** 2
        information *= cameras.parameter_mask
        information[~cameras.parameter_mask[:, PARAMETER_COUNT]] = 0.0
        return mean, information


def weak_parameters(cameras: CameraStack) -> Array:
    """Return the parameters that ``LensPrior`` holds, by the stack's columns, others 0, (S, width).

    Args:
        cameras: S cameras with distortion.
    """
    values = np.zeros((len(cameras), cameras.width))
    values[:, 1] = cameras.principal_point_px
    values[:, PARAMETER_COUNT] = cameras.offset_mm[:, 1]
    values[:, PARAMETER_COUNT + 1 :] = cameras.coefficients
    return values


def relative_term_scale(term: Term) -> float:
    """Return a term's expected size at the field's edge, relative to the symmetric cubic ones.

    Args:
        term: powers (i, j).
    """
    i, j = term
    symmetric = i % 2 == 1 and j % 2 == 0
    return HIGHER_TERM_SCALE ** ((i + j - 2) // 2) * (1.0 if symmetric else HIGHER_TERM_SCALE)


def start_with_terms(
    models: Sequence[SensorModel], terms: Sequence[tuple[Term, ...]], prior: LensPrior
) -> tuple[SensorModel, ...]:
    """Return starting cameras with distortion terms; coefficients that they have are kept.

    Args:
        models: S cameras.
        terms: the terms of each; an empty tuple: no distortion.
        prior: its mean offsets, at which cameras without distortion start.
    """
    starts = []
    for row, (model, model_terms) in enumerate(zip(models, terms, strict=True)):
        old = model.distortion
        coefficients = {} if old is None else dict(zip(old.terms, old.coefficients, strict=True))
        distortion = None
        if model_terms:
            distortion = FieldDistortion(
                model_terms,
                tuple(coefficients.get(term, 0.0) for term in model_terms),
                float(prior.offset_mm[row]) if old is None else old.offset_y_mm,
                float(prior.row_behind_mm[row]),
            )
        starts.append(replace(model, distortion=distortion))
    return tuple(starts)
