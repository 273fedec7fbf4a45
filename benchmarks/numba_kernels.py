"""Benchmark of the CPU kernels in C++ against the same algorithms in Numba.

Run: ``python -m benchmarks.numba_kernels``. Three steps on which poses and tracks spend most of
their time, by the kernels' C++ as Warp compiles it and by Numba: the prediction of a tool's modes
(five, of 18 states and 28 common errors), the joint update of a track by four readings, and the
joint events of a cluster. "arrays" is the NumPy definition with what Numba does not take (products
of stacks of matrices) written mode by mode; "loops" is the kernel's algorithm written again in
Python. Numba does not compile the definition of joint events: dataclasses and dictionaries of
tuples.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks import numba_kernel_peers as peers
from benchmarks.numba_kernel_peers import ERRORS, STEP_S
from compute.native.headers import module_options
from compute.pose.filtering.imm import IMM_STATES, ImmModel
from compute.pose.filtering.native.definitions import POSE, STEP
from compute.pose.filtering.native.kernel_arguments import imm_state_size, scratch_size
from compute.pose.settings import ImmSettings, MotionSettings
from compute.tracking.native.definitions import JOB, MAX_OPTIONS, PARTIAL_BYTES
from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]

REPEATS: Final = 2000


def main() -> None:
    """Print the time per step [us], and its ratio to the kernel's."""
    for name, kernel, others in (_prediction(), _joint_update(), _joint_events()):
        native, *found = _best([kernel, *others.values()])
        print(f"{name}: C++ {native:.2f} us", end="")
        for other, took in zip(others, found, strict=True):
            print(f", Numba {other} {took:.2f} us ({took / native:.2f} times)", end="")
        print(flush=True)


def _best(calls: list[Callable[[], object]]) -> list[float]:
    """Return the shortest time per step [us] of REPEATS steps, measured alternately."""
    for call in calls:
        call()
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(20):
        for call, found in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            found.append(time.perf_counter() - start)
    return [1e6 * min(found) / REPEATS for found in times]


def _launch(header: str, body: str, record: NDArray[Any], *kept: object) -> Callable[[], object]:
    """Return a launch that runs C++ REPEATS times on the ``address`` of a record of ``kept``."""
    import warp as wp

    def repeat(address: wp.uint64, repeats: int) -> None: ...

    native = wp.func_native(f"for (int turn = 0; turn < repeats; ++turn) {{ {body} }}")(repeat)

    def repeated(address: wp.uint64, repeats: int) -> None:
        native(address, repeats)

    kernel = wp.kernel(module="unique", module_options=module_options(header))(repeated)
    launch = wp.launch(kernel, 1, inputs=[_address(record), REPEATS], device="cpu", record_cmd=True)

    def call() -> object:
        return launch.launch(), record, kept

    return call


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])


Case = tuple[str, Callable[[], object], dict[str, Callable[[], object]]]


