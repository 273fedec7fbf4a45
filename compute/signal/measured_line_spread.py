"""MeasuredLineSpread: line-spread function of one sensor, measured, by position along it."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.parameter_checks import require

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeasuredLineSpread:
    """Line-spread function of one sensor at N nodes along it, as light in cells finer than pixels.

    The position of a line is its centre of gravity.

    Args:
        light: share of each cell, shape (N, C); the sum of a node is one.
        first_px: left edge of the first cell, from the line's position [px].
        step_px: width of a cell [px].
        first_node_px: position of the first node [px].
        node_step_px: distance of nodes [px].
        width_px: standard deviation of the lines, by the Gaussian that fits best [px].
        lines: number of lines that it was estimated from.
        reduced_chi2: misfit of these lines per degree of freedom.

    Raises:
        InvalidParameter: a shape or value outside its range.
    """

    light: Array
    first_px: float
    step_px: float
    first_node_px: float
    node_step_px: float
    width_px: float
    lines: int
    reduced_chi2: float

    def __post_init__(self) -> None:
        require(0.0 < self.width_px < np.inf, "be positive", width_px=self.width_px)
        require(0.0 < self.step_px < np.inf, "be positive", step_px=self.step_px)
        require(0.0 < self.node_step_px < np.inf, "be positive", node_step_px=self.node_step_px)
        first = np.array([self.first_px, self.first_node_px])
        light = self.light
        if light.ndim != 2 or len(light) == 0 or light.shape[1] < 3:
            raise InvalidParameter(
                f"light has the shape {light.shape}; it must be (N, C), with 3 cells or more"
            )
        usable = np.isfinite(light).all() and (light >= 0.0).all() and np.isfinite(first).all()
        if not (usable and (light.sum(axis=1) > 0.0).all()):
            raise InvalidParameter(
                "light, first_px or first_node_px is not finite, light is negative, or a node has "
                "none; shares must be zero or more, some at each node"
            )

    @property
    def skewness(self) -> Array:
        """Third moment at each node over its standard deviation cubed, shape (N,).

        Within four widths: farther out the noise of the shape would rule.
        """
        t = self.first_px + (np.arange(self.light.shape[1]) + 0.5) * self.step_px
        light = np.where(np.abs(t) <= 4.0 * self.width_px, self.light, 0.0)
        light /= light.sum(axis=1, keepdims=True)
        away = t - (light @ t)[:, None]
        second, third = (np.sum(light * away**power, axis=1) for power in (2, 3))
        return np.asarray(third / second**1.5)

    def to_document(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            field.name: self.light.tolist() if field.name == "light" else getattr(self, field.name)
            for field in fields(self)
        }

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "MeasuredLineSpread":
        """Return the line shape of a JSON object.

        Raises:
            InvalidParameter: a field is missing, unknown, or of a wrong shape or value.
        """
        names = {field.name for field in fields(cls)}
        if set(document) != names:
            raise InvalidParameter(
                f"the line shape has the fields {sorted(document)}; it must have {sorted(names)}"
            )
        try:
            return cls(**(document | {"light": np.array(document["light"], dtype=np.float64)}))
        except (TypeError, ValueError) as error:
            raise InvalidParameter(
                f"the line shape holds a value of another type: {error}"
            ) from error
