"""Line-spread function of all sensors of a device, from the measured ones of each."""

from collections.abc import Sequence

import numpy as np

from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.measured_line_spread import MeasuredLineSpread


def device_line_spread(
    shapes: Sequence[MeasuredLineSpread | None], default_width_px: float | None
) -> tuple[LineSpreadFunction, float]:
    """Return one line-spread function for all sensors of a device, and its unit [px].

    Nodes and cells are brought to one grid; a sensor without a shape has a Gaussian.

    Args:
        shapes: of the S sensors; None: not measured. One at least is.
        default_width_px: standard deviation of the lines of the others [px]; None: the mean of
            those that were measured.
    """
    defined = [one for one in shapes if one is not None]
    unit = float(np.mean([one.width_px for one in defined]))
    if default_width_px is None:
        default_width_px = unit
    reach = max(max(-one.first_px for one in defined), np.ceil(6.0 * default_width_px))
    step = min(one.step_px for one in defined)
    edges = np.arange(-round(reach / step), round(reach / step) + 1) * step
    low = min(one.first_node_px for one in defined)
    high = max(one.first_node_px + (len(one.light) - 1) * one.node_step_px for one in defined)
    node_step = min(one.node_step_px for one in defined)
    nodes = max(int(np.ceil((high - low) / node_step)) + 1, 2)
    positions = np.linspace(low, high, nodes)
    gaussian = LineSpreadFunction.gaussian()
    light = np.empty((len(shapes), nodes, len(edges) - 1))
    for row, one in zip(light, shapes, strict=True):
        if one is None:
            row[:] = np.diff(gaussian.at(edges / default_width_px)[0])
            continue
        function = LineSpreadFunction.from_cells(
            one.light[None], one.first_px, one.step_px, one.first_node_px, one.node_step_px
        )
        for number, position in enumerate(positions):
            row[number] = np.maximum(np.diff(function.at(edges, 0, position)[0]), 0.0)
    function = LineSpreadFunction.from_cells(
        light, float(edges[0]), step, float(low), float(positions[1] - positions[0]), unit
    )
    return function, unit
