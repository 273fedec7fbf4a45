// One point from its readings: compute.reconstruction.triangulation.
#pragma once

#include "compute/native/platform.h"
#include "compute/reconstruction/native/algebra.h"
#include "compute/reconstruction/native/cameras.h"
#include "compute/reconstruction/native/correction_table.h"
#include "compute/reconstruction/native/definitions.gen.h"
#include "compute/reconstruction/native/lanes.h"

namespace lumiline {

template <int S, int TERMS>
struct Triangulation {
    static constexpr int V = vector_count<S>, R = row_length<S>;

    const PointJob& job;
    const int number;
    const Cameras<S, TERMS> cameras;
    const CorrectionTable<S> table;
    // The readings; what they are as projected, with the cubic distortion, its derivative and
    // sigma.
    double reading[R], target[R], sigma[R], derivative[R], variance[R], live[R];
    bool used[R];
    int count = 0;
    double x[3];
    // Gram matrix A'A of the equations with their residuals, the lower triangle of 4 x 4 by rows;
    // its last is chi2.
    double gram[10];
    // The equations are whitened by the triangle `covariance` or, where the readings are not
    // correlated, its diagonal; `inverse` has the inverses of the diagonal.
    double covariance[S][S], inverse[R];
    bool correlated = false;

    LUMILINE_FN Triangulation(const PointJob& from, int of)
        : job(from), number(of), cameras(from.cameras), table(from.cameras) {}

    LUMILINE_FN void set_failed(int why) {
        for (int i = 0; i < 3; ++i) job.position[(long long)number * 3 + i] = not_a_number();
        for (int i = 0; i < 9; ++i) job.covariance[(long long)number * 9 + i] = not_a_number();
        job.chi2[number] = job.external_reliability[number] = not_a_number();
        job.flags[number] = why;
    }

    // Takes the readings that can be used; their number is `count`.
    LUMILINE_FN void read() {
        const double* readings = job.readings + (long long)number * S;
        const double* sigmas = job.sigma + (long long)number * S;
        double best[3] = {infinity(), infinity(), infinity()};
        for (int s = 0; s < S; ++s) {
            reading[s] = readings[s];
            const double apart = reading[s] - cameras.principal_point[s];
            target[s] = reading[s] + cameras.cubic[s] * apart * apart * apart;
            derivative[s] = 1.0 + 3.0 * cameras.cubic[s] * apart * apart;
            sigma[s] = sigmas[s] * (derivative[s] < 0.0 ? -derivative[s] : derivative[s]);
            used[s] = is_finite(target[s]) && is_finite(sigma[s]) && sigma[s] > 0.0;
            if (!used[s]) continue;
            double other = sigma[s];
            for (int i = 0; i < 3; ++i) {
                const double less = smaller(best[i], other);
                other = larger(best[i], other);
                best[i] = less;
            }
        }
        for (int s = S; s < R; ++s) {
            reading[s] = target[s] = derivative[s] = live[s] = 0.0;
            sigma[s] = 1.0;
            used[s] = false;
        }
        for (int s = 0; s < S; ++s) {
            used[s] = used[s] && (S < 4 || sigma[s] <= max_sigma_ratio * best[2]);
            if (!used[s]) sigma[s] = 1.0;
            live[s] = used[s] ? 1.0 : 0.0;
            count += used[s];
            job.used[(long long)number * S + s] = used[s];
        }
    }

    // Row s of the planes' equations, without weights.
    LUMILINE_FN void plane(int s, double* row) {
        const double c = cameras.principal_distance[s],
                     apart = cameras.principal_point[s] - target[s];
        for (int axis = 0; axis < 3; ++axis) {
            const double* r = cameras.rotation + axis * R + s;
            row[axis] = c * r[0] + apart * r[6 * R];
        }
        row[3] = c * cameras.offset[s] + apart * cameras.offset[2 * R + s];
    }

