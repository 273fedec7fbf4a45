// Predicted readings of tracks, and the filter's joint and probabilistic updates.
#pragma once

#include "compute/native/platform.h"
#include "compute/reconstruction/native/cameras.h"
#include "compute/reconstruction/native/correction_table.h"
#include "compute/reconstruction/native/cubic_distortion.h"
#include "compute/reconstruction/native/lanes.h"
#include "compute/tracking/native/definitions.gen.h"
#include "compute/tracking/native/joint_events.h"

namespace lumiline::tracking {

// Cholesky in place of the lower triangle (n rows of S); returns the log of the determinant.
template <int S>
LUMILINE_NOINLINE double cholesky(double* a, int n) {
    double product = 0.0;
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j <= i; ++j) {
            double rest = a[i * S + j];
            for (int k = 0; k < j; ++k) rest -= a[i * S + k] * a[j * S + k];
            a[i * S + j] = i == j ? sqrt(rest) : rest / a[j * S + j];
        }
        product += 2.0 * log(a[i * S + i]);
    }
    return product;
}

// T tracks of M modes each, and what S sensors are expected to read of them.
template <int S, int TERMS>
struct TrackStates {
    static constexpr int V = vector_count<S>;

    AssociationJob& job;
    const Cameras<S, TERMS> cameras;
    const CorrectionTable<S> table;
    const int T, M, K;
    // Of each track: the mixture's position (3), its covariance (9), that with the biases (3 S);
    // where it was linearised (3), readings (S) and their Jacobian (3 S) there; expected readings
    // and their variances.
    static constexpr int stride = 15 + 9 * S;
    // Marks (T, S): in view of a sensor; not decided; and of the peaks (S, K): assigned.
    unsigned char *const visible, *const contested, *const assigned;

    LUMILINE_FN explicit TrackStates(AssociationJob& from)
        : job(from),
          cameras(from.cameras),
          table(from.cameras),
          T((int)from.tracks),
          M((int)from.models),
          K((int)from.room),
          visible(from.marks),
          contested(from.marks + T * S),
          assigned(from.marks + 2 * T * S) {}

    LUMILINE_FN double* position_of(int t) { return job.numbers + (long long)t * stride; }

    LUMILINE_FN double* position_covariance_of(int t) { return position_of(t) + 3; }

    LUMILINE_FN double* position_bias_of(int t) { return position_of(t) + 12; }

    LUMILINE_FN double* expansion_point_of(int t) { return position_of(t) + 12 + 3 * S; }

    LUMILINE_FN double* expanded_reading_of(int t) { return position_of(t) + 15 + 3 * S; }

    LUMILINE_FN double* jacobian_of(int t) { return position_of(t) + 15 + 4 * S; }

    LUMILINE_FN double* expected_of(int t) { return position_of(t) + 15 + 7 * S; }

    LUMILINE_FN double* expected_variance_of(int t) { return position_of(t) + 15 + 8 * S; }

    LUMILINE_FN double* mean_of(int t, int k) { return job.mean + (t * M + k) * 9; }

    LUMILINE_FN double* covariance_of(int t, int k) { return job.covariance + (t * M + k) * 81; }

    LUMILINE_FN double* with_bias_of(int t, int k) { return job.with_bias + (t * M + k) * 9 * S; }

    LUMILINE_FN const double* bias_of(int t) { return job.bias + t * S * S; }

    // The position of a track's mixture of modes, its covariance, and that with the biases.
    LUMILINE_NOINLINE void mix_modes(int t) {
        double *w = position_of(t), *c = position_covariance_of(t), *b = position_bias_of(t);
        for (int i = 0; i < 12 + 3 * S; ++i) w[i] = 0.0;
        for (int k = 0; k < M; ++k)
            for (int i = 0; i < 3; ++i) w[i] += job.mode_probability[t * M + k] * mean_of(t, k)[i];
        for (int k = 0; k < M; ++k) {
            const double probability = job.mode_probability[t * M + k];
            const double *m = mean_of(t, k), *p = covariance_of(t, k), *q = with_bias_of(t, k);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    c[3 * i + j] += probability * (p[9 * i + j] + (m[i] - w[i]) * (m[j] - w[j]));
            for (int i = 0; i < 3 * S; ++i) b[i] += probability * q[i];
        }
    }

