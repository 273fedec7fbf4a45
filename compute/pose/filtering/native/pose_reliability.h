// Detectable errors of the readings that a pose rests on, and what undetected ones do to it:
// compute.pose.estimation.pose_reliability.
#pragma once

#include "compute/native/platform.h"
#include "compute/pose/filtering/native/definitions.gen.h"
#include "compute/pose/filtering/native/imm_filter.h"
#include "compute/pose/filtering/native/measurement_prediction.h"
#include "compute/pose/filtering/native/pose_algebra.h"

namespace lumiline::pose {

// Replaces a symmetric matrix (n, n) by its Cholesky root. False: a pivot is not above this share
// of the diagonal.
LUMILINE_FN bool cholesky_root(int n, double* matrix, double pivot_floor) {
    for (int i = 0; i < n; ++i)
        for (int j = 0; j <= i; ++j) {
            double rest = matrix[i * n + j];
            for (int k = 0; k < j; ++k) rest -= matrix[i * n + k] * matrix[j * n + k];
            if (i == j && !(rest > pivot_floor * matrix[i * n + i])) return false;
            matrix[i * n + j] = i == j ? sqrt(rest) : rest / matrix[j * n + j];
        }
    return true;
}

template <int S, int TERMS>
struct PoseReliability {
    static constexpr int Q = pose_parameters;

    ReliabilityRecord& record;
    StepRecord& step;
    Scratch step_scratch, scratch;
    MeasurementPrediction<S, TERMS> expected;
    const int C, N;
    // Rows by (rotation times radius, centroid) and the same whitened, (n, Q); common errors,
    // (n, C); the readings' covariance, then its root, and the root's inverse, (n, n).
    double *const rows, *const design, *const common, *const root, *const whitening;
    double* const variance;
    int count = 0;

    LUMILINE_FN explicit PoseReliability(ReliabilityRecord& from)
        : record(from),
          step(*from.step),
          step_scratch{step.scratch},
          scratch{from.scratch},
          expected(step, step_scratch),
          C((int)step.calibration_errors),
          N((int)from.readings),
          rows(scratch.allocate(N * Q)),
          design(scratch.allocate(N * Q)),
          common(scratch.allocate(N * C)),
          root(scratch.allocate(N * N)),
          whitening(scratch.allocate(N * N)),
          variance(scratch.allocate(N)) {}

    LUMILINE_FN void linearise() {
        for (int m = 0; m < (int)record.markers; ++m) {
            const unsigned char* used = record.used + m * S;
            bool any = false;
            for (int s = 0; s < S; ++s) any = any || used[s];
            if (!any) continue;
            step.lit = m;
            expected.predict_marker(record.pose);
            for (int s = 0; s < S; ++s) {
                if (!used[s]) continue;
                const double sigma = record.sigma[m * S + s], *by_common = expected.by_common;
                double table = 0.0;
                if (expected.E > C) table = by_common[s * expected.E + C + m * S + s];
                for (int q = 0; q < Q; ++q)
                    rows[count * Q + q] =
                        q < 3 ? expected.jacobian[s][q] / step.radius_mm : expected.jacobian[s][q];
                copy(C, by_common + s * expected.E, common + count * C);
                variance[count++] = sigma * sigma + table * table;
            }
        }
        for (int i = 0; i < N; ++i) {
            for (int j = 0; j <= i; ++j) {
                double sum = i == j ? variance[i] : 0.0;
                for (int c = 0; c < C; ++c) sum += common[i * C + c] * common[j * C + c];
                root[i * N + j] = sum;
            }
            variance[i] = root[i * N + i];
        }
    }

    // The inverse of the root, and the rows times it.
    LUMILINE_FN void whiten() {
        zero(N * N, whitening);
        zero(N * Q, design);
        for (int i = 0; i < N; ++i) {
            double* line = whitening + i * N;
            for (int j = 0; j <= i; ++j) {
                double rest = i == j ? 1.0 : 0.0;
                for (int k = j; k < i; ++k) rest -= root[i * N + k] * whitening[k * N + j];
                line[j] = rest / root[i * N + i];
                add(Q, line[j], rows + j * Q, design + i * Q);
            }
        }
    }

    // False: a matrix has no Cholesky root.
    LUMILINE_FN bool solve() {
        linearise();
        if (!cholesky_root(N, root, 0.0)) return false;
        whiten();
        double normal[Q * Q], arm[3];
        zero(Q * Q, normal);
        for (int i = 0; i < N; ++i)
            for (int q = 0; q < Q; ++q) add(Q, design[i * Q + q], design + i * Q, normal + q * Q);
        if (!cholesky_root(Q, normal, pivot_floor)) return false;
        for (int i = 0; i < 3; ++i) {
            const double *r = record.pose + 3 * i, *tip = step.tip;
            arm[i] = r[0] * tip[0] + r[1] * tip[1] + r[2] * tip[2];
        }
        record.worst = -1;
        record.detectable_sigma = record.external_tip_mm = record.external_rotation_rad = 0.0;
        int reading = 0;
        for (int index = 0; index < (int)record.markers * S; ++index) {
            if (!record.used[index]) continue;
            const int j = reading++;
            // The change of the unknowns by an error of this reading.
            double x[Q], alone = 0.0, precision = 0.0;
            zero(Q, x);
            for (int i = j; i < N; ++i) add(Q, whitening[i * N + j], design + i * Q, x);
            for (int q = 0; q < Q; ++q) {
                for (int k = 0; k < q; ++k) x[q] -= normal[q * Q + k] * x[k];
                x[q] /= normal[q * Q + q];
            }
            for (int q = Q - 1; q >= 0; --q) {
                for (int k = q + 1; k < Q; ++k) x[q] -= normal[k * Q + q] * x[k];
                x[q] /= normal[q * Q + q];
            }
            for (int i = 0; i < N; ++i) {
                double rest = whitening[i * N + j];
                alone += rest * rest;
                for (int q = 0; q < Q; ++q) rest -= design[i * Q + q] * x[q];
                precision += rest * rest;
            }
            if (!is_finite(precision)) return false;
            const bool checked = precision / alone > redundancy_floor;
            const double size = checked ? sqrt(record.noncentrality) / sqrt(precision) : infinity();
            const double in_sigma = size / sqrt(variance[j]);
            if (record.worst < 0 || in_sigma > record.detectable_sigma) {
                record.detectable_sigma = in_sigma;
                record.worst = index;
            }
            for (int q = 0; q < 3; ++q) x[q] /= step.radius_mm;
            const double shift[3] = {x[3] + x[1] * arm[2] - x[2] * arm[1],
                                     x[4] + x[2] * arm[0] - x[0] * arm[2],
                                     x[5] + x[0] * arm[1] - x[1] * arm[0]};
            const double tip =
                sqrt(shift[0] * shift[0] + shift[1] * shift[1] + shift[2] * shift[2]);
            const double rotation = sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
            record.external_tip_mm = larger(record.external_tip_mm, tip * size);
            record.external_rotation_rad = larger(record.external_rotation_rad, rotation * size);
        }
        return true;
    }
};

// Works out a ReliabilityRecord; CPU only.
template <int S, int TERMS>
LUMILINE_FN void pose_reliability(unsigned long long address) {
    ReliabilityRecord& record = *(ReliabilityRecord*)address;
    PoseReliability<S, TERMS> reliability(record);
    record.solved = reliability.solve();
}

}  // namespace lumiline::pose