    // Givens rotations of the equations to a triangle, which do not square the condition number.
    LUMILINE_FN void triangularise(double (&r)[3][4]) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 4; ++j) r[i][j] = 0.0;
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
    }

    // The linear solution: by the normal equations where these are well conditioned.
    LUMILINE_FN bool find_start() {
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
        if (factor_ldl(a, l, d) > 1e-7 * trace * trace * trace) {
            solve_ldl(l, d, b, x);
            return true;
        }
        double r[3][4], square[3][3];
        triangularise(r);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) square[i][j] = r[i][j];
        if (!(singular_ratio(square) > min_condition)) return false;
        x[2] = -r[2][3] / r[2][2];
        x[1] = (-r[1][3] - r[1][2] * x[2]) / r[1][1];
        x[0] = (-r[0][3] - r[0][1] * x[1] - r[0][2] * x[2]) / r[0][0];
        return true;
    }

    // Jacobian and residuals at a position, whitened.
    LUMILINE_FN void whitened_rows(const double* at, Lanes (&rows)[4][V]) {
        Lanes p[V];
        cameras.project(at, p, rows);
        if (!table.exists()) {
            for (int v = 0; v < V; ++v) rows[3][v] = lanes(target, v) - p[v];
        } else {
            Lanes value[V], by[3][V];
            table.correction(at, value, by);
            for (int v = 0; v < V; ++v) {
                const Lanes q = lanes(reading, v) + value[v];
                const Lanes apart = q - lanes(cameras.principal_point, v);
                const Lanes bend = lanes(cameras.cubic, v) * apart * apart;
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
                    for (int t = 0; t < s; ++t) rest -= covariance[s][t] * row[t];
                    row[s] = rest * inverse[s];
                }
                for (int v = 0; v < V; ++v) rows[column][v] = lanes(row, v);
            }
        } else {
            for (int column = 0; column < 4; ++column)
                for (int v = 0; v < V; ++v) rows[column][v] *= lanes(inverse, v);
        }
    }

    LUMILINE_FN void equations(const double* at, double* gram) {
        if (!is_finite(at[0] + at[1] + at[2])) {
            gram[9] = not_a_number();
            return;
        }
        Lanes rows[4][V];
        whitened_rows(at, rows);
        for (int i = 0, n = 0; i < 4; ++i)
            for (int j = 0; j <= i; ++j, ++n) {
                Lanes sum = Lanes{};
                for (int v = 0; v < V; ++v) sum += rows[i][v] * rows[j][v];
                gram[n] = sum_lanes(sum);
            }
    }

    // Levenberg-Marquardt from x; returns whether it has converged.
    LUMILINE_FN bool refine(int limit) {
        double damping = initial_damping;
        equations(x, gram);
        if (!is_finite(gram[9])) return false;
        for (int iteration = 0; iteration < limit; ++iteration) {
            const double top = larger(gram[0], larger(gram[2], gram[5]));
            const double floor = 1e-300 + 1e-15 * top;
            const double stretch = 1.0 + damping;
            const double normal[6] = {
                gram[0] * stretch + floor, gram[1], gram[2] * stretch + floor, gram[3], gram[4],
                gram[5] * stretch + floor};
            double l[3], d[3], step[3], trial[3], there[10];
            factor_ldl(normal, l, d);
            solve_ldl(l, d, gram + 6, step);
            for (int i = 0; i < 3; ++i) trial[i] = x[i] + step[i];
            equations(trial, there);
            bool small = true;
            for (int i = 0; i < 3; ++i)
                small = small && step[i] <= step_tolerance_mm && -step[i] <= step_tolerance_mm;
            const bool better =
                there[9] <= chi2_rounding * gram[9] || (small && is_finite(there[9]));
            if (better) {
                for (int i = 0; i < 3; ++i) x[i] = trial[i];
                for (int i = 0; i < 10; ++i) gram[i] = there[i];
            }
            damping *= better ? 0.1 : 10.0;
            if (small) return true;
            if (!(damping < max_damping)) return false;
        }
        return false;
    }

    // External reliability: largest shift of the point by an undetected error of one reading, for
    // its covariance C: compute.reconstruction.triangulation.external_reliability.
    LUMILINE_FN double external_reliability(const double (&C)[3][3]) {
        if (count == 3) return infinity();
        Lanes rows[4][V];
        whitened_rows(x, rows);
        // Column s of W' A, for the whitening W and whitened Jacobian A.
        double y[3][R];
        for (int i = 0; i < 3; ++i)
            for (int v = 0; v < V; ++v) ((Lanes*)y[i])[v] = rows[i][v];
        for (int s = S - 1; s >= 0; --s)
            for (int i = 0; i < 3; ++i) {
                if (correlated)
                    for (int t = s + 1; t < S; ++t) y[i][s] -= covariance[t][s] * y[i][t];
                y[i][s] *= inverse[s];
            }
        double largest = 0.0;
        for (int s = 0; s < S; ++s) {
            if (!used[s]) continue;
            // (W' W)_ss: column s of W is a forward substitution.
            double column[R], information = inverse[s] * inverse[s];
            if (correlated) {
                column[s] = inverse[s];
                for (int t = s + 1; t < S; ++t) {
                    double rest = 0.0;
                    for (int k = s; k < t; ++k) rest -= covariance[t][k] * column[k];
                    column[t] = rest * inverse[t];
                    information += column[t] * column[t];
                }
            }
            double explained = 0.0, influence = 0.0;
            for (int i = 0; i < 3; ++i) {
                const double by = C[i][0] * y[0][s] + C[i][1] * y[1][s] + C[i][2] * y[2][s];
                explained += y[i][s] * by;
                influence += by * by;
            }
            const double rest = information - explained;
            if (!(rest > min_redundancy * information)) return infinity();
            largest = larger(largest, influence / rest);
        }
        return sqrt(job.noncentralities[count] * largest);
    }

    LUMILINE_FN void solve() {
        read();
        if (count < 3) {
            set_failed(flag_too_few_sensors);
            return;
        }

        if (!find_start()) {
            set_failed(flag_degenerate);
            return;
        }

        for (int s = 0; s < R; ++s) inverse[s] = 1.0 / sigma[s];
        if (TERMS > 0 || table.exists()) refine(max_initial_iterations);
        for (int s = 0; s < R; ++s) variance[s] = sigma[s] * sigma[s];
        if (table.exists()) table.add_variance(x, used, derivative, variance);
        correlated = job.parameter_covariance != nullptr;
        if (correlated) {
            for (int s = 0; s < S; ++s)
                for (int t = 0; t < S; ++t) covariance[s][t] = 0.0;
            cameras.add_parameter_covariance(job.parameter_covariance, x, used, covariance);
            // Cholesky, in place.
            for (int s = 0; s < S; ++s) {
                for (int t = 0; t < s; ++t) {
                    double rest = covariance[s][t];
                    for (int k = 0; k < t; ++k) rest -= covariance[s][k] * covariance[t][k];
                    covariance[s][t] = rest * inverse[t];
                }
                double rest = covariance[s][s] + variance[s];
                for (int k = 0; k < s; ++k) rest -= covariance[s][k] * covariance[s][k];
                inverse[s] = 1.0 / sqrt(rest);
            }
        } else {
            for (int s = 0; s < R; ++s) inverse[s] = 1.0 / sqrt(variance[s]);
        }
        if (!refine(max_iterations) || (count == 3 && !(gram[9] <= max_exact_chi2))) {
            set_failed(flag_no_convergence);
            return;
        }
        double l[3], d[3];
        const double trace = gram[0] + gram[2] + gram[5];
        if (!(factor_ldl(gram, l, d) > 1e-10 * trace * trace * trace)) {
            double square[3][3] = {{gram[0], gram[1], gram[3]},
                                   {gram[1], gram[2], gram[4]},
                                   {gram[3], gram[4], gram[5]}};
            if (!(singular_ratio(square) > min_singular_ratio)) {
                set_failed(flag_degenerate);
                return;
            }
        }
        double C[3][3];
        for (int i = 0; i < 3; ++i) {
            const double unit[3] = {i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0, i == 2 ? 1.0 : 0.0};
            double column[3];
            solve_ldl(l, d, unit, column);
            for (int j = 0; j < 3; ++j)
                job.covariance[(long long)number * 9 + 3 * j + i] = C[j][i] = column[j];
            job.position[(long long)number * 3 + i] = x[i];
        }
        int flags = count == 3 ? flag_no_redundancy : 0;
        if (gram[9] > job.chi2_limits[count]) flags |= flag_inconsistent;
        if (table.exists() && !table.is_valid(x, used)) flags |= flag_outside_map;
        if (table.exists() && !table.in_box(x)) flags |= flag_no_covariance;
        job.chi2[number] = gram[9];
        job.external_reliability[number] = external_reliability(C);
        job.flags[number] = flags;
    }
};

// Solves point `number` of a PointJob.
template <int S, int TERMS>
LUMILINE_FN void solve_point(int number, unsigned long long job_address) {
    Triangulation<S, TERMS> triangulation(*(const PointJob*)job_address, number);
    triangulation.solve();
}

}  // namespace lumiline