    // Readings and their Jacobian at a track's expansion point.
    LUMILINE_NOINLINE void predict(int t) {
        const double* x = expansion_point_of(t);
        Lanes p[V], g[3][V], value[V], by[3][V];
        cameras.project(x, p, g);
        if (table.exists()) table.correction(x, value, by);
        for (int s = 0; s < S; ++s) {
            const int v = s / cpu_lanes, lane = s % cpu_lanes;
            double r = p[v][lane], scale = 1.0;
            if (cameras.cubic[s] != 0.0)
                r = invert_cubic(r, cameras.principal_point[s], cameras.cubic[s], scale);
            for (int i = 0; i < 3; ++i) jacobian_of(t)[3 * s + i] = scale * g[i][v][lane];
            if (table.exists()) {
                r -= value[v][lane];
                for (int i = 0; i < 3; ++i) jacobian_of(t)[3 * s + i] -= by[i][v][lane];
            }
            expanded_reading_of(t)[s] = r;
            visible[t * S + s] = r >= job.first[s] && r <= job.last[s];
        }
    }

    // A sensor's expected reading of a track, and its variance.
    LUMILINE_NOINLINE void predict_measurement(int t, int s) {
        const double *g = jacobian_of(t) + 3 * s, *c = position_covariance_of(t),
                     *b = position_bias_of(t);
        double at = expanded_reading_of(t)[s], v = bias_of(t)[s * S + s];
        for (int i = 0; i < 3; ++i) {
            at += g[i] * (position_of(t)[i] - expansion_point_of(t)[i]);
            v += 2.0 * g[i] * b[i * S + s];
            for (int j = 0; j < 3; ++j) v += g[i] * c[3 * i + j] * g[j];
        }
        expected_of(t)[s] = at;
        expected_variance_of(t)[s] = larger(v, 0.0);
    }

    // The covariance of n predicted and noisy readings, by a state's position (rows of 9 or 3).
    LUMILINE_NOINLINE void innovation_covariance(int t, const double* p, int row, const double* q,
                                                 const int* used, int n, const double* noise,
                                                 double* total) {
        for (int a = 0; a < n; ++a)
            for (int b = 0; b <= a; ++b) {
                const int s = used[a], r = used[b];
                const double *g = jacobian_of(t) + 3 * s, *h = jacobian_of(t) + 3 * r;
                double sum = bias_of(t)[s * S + r] + (a == b ? noise[a] : 0.0);
                for (int i = 0; i < 3; ++i) {
                    sum += g[i] * q[i * S + r] + h[i] * q[i * S + s];
                    for (int j = 0; j < 3; ++j) sum += g[i] * p[row * i + j] * h[j];
                }
                total[a * S + b] = sum;
            }
    }

    // Residuals of readings from the prediction by all others, in standard deviations.
    LUMILINE_NOINLINE void leave_one_out_residuals(int t, const int* used, int n,
                                                   const double* noise, const double* off,
                                                   double* result) {
        double a[S * S], inverse[S * S];
        innovation_covariance(t, position_covariance_of(t), 3, position_bias_of(t), used, n, noise,
                              a);
        cholesky<S>(a, n);
        for (int c = 0; c < n; ++c)
            for (int i = c; i < n; ++i) {
                double rest = i == c ? 1.0 : 0.0;
                for (int k = c; k < i; ++k) rest -= a[i * S + k] * inverse[k * S + c];
                inverse[i * S + c] = rest / a[i * S + i];
            }
        double half[S];
        for (int i = 0; i < n; ++i) {
            half[i] = 0.0;
            for (int k = 0; k <= i; ++k) half[i] += inverse[i * S + k] * off[k];
        }
        for (int i = 0; i < n; ++i) {
            double weighted = 0.0, squares = 0.0;
            for (int k = i; k < n; ++k) {
                weighted += inverse[k * S + i] * half[k];
                squares += inverse[k * S + i] * inverse[k * S + i];
            }
            result[i] = weighted / sqrt(squares);
        }
    }

