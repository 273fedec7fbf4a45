// One exposure of a strobed tool: prediction of its modes, and their update by the readings within
// the gates, as ImmState.update of compute.pose.filtering.imm.
#pragma once

#include "compute/native/platform.h"
#include "compute/pose/filtering/native/definitions.gen.h"
#include "compute/pose/filtering/native/imm_filter.h"
#include "compute/pose/filtering/native/measurement_prediction.h"
#include "compute/pose/filtering/native/pose_algebra.h"
#include "compute/pose/filtering/native/pose_outputs.h"

namespace lumiline::pose {

template <int S, int TERMS>
struct StrobedStepKernel {
    const StepRecord& step;
    Scratch scratch;
    ImmFilter imm;
    MeasurementPrediction<S, TERMS> expected;
    const int K, E, W, P;
    // The results, one after another.
    double *const result, *const peak_of, *const mixture, *const whitened;
    double *const all_crossed, *const whitened_rows, *const nis, *const log_probability;
    int count = 0, sensor[S];

    LUMILINE_FN explicit StrobedStepKernel(const StepRecord& from)
        : step(from),
          scratch{from.scratch},
          imm(from, scratch),
          expected(from, scratch),
          K(imm.K),
          E(imm.E),
          W(imm.W),
          P((int)from.peaks),
          result(from.result),
          peak_of(result + head_size),
          mixture(peak_of + S),
          whitened(mixture + pose_size + 144 + 12 * E),
          all_crossed(scratch.allocate(S * W)),
          whitened_rows(scratch.allocate(K * S * (1 + W))),
          nis(scratch.allocate(K)),
          log_probability(scratch.allocate(K)) {}

    // Covariance of a reading with the states and the common errors of a mode, (W,).
    LUMILINE_FN void cross_covariance(const double* covariance, int s,
                                      double* __restrict__ crossed) {
        const double* common = expected.by_common + s * E;
        zero(W, crossed);
        for (int r = 0; r < 6; ++r) add(W, expected.jacobian[s][r], covariance + r * W, crossed);
        if (E == 0) return;
        for (int i = 0; i < D; ++i) {
            const double* row = covariance + i * W + D;
            double parts[4] = {0.0, 0.0, 0.0, 0.0};
            int e = 0;
            for (; e + 4 <= E; e += 4)
                for (int k = 0; k < 4; ++k) parts[k] += common[e + k] * row[e + k];
            for (; e < E; ++e) parts[0] += common[e] * row[e];
            crossed[i] += (parts[0] + parts[1]) + (parts[2] + parts[3]);
        }
        add(E, 1.0, common, crossed + D);
    }

    // Its covariance with another reading.
    LUMILINE_FN double innovation_covariance(const double* crossed, int t) {
        const double* common = expected.by_common + t * E;
        double sum = 0.0;
        for (int r = 0; r < 6; ++r) sum += crossed[r] * expected.jacobian[t][r];
        for (int e = 0; e < E; ++e) sum += crossed[D + e] * common[e];
        return sum;
    }

    LUMILINE_FN void finish(int how, const double* modes) {
        result[0] = how;
        result[1] = count;
        if (how != status_updated) return;
        imm.mixed_pose(modes, mixture);
        pose_outputs(step, mixture, step.reported_pose);
    }

