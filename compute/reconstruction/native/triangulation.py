"""Native source of the whole kernel: one point from its readings, as ``reconstruct`` makes it."""

from typing import Final

from compute.reconstruction.native.algebra import ALGEBRA
from compute.reconstruction.native.correction_table import TABLE
from compute.reconstruction.native.kernel_arguments import JOB_SOURCE
from compute.reconstruction.native.projection import CAMERAS

_READINGS: Final = """
    const double* readings = job.readings + (long long)number * S;
    const double* sigmas = job.sigma + (long long)number * S;
    double reading[R], target[R], sigma[R], slope[R], variance[R], live[R];
    bool used[R];
    int count = 0;
    double best[3] = {infinity, infinity, infinity};
    for (int s = 0; s < S; ++s) {
        reading[s] = readings[s];
        const double apart = reading[s] - principal_point[s];
        target[s] = reading[s] + cubic[s] * apart * apart * apart;
        slope[s] = 1.0 + 3.0 * cubic[s] * apart * apart;
        sigma[s] = sigmas[s] * (slope[s] < 0.0 ? -slope[s] : slope[s]);
        used[s] = finite(target[s]) && finite(sigma[s]) && sigma[s] > 0.0;
        if (!used[s]) continue;
        double other = sigma[s];
        for (int i = 0; i < 3; ++i) {
            const double less = smaller(best[i], other);
            other = larger(best[i], other);
            best[i] = less;
        }
    }
    for (int s = S; s < R; ++s) {
        reading[s] = target[s] = slope[s] = live[s] = 0.0;
        sigma[s] = 1.0;
        used[s] = false;
    }
    for (int s = 0; s < S; ++s) {
        used[s] = used[s] && (S < 4 || sigma[s] <= uninformative * best[2]);
        if (!used[s]) sigma[s] = 1.0;
        live[s] = used[s] ? 1.0 : 0.0;
        count += used[s];
        job.used[(long long)number * S + s] = used[s];
    }
    auto give_up = [&](int why) {
        for (int i = 0; i < 3; ++i) job.position[(long long)number * 3 + i] = nan;
        for (int i = 0; i < 9; ++i) job.covariance[(long long)number * 9 + i] = nan;
        job.chi2[number] = nan;
        job.flags[number] = why;
    };
    if (count < 3) {
        give_up(too_few_sensors);
        return;
    }
"""

# The planes' equations without weights. By the normal equations where those are sure; else by
# Givens rotations to a triangle, which does not square the condition number.
_START: Final = """
    double x[3];
    auto plane = [&](int s, double* row) {
        const double c = principal_distance[s], apart = principal_point[s] - target[s];
        for (int axis = 0; axis < 3; ++axis) {
            const double* r = rotation + axis * R + s;
            row[axis] = c * r[0] + apart * r[6 * R];
        }
        row[3] = c * offset[s] + apart * offset[2 * R + s];
    };
    auto triangle = [&](double (&r)[3][4]) {
        for (int i = 0; i < 3; ++i) for (int j = 0; j < 4; ++j) r[i][j] = 0.0;
        for (int s = 0; s < S; ++s) {
            if (!used[s]) continue;
            double row[4];
            plane(s, row);
            for (int i = 0; i < 3; ++i) {
                const double length = sqrt(r[i][i] * r[i][i] + row[i] * row[i]);
                if (length == 0.0) continue;
                const double c = r[i][i] / length, d = row[i] / length;
                for (int j = i; j < 4; ++j) {
                    const double upper = r[i][j];
                    r[i][j] = c * upper + d * row[j];
                    row[j] = c * row[j] - d * upper;
                }
            }
        }
    };
    auto starts = [&]() -> bool {
        double a[6] = {0.0}, b[3] = {0.0}, l[3], d[3];
        for (int s = 0; s < S; ++s) {
            if (!used[s]) continue;
            double row[4];
            plane(s, row);
            for (int i = 0, n = 0; i < 3; ++i) {
                for (int j = 0; j <= i; ++j) a[n++] += row[i] * row[j];
                b[i] -= row[i] * row[3];
            }
        }
        const double trace = a[0] + a[2] + a[5];
        if (factor(a, l, d) > 1e-7 * trace * trace * trace) {
            substitute(l, d, b, x);
            return true;
        }
        double r[3][4], square[3][3];
        triangle(r);
        for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) square[i][j] = r[i][j];
        if (!(singular_ratio(square) > condition_limit)) return false;
        x[2] = -r[2][3] / r[2][2];
        x[1] = (-r[1][3] - r[1][2] * x[2]) / r[1][1];
        x[0] = (-r[0][3] - r[0][1] * x[1] - r[0][2] * x[2]) / r[0][0];
        return true;
    };
    if (!starts()) {
        give_up(degenerate);
        return;
    }
"""