def _prediction() -> Case:
    """The modes of a tool after 5 ms."""
    rng = np.random.default_rng(1)
    model = ImmModel.of(MotionSettings(), ImmSettings())
    count, wide = len(model), IMM_STATES + ERRORS
    before = np.zeros(imm_state_size(count, ERRORS))
    before[:9] = np.eye(3).ravel()
    before[9:POSE] = rng.normal(size=9)
    before[POSE : POSE + count] = 1.0 / count
    offsets = before[POSE + count :][: count * IMM_STATES].reshape(count, IMM_STATES)
    offsets[:-1] = 1e-3 * rng.normal(size=(count - 1, IMM_STATES))
    spread = before[POSE + count + count * IMM_STATES :].reshape(count, IMM_STATES, wide)
    for mode in range(count):
        root = rng.normal(size=(IMM_STATES, IMM_STATES))
        spread[mode, :, :IMM_STATES] = root @ root.T
        spread[mode, :, IMM_STATES:] = 0.1 * rng.normal(size=(IMM_STATES, ERRORS))
    after, scratch = np.zeros_like(before), np.zeros(scratch_size(4, count, ERRORS))
    constants = [
        np.ascontiguousarray(values, dtype=np.float64)
        for values in (
            model.state_mask,
            model.initial_covariance,
            model.constant_velocity,
            model.noise_terms,
        )
    ]
    step = np.zeros(1, STEP)
    step["before"], step["predicted"] = _address(before), _address(after)
    step["scratch"] = _address(scratch)
    step["modes"], step["errors"], step["time_s"] = count, ERRORS, STEP_S
    step["switch_probability"], step["manoeuvre_factor"] = model.switch_probability(STEP_S), 1.0
    for name, values in zip(
        ("persistence", "initial_covariance", "renewal", "terms"), constants, strict=True
    ):
        step[name] = _address(values)
    kernel = _launch(
        "compute/pose/filtering/native/strobed_step.h",
        "const lumiline::pose::StepRecord& step = *(const lumiline::pose::StepRecord*)address;"
        "lumiline::pose::Scratch scratch{step.scratch};"
        "lumiline::pose::ImmFilter(step, scratch).predict(step.before, step.predicted);",
        step,
        before,
        after,
        scratch,
        constants,
    )
    switching = model.transition_probabilities(STEP_S)
    found = np.zeros_like(before)
    calls: dict[str, Callable[[], object]] = {}
    for name, function in (
        ("arrays", peers.predict_by_arrays),
        ("loops", peers.predict_by_loops),
    ):
        arguments = (function, before, found, switching, *constants, scratch)
        calls[name] = partial(_repeat_prediction, *arguments)
        calls[name]()
        kernel()
        size = np.abs(after).max()
        assert np.allclose(found, after, rtol=1e-9, atol=1e-12 * size), name
    return "prediction of five modes", kernel, calls


@njit
def _repeat_prediction(function, before, after, switching, states, begun, brief, terms, scratch):
    for _ in range(REPEATS):
        function(before, after, switching, states, begun, brief, terms, scratch)


def _joint_update() -> Case:
    """One model's state after four readings."""
    rng = np.random.default_rng(2)
    sensors = 4
    root = rng.normal(size=(9, 9))
    mean, covariance = rng.normal(size=9), root @ root.T
    with_bias = 0.1 * rng.normal(size=(9, sensors))
    bias = 0.2 * np.eye(sensors)
    slopes, noise, off = (
        rng.normal(size=(sensors, 3)),
        np.full(sensors, 0.01),
        rng.normal(size=sensors),
    )
    numbers = np.zeros(15 + 9 * sensors)
    numbers[15 + 4 * sensors : 15 + 7 * sensors] = slopes.ravel()
    job = np.zeros(1, JOB)
    job["numbers"], job["bias"], job["models"], job["tracks"] = (
        _address(numbers),
        _address(bias),
        1,
        1,
    )
    found = np.zeros(9 + 81 + 9 * sensors)
    job["mean"], job["covariance"] = _address(mean), _address(covariance)
    job["with_bias"], job["position"], job["noise"] = (
        _address(with_bias),
        _address(off),
        _address(noise),
    )
    job["evidence"] = _address(found)
    kernel = _launch(
        "compute/tracking/native/association.h",
        "lumiline::tracking::AssociationJob& job = *(lumiline::tracking::AssociationJob*)address;"
        "lumiline::tracking::TrackStates<4, 0> tracks(job);"
        "const int used[4] = {0, 1, 2, 3};"
        "double *m = job.evidence, *p = m + 9, *q = p + 81, squared = 0.0;"
        "for (int i = 0; i < 9; ++i) m[i] = job.mean[i];"
        "for (int i = 0; i < 81; ++i) p[i] = job.covariance[i];"
        "for (int i = 0; i < 36; ++i) q[i] = job.with_bias[i];"
        "tracks.joint_update(m, p, q, 0, used, 4, job.noise, job.position, squared);",
        job,
        *(numbers, bias, mean, covariance, with_bias, off, noise, found),
    )
    calls: dict[str, Callable[[], object]] = {}
    for name, function in (
        ("arrays", peers.update_by_arrays),
        ("loops", peers.update_by_loops),
    ):
        m, p, q = np.zeros(9), np.zeros((9, 9)), np.zeros((9, sensors))
        arguments = (function, mean, covariance, with_bias, m, p, q, slopes, bias, noise, off)
        calls[name] = partial(_repeat_update, *arguments)
        calls[name]()
        kernel()
        assert np.allclose(found, np.concatenate([m, p.ravel(), q.ravel()]), atol=1e-9), name
    return "joint update by four readings", kernel, calls


