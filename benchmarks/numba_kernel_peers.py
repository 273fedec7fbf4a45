"""Numba versions of pose and track kernels, for ``benchmarks.numba_kernels``."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from typing import Final

import numpy as np
from numba import njit as compile_loops

from compute.pose.filtering.imm import IMM_STATES
from compute.pose.filtering.native.definitions import POSE
from compute.tracking.joint_events import (
    MIN_MERGE_PROBABILITY,
    NEGLIGIBLE_WEIGHT_RATIO,
    SHARE_FRACTION_VARIANCE,
)
from compute.tracking.native.definitions import MAX_OPTIONS

ERRORS: Final = 28
STEP_S: Final = 0.005
LOG_2: Final = 0.6931471805599453
TWO_PI: Final = 6.283185307179586

njit = compile_loops(error_model="numpy")


@njit
def rotation_matrix(w):
    """Return the rotation of a rotation vector."""
    x, y, z = w[0], w[1], w[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-4:
        first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        half = np.sin(0.5 * angle) / angle
        first, second = np.sin(angle) / angle, 2.0 * half * half
    diagonal = 1.0 - second * square
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    found = np.empty((3, 3))
    found[0, :] = diagonal + second * x * x, xy - first * z, xz + first * y
    found[1, :] = xy + first * z, diagonal + second * y * y, yz - first * x
    found[2, :] = xz - first * y, yz + first * x, diagonal + second * z * z
    return found


@njit
def predict_by_arrays(before, after, switching, states, begun, brief, terms, scratch):  # noqa: ARG001
    """As the IMM prediction, with products of stacks written mode by mode."""
    h, count, wide = STEP_S, len(brief), IMM_STATES + ERRORS
    probability = before[POSE : POSE + count]
    first = POSE + count
    off_before = before[first : first + count * IMM_STATES].reshape(count, IMM_STATES)
    spread_before = before[first + count * IMM_STATES :].reshape(count, IMM_STATES * wide)
    joint = probability.reshape(-1, 1) * switching
    summed = joint.sum(axis=0)
    came_from = np.ascontiguousarray((joint / summed).T)
    off = came_from @ off_before
    spread = (came_from @ spread_before).reshape(count, IMM_STATES, wide)
    for j in range(count):
        about = off_before - off[j]
        weighted = came_from[j].reshape(-1, 1) * about
        spread[j, :, :IMM_STATES] += np.ascontiguousarray(weighted.T) @ about
    off *= states
    renewal = came_from @ brief
    for j in range(count):
        spread[j] *= states[j].reshape(-1, 1)
        spread[j, :, :IMM_STATES] *= states[j]
        spread[j, :, :IMM_STATES] += renewal[j] * begun[j]
    last = off[-1].copy()
    rotation = rotation_matrix(last[:3]) @ np.ascontiguousarray(before[:9]).reshape(3, 3)
    rest = before[9:POSE] + last[3:12]
    turned = rotation_matrix(h * rest[6:9])
    slopes = np.eye(IMM_STATES)
    slopes[:3, :3] = turned
    for i in range(3):
        slopes[i, 9 + i] = slopes[3 + i, 6 + i] = slopes[6 + i, 12 + i] = slopes[9 + i, 15 + i] = h
        slopes[i, 15 + i] = slopes[3 + i, 12 + i] = 0.5 * h * h
    across = np.ascontiguousarray(slopes.T)
    powers = np.array([h, h**2, h**3, h**4, h**5])
    noise = (powers @ terms).reshape(count, IMM_STATES, IMM_STATES)
    after[:9] = (turned @ rotation).ravel()
    after[9:POSE] = rest
    after[9:12] += h * rest[3:6]
    after[POSE : POSE + count] = summed
    after[first : first + count * IMM_STATES] = ((off - last) @ across).ravel()
    for j in range(count):
        whole = slopes @ spread[j]
        half = 0.5 * (np.ascontiguousarray(whole[:, :IMM_STATES]) @ across + noise[j])
        whole[:, :IMM_STATES] = half + half.T
        start = first + count * IMM_STATES + j * IMM_STATES * wide
        after[start : start + IMM_STATES * wide] = whole.ravel()


@njit
def predict_by_loops(before, after, switching, states, begun, brief, terms, scratch):
    """As the kernel: the same loops."""
    h, count, wide = STEP_S, len(brief), IMM_STATES + ERRORS
    first = POSE + count
    off = before[first : first + count * IMM_STATES].reshape(count, IMM_STATES)
    spread = before[first + count * IMM_STATES :].reshape(count, IMM_STATES, wide)
    off_to = after[first : first + count * IMM_STATES].reshape(count, IMM_STATES)
    spread_to = after[first + count * IMM_STATES :].reshape(count, IMM_STATES, wide)
    came = scratch[: count * count].reshape(count, count)
    square = scratch[count * count : count * count + IMM_STATES * IMM_STATES].reshape(
        IMM_STATES, IMM_STATES
    )
    about = np.empty(IMM_STATES)
    for j in range(count):
        summed = 0.0
        for i in range(count):
            came[j, i] = before[POSE + i] * switching[i, j]
            summed += came[j, i]
        for i in range(count):
            came[j, i] /= summed
        after[POSE + j] = summed
    for j in range(count):
        own, at, renewal = spread_to[j], off_to[j], 0.0
        for r in range(IMM_STATES):
            at[r] = 0.0
            for c in range(wide):
                own[r, c] = 0.0
        for i in range(count):
            share = came[j, i]
            for r in range(IMM_STATES):
                at[r] += share * off[i, r]
                for c in range(wide):
                    own[r, c] += share * spread[i, r, c]
            renewal += share * brief[i]
        for i in range(count):
            for r in range(IMM_STATES):
                about[r] = off[i, r] - at[r]
            for r in range(IMM_STATES):
                share = came[j, i] * about[r]
                for c in range(IMM_STATES):
                    own[r, c] += share * about[c]
        for r in range(IMM_STATES):
            at[r] *= states[j, r]
            for c in range(IMM_STATES):
                own[r, c] = own[r, c] * (states[j, r] * states[j, c]) + renewal * begun[j, r, c]
            for c in range(IMM_STATES, wide):
                own[r, c] *= states[j, r]
    last = off_to[count - 1].copy()
    rotation = rotation_matrix(last[:3]) @ np.ascontiguousarray(before[:9]).reshape(3, 3)
    for i in range(9):
        after[9 + i] = before[9 + i] + last[3 + i]
    turned = rotation_matrix(h * after[15:18])
    after[:9] = (turned @ rotation).ravel()
    for i in range(3):
        after[9 + i] += h * after[12 + i]
    for j in range(count):
        own, at = spread_to[j], off_to[j].reshape(IMM_STATES, 1)
        for r in range(IMM_STATES):
            at[r, 0] -= last[r]
        propagate(h, turned, at)
        propagate(h, turned, own)
        for r in range(IMM_STATES):
            for c in range(IMM_STATES):
                square[c, r] = own[r, c]
        propagate(h, turned, square)
        power = 1.0
        for term in range(5):
            power *= h
            row = terms[term, j * IMM_STATES * IMM_STATES : (j + 1) * IMM_STATES * IMM_STATES]
            for r in range(IMM_STATES):
                for c in range(IMM_STATES):
                    square[r, c] += power * row[r * IMM_STATES + c]
        for r in range(IMM_STATES):
            for c in range(r + 1):
                own[r, c] = own[c, r] = 0.5 * square[r, c] + 0.5 * square[c, r]


@njit
def propagate(h, turned, x):
    """Propagate states, one per column."""
    columns, half = x.shape[1], 0.5 * h * h
    for c in range(columns):
        a, b, d = x[0, c], x[1, c], x[2, c]
        for i in range(3):
            x[i, c] = turned[i, 0] * a + turned[i, 1] * b + turned[i, 2] * d
    for to, start, factor in (
        (0, 9, h),
        (0, 15, half),
        (3, 6, h),
        (3, 12, half),
        (6, 12, h),
        (9, 15, h),
    ):
        for i in range(3):
            for c in range(columns):
                x[to + i, c] += factor * x[start + i, c]


@njit
def update_by_arrays(m, p, q, slopes, bias, noise, off):
    """As filtering.joint_update, of one track and model."""
    across = slopes @ np.ascontiguousarray(p[:3]) + q.T
    total = (
        np.ascontiguousarray(across[:, :3]) @ slopes.T
        + slopes @ np.ascontiguousarray(q[:3])
        + bias
        + np.diag(noise)
    )
    towards = slopes @ np.ascontiguousarray(q[:3]) + bias
    root = np.linalg.cholesky(total)
    solved = np.linalg.solve(root, across)
    half = np.linalg.solve(root, off)
    turned = np.ascontiguousarray(solved.T)
    m += turned @ half
    p -= turned @ solved
    q -= turned @ np.linalg.solve(root, towards)
    return -0.5 * ((half**2).sum() + 2.0 * np.log(np.diag(root)).sum())


@njit
def update_by_loops(m, p, q, slopes, bias, noise, off):
    """As the kernel: the same loops."""
    n = len(noise)
    a = np.empty((n, n))
    across, towards, half = np.empty((n, 9)), np.empty((n, n)), np.empty(n)
    for s in range(n):
        for r in range(s + 1):
            total = bias[s, r] + (noise[s] if s == r else 0.0)
            for i in range(3):
                total += slopes[s, i] * q[i, r] + slopes[r, i] * q[i, s]
                for j in range(3):
                    total += slopes[s, i] * p[i, j] * slopes[r, j]
            a[s, r] = total
    product = 0.0
    for i in range(n):
        for j in range(i + 1):
            rest = a[i, j]
            for k in range(j):
                rest -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(rest) if i == j else rest / a[j, j]
        product += 2.0 * np.log(a[i, i])
    squared = 0.0
    for c in range(n):
        g = slopes[c]
        for i in range(9):
            across[c, i] = g[0] * p[i, 0] + g[1] * p[i, 1] + g[2] * p[i, 2] + q[i, c]
        for r in range(n):
            towards[c, r] = g[0] * q[0, r] + g[1] * q[1, r] + g[2] * q[2, r] + bias[c, r]
        half[c] = off[c]
        for k in range(c):
            half[c] -= a[c, k] * half[k]
            for i in range(9):
                across[c, i] -= a[c, k] * across[k, i]
            for r in range(n):
                towards[c, r] -= a[c, k] * towards[k, r]
        one = 1.0 / a[c, c]
        half[c] *= one
        for i in range(9):
            across[c, i] *= one
        for r in range(n):
            towards[c, r] *= one
        squared += half[c] * half[c]
    for c in range(n):
        for i in range(9):
            m[i] += across[c, i] * half[c]
            for j in range(9):
                p[i, j] -= across[c, i] * across[c, j]
            for r in range(n):
                q[i, r] -= across[c, i] * towards[c, r]
    return -0.5 * (squared + product)


@njit
def _copy(state, start, other, to, n):
    """Copy one partial event over another."""
    weight, taken, read, merged, which = state
    weight_to, taken_to, read_to, merged_to, which_to = other
    weight_to[to], taken_to[to], read_to[to] = weight[start], taken[start], read[start]
    merged_to[to] = merged[start]
    for i in range(n):
        which_to[to, i] = which[start, i]


@njit
def _empty(room, n):
    return (
        np.empty(room),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty(room, np.int64),
        np.empty((room, n), np.int16),
    )


@njit
def joint_events(at, va, z, vz, settings, most, own, shared):
    """Probabilities of the peaks of each track, its own (n, m) and shared; as the kernel."""
    detection, gain, merge, gate = settings
    n, m, missed = len(at), len(z), 1.0 - detection
    pair = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1, n):
            widened = 1.0 + 2.0 * LOG_2 * (va[i] + va[j]) / (merge * merge)
            apart = at[i] - at[j]
            pair[i, j] = np.exp(-LOG_2 * apart * apart / (merge * merge * widened))
            pair[i, j] /= np.sqrt(widened)
    option = np.empty((MAX_OPTIONS, 3), np.int64)
    weights = np.empty(MAX_OPTIONS)
    first, factor, count = np.empty(n + 1, np.int64), np.empty(n), 0
    for i in range(n):
        first[i], total_weight = count, missed
        for k in range(m):
            total = va[i] + vz[k]
            off = (z[k] - at[i]) ** 2 / total
            if off <= gate:
                option[count, 0], option[count, 1], option[count, 2] = i, -1, k
                weights[count] = gain * np.exp(-0.5 * off) / np.sqrt(TWO_PI * total)
                total_weight += weights[count]
                count += 1
            for j in range(i + 1, n):
                if pair[i, j] < MIN_MERGE_PROBABILITY:
                    continue
                apart = at[i] - at[j]
                share = SHARE_FRACTION_VARIANCE * (apart * apart + va[i] + va[j])
                both = 0.25 * (va[i] + va[j]) + (vz[k] + share)
                off = (z[k] - 0.5 * (at[i] + at[j])) ** 2 / both
                if off <= gate:
                    option[count, 0], option[count, 1], option[count, 2] = i, j, k
                    density = np.exp(-0.5 * off) / np.sqrt(TWO_PI * both)
                    weights[count] = detection * gain * pair[i, j] * density
                    total_weight += weights[count]
                    count += 1
        factor[i] = max(total_weight, 1.0)
    first[n] = count
    least, greedy = NEGLIGIBLE_WEIGHT_RATIO, 0
    for i in range(n):
        best, peak = -1.0, -1
        for o in range(first[i], first[i + 1]):
            if option[o, 1] < 0 and not greedy >> option[o, 2] & 1 and weights[o] > best:
                best, peak = weights[o], option[o, 2]
        if peak < 0 or best < missed:
            least *= missed
        else:
            least *= best
            greedy |= 1 << peak
    room = 65 * most
    partials, grown = _empty(room, n), _empty(room, n)
    weight, taken, read, merged, which = partials
    more_weight, more_taken, more_read, more_merged, more_which = grown
    weight[0], taken[0], read[0], merged[0], here = 1.0, 0, 0, 0, 1
    for i in range(n):
        which[0, i] = -1
    for i in range(n):
        more = 0
        for p in range(here):
            _copy(partials, p, grown, more, n)
            more += 1
            if read[p] >> i & 1:
                continue
            more_weight[more - 1] = weight[p] * missed
            for o in range(first[i], first[i + 1]):
                peak, two = option[o, 2], option[o, 1]
                if taken[p] >> peak & 1 or (two >= 0 and read[p] >> two & 1):
                    continue
                value = weight[p] * weights[o]
                if two < 0:
                    for t in range(i):
                        earlier = which[p, t]
                        if earlier >= 0 and option[earlier, 1] < 0:
                            value *= 1.0 - pair[t, i]
                _copy(partials, p, grown, more, n)
                more_weight[more] = value
                more_taken[more] |= 1 << peak
                more_read[more] |= 1 << i
                if two >= 0:
                    more_read[more] |= 1 << two
                    more_merged[more] |= 1 << peak
                more_which[more, i] = o
                more += 1
        ahead = 1.0
        for t in range(i + 1, n):
            ahead *= factor[t]
        here = 0
        for p in range(more):
            if more_weight[p] * ahead >= least:
                _copy(grown, p, partials, here, n)
                here += 1
        if here > most:
            order = np.argsort(-weight[:here], kind="mergesort")[:most]
            for p in range(here):
                _copy(partials, p, grown, p, n)
            for p in range(most):
                _copy(grown, order[p], partials, p, n)
            here = most
    single = 0
    for p in range(here):
        same = 0
        while same < single and not (
            taken[same] == taken[p] and read[same] == read[p] and merged[same] == merged[p]
        ):
            same += 1
        if same == single:
            _copy(partials, p, partials, single, n)
            single += 1
        elif weight[p] > weight[same]:
            _copy(partials, p, partials, same, n)
    total = weight[:single].sum()
    own[:], shared[:] = 0.0, 0.0
    for p in range(single):
        for i in range(n):
            o = which[p, i]
            if o < 0:
                continue
            if option[o, 1] < 0:
                own[i, option[o, 2]] += weight[p] / total
            else:
                shared[i, option[o, 2]] += weight[p] / total
                shared[option[o, 1], option[o, 2]] += weight[p] / total