# gram: A'A of the equations with their residuals, the lower triangle of 4 x 4 by rows; its last
# is chi2. The equations are whitened by the triangle ``spread`` or, where the readings are not
# correlated, its diagonal; ``inverse`` has the inverses of the diagonal.
_EQUATIONS: Final = """
#if defined(__CUDA_ARCH__)
    auto total = [](Lanes a) -> double { return a; };
#else
    auto total = [](Lanes a) -> double { return (a[0] + a[1]) + (a[2] + a[3]); };
#endif
    double spread[S][S], inverse[R];
    bool correlated = false;
    auto equations = [&](const double* at, double* gram) {
        if (!finite(at[0] + at[1] + at[2])) {
            gram[9] = nan;
            return;
        }
        Lanes p[V], rows[4][V];
        project(at, p, rows);
        if (job.degree == 0) {
            for (int v = 0; v < V; ++v) rows[3][v] = lanes(target, v) - p[v];
        } else {
            Lanes value[V], by[3][V];
            correction(at, value, by);
            for (int v = 0; v < V; ++v) {
                const Lanes q = lanes(reading, v) + value[v];
                const Lanes apart = q - lanes(principal_point, v);
                const Lanes bend = lanes(cubic, v) * apart * apart;
                const Lanes by_reading = 1.0 + 3.0 * bend;
                for (int axis = 0; axis < 3; ++axis) rows[axis][v] -= by_reading * by[axis][v];
                rows[3][v] = q + bend * apart - p[v];
            }
        }
        for (int column = 0; column < 4; ++column)
            for (int v = 0; v < V; ++v)
                rows[column][v] = lanes(live, v) > 0.0 ? rows[column][v] : Lanes{};
        if (correlated) {
            for (int column = 0; column < 4; ++column) {
                double row[R];
                for (int v = 0; v < V; ++v) ((Lanes*)row)[v] = rows[column][v];
                for (int s = 0; s < S; ++s) {
                    double rest = row[s];
                    for (int t = 0; t < s; ++t) rest -= spread[s][t] * row[t];
                    row[s] = rest * inverse[s];
                }
                for (int v = 0; v < V; ++v) rows[column][v] = lanes(row, v);
            }
        } else {
            for (int column = 0; column < 4; ++column)
                for (int v = 0; v < V; ++v) rows[column][v] *= lanes(inverse, v);
        }
        for (int i = 0, n = 0; i < 4; ++i)
            for (int j = 0; j <= i; ++j, ++n) {
                Lanes sum = Lanes{};
                for (int v = 0; v < V; ++v) sum += rows[i][v] * rows[j][v];
                gram[n] = total(sum);
            }
    };
    // Levenberg-Marquardt from x, of so many iterations at most.
    double gram[10];
    auto refine = [&](int most) -> bool {
        double damping = first_damping;
        equations(x, gram);
        if (!finite(gram[9])) return false;
        for (int turn = 0; turn < most; ++turn) {
            const double top = larger(gram[0], larger(gram[2], gram[5]));
            const double floor = 1e-300 + 1e-15 * top;
            const double stretch = 1.0 + damping;
            const double normal[6] = {
                gram[0] * stretch + floor, gram[1], gram[2] * stretch + floor,
                gram[3], gram[4], gram[5] * stretch + floor};
            double l[3], d[3], step[3], trial[3], there[10];
            factor(normal, l, d);
            substitute(l, d, gram + 6, step);
            for (int i = 0; i < 3; ++i) trial[i] = x[i] + step[i];
            equations(trial, there);
            bool small = true;
            for (int i = 0; i < 3; ++i) small = small && step[i] <= settled && -step[i] <= settled;
            const bool better = there[9] <= rounding * gram[9] || (small && finite(there[9]));
            if (better) {
                for (int i = 0; i < 3; ++i) x[i] = trial[i];
                for (int i = 0; i < 10; ++i) gram[i] = there[i];
            }
            damping *= better ? 0.1 : 10.0;
            if (small) return true;
            if (!(damping < max_damping)) return false;
        }
        return false;
    };
"""