    // One model's state after n readings; returns the log likelihood, and the squared innovation.
    LUMILINE_NOINLINE double joint_update(double* mean, double* p, double* q, int t,
                                          const int* used, int n, const double* noise,
                                          const double* off, double& squared) {
        double a[S * S], across[S * 9], half[S];
        innovation_covariance(t, p, 9, q, used, n, noise, a);
        const double product = cholesky<S>(a, n);
        // L^-1 of the innovations and of the covariance of readings with the state, row by row.
        double towards[S * S];
        squared = 0.0;
        for (int c = 0; c < n; ++c) {
            const double* g = jacobian_of(t) + 3 * used[c];
            for (int i = 0; i < 9; ++i)
                across[9 * c + i] = g[0] * p[9 * i] + g[1] * p[9 * i + 1] + g[2] * p[9 * i + 2]
                                    + q[i * S + used[c]];
            for (int r = 0; r < S; ++r)
                towards[c * S + r] = g[0] * q[r] + g[1] * q[S + r] + g[2] * q[2 * S + r]
                                     + bias_of(t)[used[c] * S + r];
            half[c] = off[c];
            for (int k = 0; k < c; ++k) {
                const double l = a[c * S + k];
                half[c] -= l * half[k];
                for (int i = 0; i < 9; ++i) across[9 * c + i] -= l * across[9 * k + i];
                for (int r = 0; r < S; ++r) towards[c * S + r] -= l * towards[k * S + r];
            }
            const double one = 1.0 / a[c * S + c];
            half[c] *= one;
            for (int i = 0; i < 9; ++i) across[9 * c + i] *= one;
            for (int r = 0; r < S; ++r) towards[c * S + r] *= one;
            squared += half[c] * half[c];
        }
        for (int c = 0; c < n; ++c) {
            const double* u = across + 9 * c;
            for (int i = 0; i < 9; ++i) {
                mean[i] += u[i] * half[c];
                for (int j = 0; j < 9; ++j) p[9 * i + j] -= u[i] * u[j];
                for (int r = 0; r < S; ++r) q[i * S + r] -= u[i] * towards[c * S + r];
            }
        }
        return -0.5 * (squared + product + n * log(two_pi));
    }

    // A track's states after one sensor's reading, which is one of ``count`` or none.
    LUMILINE_NOINLINE void pda_update(int t, int s, int count, const double* weight,
                                      const double* difference, const double* noise) {
        const double* g = jacobian_of(t) + 3 * s;
        double nothing = 1.0, sums[8], total_probability = 0.0;
        for (int c = 0; c < count; ++c) nothing -= weight[c];
        nothing = larger(nothing, 0.0);
        for (int k = 0; k < M; ++k) {
            double *p = covariance_of(t, k), *q = with_bias_of(t, k), *m = mean_of(t, k);
            double across[9], towards[S], predicted_variance = bias_of(t)[s * S + s], apart = 0.0;
            for (int i = 0; i < 9; ++i)
                across[i] =
                    p[9 * i] * g[0] + p[9 * i + 1] * g[1] + p[9 * i + 2] * g[2] + q[i * S + s];
            for (int i = 0; i < 3; ++i) {
                predicted_variance += (across[i] + q[i * S + s]) * g[i];
                apart += (m[i] - position_of(t)[i]) * g[i];
            }
            for (int r = 0; r < S; ++r)
                towards[r] =
                    g[0] * q[r] + g[1] * q[S + r] + g[2] * q[2 * S + r] + bias_of(t)[s * S + r];
            double sum = nothing, shift = 0.0, information = 0.0, covariance_of_means = 0.0;
            for (int iteration = 0; iteration < 2; ++iteration)
                for (int c = 0; c < count; ++c) {
                    const double v = predicted_variance + noise[c],
                                 w = expected_variance_of(t)[s] + noise[c];
                    const double d = difference[c] - apart, e = difference[c];
                    const double gap = -0.5 * (d * d / v + log(v)) + 0.5 * (e * e / w + log(w));
                    const double likely = weight[c] * exp(smaller(gap, 50.0));
                    if (iteration == 0) {
                        sum += likely;
                        continue;
                    }
                    const double probability = likely / larger(sum, 1e-300), by = d / v;
                    shift += probability * by;
                    information += probability / v;
                    covariance_of_means += probability * by * by;
                }
            covariance_of_means -= shift * shift;
            for (int i = 0; i < 9; ++i) {
                m[i] += shift * across[i];
                const double by = (information - covariance_of_means) * across[i];
                for (int j = 0; j < 9; ++j) p[9 * i + j] -= by * across[j];
                for (int r = 0; r < S; ++r) q[i * S + r] -= information * across[i] * towards[r];
            }
            sums[k] = job.mode_probability[t * M + k] * larger(sum, 1e-12);
            total_probability += sums[k];
        }
        for (int k = 0; k < M; ++k) job.mode_probability[t * M + k] = sums[k] / total_probability;
    }
};

}  // namespace lumiline::tracking
