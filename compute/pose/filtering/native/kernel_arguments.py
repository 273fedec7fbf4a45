"""Argument record of the strobed-step kernel for one tool; the kernel itself, and its memory."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.filtering.imm import IMM_STATES, ImmModel
from compute.pose.filtering.native.definitions import HEAD, POSE, STEP
from compute.pose.filtering.native.pose_reliability import reliability_kernel
from compute.pose.filtering.pose_filter import STATES
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.native.definitions import MAX_POWER, fill_cameras, row_length
from compute.reconstruction.solver import MAX_SENSORS, MIN_CAPACITY
from compute.reconstruction.triangulation import chi2_limit
from compute.warp_host import address


def tool_record(
    model: MeasurementModel,
    imm: ImmModel,
    centred: CentredMarkers,
    common_errors: int,
    gate_probability: float,
) -> tuple[NDArray[np.void], list[NDArray[Any]]]:
    """Return the STEP of a tool, shape (1,), and the arrays whose addresses it holds.

    Args:
        model: the cameras.
        imm: the motion models.
        centred: the tool's markers.
        common_errors: number of common errors of its filter.
        gate_probability: probability that a correct reading is outside the gate.
    """
    sensors = len(model)
    step = np.zeros(1, dtype=STEP)
    buffers: list[NDArray[Any]] = []

    def keep(values: NDArray[Any]) -> int:
        array = np.ascontiguousarray(values)
        buffers.append(array)
        return address(array)

    columns = model.covariance_factor * model.cameras.parameter_mask[..., None]
    limits = [chi2_limit(count, gate_probability) for count in range(sensors + 1)]
    for name, values in (
        ("columns", columns),
        ("persistence", imm.state_mask),
        ("initial_covariance", imm.initial_covariance),
        ("renewal", imm.constant_velocity),
        ("terms", imm.noise_terms),
        ("markers", centred.markers_mm),
        ("chi2_limits", np.array(limits)),
        ("scratch", np.empty(scratch_size(sensors, len(imm), common_errors))),
    ):
        step[name] = keep(values)
    row = row_length(sensors, cuda=False)
    fill_cameras(step["cameras"], keep, model.cameras, model.corrections, row)
    for name, value in (
        ("modes", len(imm)),
        ("errors", common_errors),
        ("calibration_errors", columns.shape[2]),
        ("gate", chi2_limit(1, gate_probability)),
        ("radius_mm", centred.radius_mm),
        ("principal_distance_px", model.cameras.principal_distance_px.min()),
        ("centroid", centred.centroid_mm),
        ("tip", centred.tip_mm),
    ):
        step[name] = value
    return step, buffers


@cache
def step_kernel(sensors: int, capacity: int) -> Any:
    """Return the strobed-step kernel; it takes the address of a FRAME.

    Loads Warp. Launch it with one thread, on the CPU.

    Args:
        sensors: number of sensors.
        capacity: largest number of distortion terms.
    """
    from compute.native.native_kernel import native_kernel

    return native_kernel(
        "compute/pose/filtering/native/strobed_step.h",
        f"lumiline::pose::take_steps<{sensors}, {capacity}>(address);",
    )


def has_kernel(model: MeasurementModel, imm: ImmModel) -> bool:
    """Return whether there is a kernel for these cameras and motion models.

    Args:
        model: the cameras.
        imm: the motion models.
    """
    cameras = model.cameras
    powers = max((max(term) for term in cameras.terms), default=0)
    return len(imm) > 1 and 1 <= len(cameras) <= MAX_SENSORS and powers <= MAX_POWER


def load_kernels(sensors: int) -> None:
    """Load the kernels for a number of sensors, with up to MIN_CAPACITY terms of distortion."""
    for capacity in (0, MIN_CAPACITY):
        for kernel in (step_kernel, reliability_kernel):
            kernel(sensors, capacity).module.load("cpu", block_dim=1)


def imm_state_size(modes: int, errors: int) -> int:
    """Return the number of float64 of an ImmState.

    Args:
        modes: number K of motion models.
        errors: number E of common errors.
    """
    return POSE + modes * (1 + IMM_STATES + IMM_STATES * (IMM_STATES + errors))


def result_size(sensors: int, errors: int) -> int:
    """Return the number of float64 of a result.

    A result holds the head; the index of each sensor's peak, -1: none; the excluded squares; the
    combined state; the whitened innovations, (n, 1 + E).

    Args:
        sensors: number of sensors.
        errors: number E of common errors.
    """
    return HEAD + 2 * sensors + POSE + STATES * (STATES + errors) + sensors * (1 + errors)


def scratch_size(sensors: int, modes: int, errors: int) -> int:
    """Return the number of float64 of the kernel's scratch memory.

    Args:
        sensors: number of sensors.
        modes: number K of motion models.
        errors: number E of common errors.
    """
    wide = IMM_STATES + errors
    mixing = modes * modes + IMM_STATES * IMM_STATES + IMM_STATES
    readings = sensors * (errors + wide) + modes * (sensors * (1 + wide) + 2)
    return mixing + readings + IMM_STATES * wide