_POINT: Final = """
    for (int s = 0; s < R; ++s) inverse[s] = 1.0 / sigma[s];
    if (ROOM > 0 || job.degree != 0) refine(first_steps);
    for (int s = 0; s < R; ++s) variance[s] = sigma[s] * sigma[s];
    if (job.degree != 0) add_table(x, used, slope, variance);
    correlated = job.parameters != 0;
    if (correlated) {
        for (int s = 0; s < S; ++s) for (int t = 0; t < S; ++t) spread[s][t] = 0.0;
        add_parameters(x, used, spread);
        // Cholesky, in place.
        for (int s = 0; s < S; ++s) {
            for (int t = 0; t < s; ++t) {
                double rest = spread[s][t];
                for (int k = 0; k < t; ++k) rest -= spread[s][k] * spread[t][k];
                spread[s][t] = rest * inverse[t];
            }
            double rest = spread[s][s] + variance[s];
            for (int k = 0; k < s; ++k) rest -= spread[s][k] * spread[s][k];
            inverse[s] = 1.0 / sqrt(rest);
        }
    } else {
        for (int s = 0; s < R; ++s) inverse[s] = 1.0 / sqrt(variance[s]);
    }
    if (!refine(max_iterations) || (count == 3 && !(gram[9] <= met_chi2))) {
        give_up(no_convergence);
        return;
    }
    double l[3], d[3];
    const double trace = gram[0] + gram[2] + gram[5];
    if (!(factor(gram, l, d) > 1e-10 * trace * trace * trace)) {
        double square[3][3] = {
            {gram[0], gram[1], gram[3]}, {gram[1], gram[2], gram[4]}, {gram[3], gram[4], gram[5]}};
        if (!(singular_ratio(square) > degenerate_ratio)) {
            give_up(degenerate);
            return;
        }
    }
    for (int i = 0; i < 3; ++i) {
        const double unit[3] = {i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0, i == 2 ? 1.0 : 0.0};
        double column[3];
        substitute(l, d, unit, column);
        for (int j = 0; j < 3; ++j) job.covariance[(long long)number * 9 + 3 * j + i] = column[j];
        job.position[(long long)number * 3 + i] = x[i];
    }
    int flags = count == 3 ? no_redundancy : 0;
    if (gram[9] > job.limits[count]) flags |= inconsistent;
    if (job.degree != 0 && !vouched(x, used)) flags |= outside_map;
    job.chi2[number] = gram[9];
    job.flags[number] = flags;
"""


def point_source(sensors: int, capacity: int) -> str:
    """Return the source for so many sensors, with room for so many terms of distortion."""
    return (
        f"    const int S = {sensors}, ROOM = {capacity};\n"
        + JOB_SOURCE
        + ALGEBRA
        + CAMERAS
        + TABLE
        + _READINGS
        + _START
        + _EQUATIONS
        + _POINT
    )