    LUMILINE_FN void solve() {
        if (step.lit < 0) {
            imm.predict_mixed(step.before, mixture);
            pose_outputs(step, mixture, step.reported_pose);
            return;
        }
        imm.predict(step.before, step.predicted);
        const double* predicted = step.predicted;
        double min_variance = infinity(), max_gain = 0.0;
        for (int i = 0; i < S * P; ++i)
            if (step.usable[i]) min_variance = smaller(min_variance, step.variance[i]);
        for (int s = 0; s < S; ++s) peak_of[s] = -1.0;
        result[2] = result[3] = 0.0;
        if (!(min_variance < infinity())) {
            finish(status_updated, predicted);
            return;
        }
        expected.predict_marker(predicted);
        // The gates are the widest mode's.
        const double* widest = imm.covariances_of(predicted) + (K - 1) * D * W;
        bool all_finite = true;
        for (int s = 0; s < S; ++s)
            for (int axis = 3; axis < 6; ++axis) {
                const double derivative = expected.jacobian[s][axis] < 0.0
                                              ? -expected.jacobian[s][axis]
                                              : expected.jacobian[s][axis];
                all_finite = all_finite && derivative == derivative;
                max_gain = larger(max_gain, derivative);
            }
        const double rotation =
            0.5 * step.radius_mm * (widest[0] + widest[W + 1] + widest[2 * W + 2]);
        const double shifted = (widest[3 * W + 3] + widest[4 * W + 4] + widest[5 * W + 5])
                               * max_gain / step.principal_distance_px;
        if (all_finite
            && (rotation + shifted) * max_gain > max_curvature_fraction * sqrt(min_variance)
            && !expected.add_curvature(predicted, widest)) {
            finish(status_curved, predicted);
            return;
        }
        double innovation[S], noise[S];
        for (int s = 0; s < S; ++s) {
            double* crossed = all_crossed + s * W;
            cross_covariance(widest, s, crossed);
            const double predicted_variance =
                innovation_covariance(crossed, s) + expected.curvature[s][s];
            int fitting = 0;
            for (int i = s * P; i < (s + 1) * P; ++i) {
                const double off = step.position[i] - expected.value[s];
                if (!step.usable[i]
                    || !(off * off <= step.gate * (predicted_variance + step.variance[i])))
                    continue;
                fitting += 1;
                innovation[s] = off;
                noise[s] = step.variance[i];
                peak_of[s] = i - s * P;
            }
            if (fitting > 1) {
                finish(status_contested, predicted);
                return;
            }
            if (fitting) sensor[count++] = s;
        }
        if (count == 0) {
            finish(status_updated, predicted);
            return;
        }
        double* after = step.after;
        const int row = 1 + W;
        double highest = -infinity();
        // The widest first: it says whether the readings fit.
        for (int k = K - 1; k >= 0; --k) {
            const double *off = imm.offsets_of(predicted) + k * D,
                         *covariance = imm.covariances_of(predicted) + k * D * W;
            double* mode_rows = whitened_rows + k * S * row;
            double root[S][S], inverse[S], log_size = 0.0;
            nis[k] = 0.0;
            for (int i = 0; i < count; ++i) {
                const int s = sensor[i];
                double* right = mode_rows + i * row;
                if (k == K - 1)
                    copy(W, all_crossed + s * W, right + 1);
                else
                    cross_covariance(covariance, s, right + 1);
                right[0] = innovation[s];
                for (int r = 0; r < 6; ++r) right[0] -= expected.jacobian[s][r] * off[r];
                for (int j = 0; j <= i; ++j) {
                    const int t = sensor[j];
                    root[i][j] = innovation_covariance(right + 1, t) + expected.curvature[s][t];
                }
                root[i][i] += noise[s];
            }
            for (int i = 0; i < count; ++i) {
                for (int j = 0; j <= i; ++j) {
                    double rest = root[i][j];
                    for (int t = 0; t < j; ++t) rest -= root[i][t] * root[j][t];
                    if (j < i)
                        root[i][j] = rest * inverse[j];
                    else
                        root[i][i] = rest;
                }
                if (!(root[i][i] > 0.0)) {
                    finish(status_misfit, predicted);
                    return;
                }
                log_size += 0.5 * log(root[i][i]);
                inverse[i] = 1.0 / sqrt(root[i][i]);
                double* right = mode_rows + i * row;
                for (int j = 0; j < i; ++j) add(row, -root[i][j], mode_rows + j * row, right);
                for (int c = 0; c < row; ++c) right[c] *= inverse[i];
                nis[k] += right[0] * right[0];
            }
            if (k == K - 1 && !(nis[k] <= step.chi2_limits[count])) {
                finish(status_misfit, predicted);
                return;
            }
            log_probability[k] = log(imm.probabilities_of(predicted)[k]) - 0.5 * nis[k] - log_size;
            highest = larger(highest, log_probability[k]);
            double *offset_after = imm.offsets_of(after) + k * D,
                   *covariance_after = imm.covariances_of(after) + k * D * W;
            copy(D, off, offset_after);
            copy(D * W, covariance, covariance_after);
            for (int i = 0; i < count; ++i) {
                const double* right = mode_rows + i * row;
                for (int r = 0; r < D; ++r) {
                    offset_after[r] += right[1 + r] * right[0];
                    add(W, -right[1 + r], right + 1, covariance_after + r * W);
                }
            }
        }
        double sum = 0.0;
        int most_probable = 0;
        for (int k = 0; k < K; ++k) {
            sum += imm.probabilities_of(after)[k] = exp(log_probability[k] - highest);
            most_probable = log_probability[k] > log_probability[most_probable] ? k : most_probable;
        }
        result[3] = nis[K - 1];
        for (int k = 0; k < K; ++k) {
            imm.probabilities_of(after)[k] /= sum;
            result[2] += imm.probabilities_of(after)[k] * nis[k];
        }
        double last[D];
        copy(D, imm.offsets_of(after) + (K - 1) * D, last);
        retract(predicted, last, after);
        for (int k = 0; k < K; ++k) add(D, -1.0, last, imm.offsets_of(after) + k * D);
        for (int i = 0; i < count; ++i) {
            const double* right = whitened_rows + (most_probable * S + i) * row;
            whitened[i * (1 + E)] = right[0];
            copy(E, right + 1 + D, whitened + i * (1 + E) + 1);
        }
        finish(status_updated, after);
    }
};

// Takes the step of a StepRecord; CPU only.
template <int S, int TERMS>
LUMILINE_FN void take_step(unsigned long long step_address) {
    StrobedStepKernel<S, TERMS> step(*(const StepRecord*)step_address);
    step.solve();
}

}  // namespace lumiline::pose