@njit
def _repeat_update(function, mean, covariance, with_bias, m, p, q, slopes, bias, noise, off):
    for _ in range(REPEATS):
        m[:], p[:], q[:] = mean, covariance, with_bias
        function(m, p, q, slopes, bias, noise, off)


def _joint_events() -> Case:
    """Six tracks within 15 px and eight peaks."""
    rng = np.random.default_rng(3)
    settings = TrackerSettings()
    n, m, most = 6, 8, settings.max_hypotheses
    at, va = np.sort(rng.uniform(0.0, 15.0, n)), rng.uniform(0.05, 0.5, n)
    z, vz = rng.uniform(0.0, 15.0, m), np.full(m, 0.003)
    z[:n] = at + 0.3 * rng.normal(size=n)
    job = np.zeros(1, JOB)
    for name in ("detection_probability", "clutter_density_per_px", "resolution_px", "gate_sigma"):
        job[name] = getattr(settings, name)
    room = max(64 * most, MAX_OPTIONS + 1)
    partials, order = np.empty((most + room) * PARTIAL_BYTES, np.uint8), np.empty(room, np.int32)
    found = np.zeros((2, n, m))
    job["max_hypotheses"], job["max_grown"] = most, room
    job["partials"], job["order"] = _address(partials), _address(order)
    job["mean"], job["covariance"] = _address(at), _address(va)
    job["position"], job["noise"], job["evidence"] = _address(z), _address(vz), _address(found)
    kernel = _launch(
        "compute/tracking/native/association.h",
        "lumiline::tracking::AssociationJob& job = *(lumiline::tracking::AssociationJob*)address;"
        "lumiline::tracking::JointEvents events(job);"
        f"double *own = job.evidence, *shared = own + {n * m}, pruned_weight = 0.0;"
        "const int options = events.evaluate("
        f"{n}, job.mean, job.covariance, {m}, job.position, job.noise, pruned_weight);"
        f"for (int i = 0; i < {2 * n * m}; ++i) own[i] = 0.0;"
        "for (int o = 0; o < options; ++o) {"
        "    const lumiline::tracking::Option& way = events.options[o];"
        "    const double probability = events.option_probability[o];"
        f"    double* to = (way.two < 0 ? own : shared) + way.one * {m} + way.peak;"
        "    *to += probability;"
        f"    if (way.two >= 0) shared[way.two * {m} + way.peak] += probability;"
        "}",
        job,
        *(at, va, z, vz, partials, order, found),
    )

    own, shared = np.zeros((n, m)), np.zeros((n, m))
    given = (
        settings.detection_probability,
        settings.detection_probability / settings.clutter_density_per_px,
        settings.resolution_px,
        settings.gate_sigma**2,
    )
    call = partial(_repeat_events, at, va, z, vz, given, most, own, shared)
    call()
    kernel()
    assert np.allclose(found, np.stack([own, shared]), atol=1e-9)
    return "joint events of six tracks", kernel, {"loops": call}


@njit
def _repeat_events(at, va, z, vz, settings, most, own, shared):
    for _ in range(REPEATS):
        peers.joint_events(at, va, z, vz, settings, most, own, shared)


if __name__ == "__main__":
    main()
