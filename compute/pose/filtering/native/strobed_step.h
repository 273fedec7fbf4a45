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
    double *const result, *const peak_of, *const excluded, *const mixture, *const whitened;
    double *const all_crossed, *const whitened_rows, *const nis, *const log_probability;
    // The readings within the gates: their sensors, innovations and variances.
    int count = 0, sensor[S];
    double innovation[S], noise[S], log_size = 0.0;

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
          excluded(peak_of + S),
          mixture(excluded + S),
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

    // Predicted readings of the lit marker in the widest mode of states. False: its covariance has
    // no Cholesky root.
    LUMILINE_FN bool predict_readings(const double* modes, double min_variance) {
        expected.predict_marker(modes);
        const double* widest = widest_covariance(modes);
        bool all_finite = true;
        double max_gain = 0.0;
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
        return !all_finite
               || !((rotation + shifted) * max_gain > max_curvature_fraction * sqrt(min_variance))
               || expected.add_curvature(modes, widest);
    }

    // The covariance of the widest mode, (D, W).
    LUMILINE_FN const double* widest_covariance(const double* modes) const {
        return imm.covariances_of(modes) + (K - 1) * D * W;
    }

    // Covariances of a sensor's predicted reading, by the widest mode; returns its variance.
    LUMILINE_FN double predicted_variance(const double* widest, int s) {
        double* crossed = all_crossed + s * W;
        cross_covariance(widest, s, crossed);
        return innovation_covariance(crossed, s) + expected.curvature[s][s];
    }

    // The readings within the gates of the widest mode. False: a sensor has several.
    LUMILINE_FN bool gate_readings(const double* predicted) {
        const double* widest = widest_covariance(predicted);
        for (int s = 0; s < S; ++s) {
            const double variance = predicted_variance(widest, s);
            int fitting = 0;
            for (int i = s * P; i < (s + 1) * P; ++i) {
                const double off = step.position[i] - expected.value[s];
                if (!step.usable[i] || !(off * off <= step.gate * (variance + step.variance[i])))
                    continue;
                fitting += 1;
                innovation[s] = off;
                noise[s] = step.variance[i];
                peak_of[s] = i - s * P;
            }
            if (fitting > 1) return false;
            if (fitting) sensor[count++] = s;
        }
        return true;
    }

    // Whitens the readings by a mode: innovation, covariances with states and common errors,
    // (n, 1 + W). False: their covariance has no Cholesky root.
    LUMILINE_FN bool whiten_readings(const double* predicted, int k) {
        const int row = 1 + W;
        const double *off = imm.offsets_of(predicted) + k * D,
                     *covariance = imm.covariances_of(predicted) + k * D * W;
        double* mode_rows = whitened_rows + k * S * row;
        double root[S][S], inverse[S];
        nis[k] = log_size = 0.0;
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
            if (!(root[i][i] > 0.0)) return false;
            log_size += 0.5 * log(root[i][i]);
            inverse[i] = 1.0 / sqrt(root[i][i]);
            double* right = mode_rows + i * row;
            for (int j = 0; j < i; ++j) add(row, -root[i][j], mode_rows + j * row, right);
            for (int c = 0; c < row; ++c) right[c] *= inverse[i];
            nis[k] += right[0] * right[0];
        }
        return true;
    }

    // Leaves out readings that contradict the others, by the widest mode, until the rest fit:
    // robust_update of compute.pose.filtering.association. False: too many would have to be.
    LUMILINE_FN bool exclude_contradicting() {
        for (int left = (count + 1) / 4;; --left) {
            // The Cholesky root of the readings' covariance, its inverse, whitened innovations.
            double root[S][S], inverse[S][S], whitened_innovation[S], square = 0.0, worst = -1.0;
            for (int i = 0; i < count; ++i) {
                const int s = sensor[i];
                whitened_innovation[i] = 0.0;
                for (int j = 0; j <= i; ++j) {
                    const int t = sensor[j];
                    double rest =
                        innovation_covariance(all_crossed + s * W, t) + expected.curvature[s][t];
                    if (i == j) rest += noise[s];
                    for (int k = 0; k < j; ++k) rest -= root[i][k] * root[j][k];
                    root[i][j] = i == j ? sqrt(rest) : rest / root[j][j];
                }
                for (int j = 0; j <= i; ++j) {
                    double rest = i == j ? 1.0 : 0.0;
                    for (int k = j; k < i; ++k) rest -= root[i][k] * inverse[k][j];
                    inverse[i][j] = rest / root[i][i];
                    whitened_innovation[i] += inverse[i][j] * innovation[sensor[j]];
                }
                square += whitened_innovation[i] * whitened_innovation[i];
            }
            if (square <= step.chi2_limits[count]) return true;
            if (left == 0) return false;
            int blamed = 0;
            for (int j = 0; j < count; ++j) {
                double share = 0.0, precision = 0.0;
                for (int i = j; i < count; ++i) {
                    share += inverse[i][j] * whitened_innovation[i];
                    precision += inverse[i][j] * inverse[i][j];
                }
                const double blame = share * share / precision;
                if (!(blame > worst)) continue;
                worst = blame;
                blamed = j;
            }
            peak_of[sensor[blamed]] = -1.0;
            count -= 1;
            for (int i = blamed; i < count; ++i) sensor[i] = sensor[i + 1];
        }
    }

    // Normalised squares of peaks that are near but were not used:
    // ToolObservation.excluded_nis. False: a covariance has no Cholesky root.
    LUMILINE_FN bool find_excluded(const double* modes) {
        double min_variance = infinity();
        bool any = false;
        for (int s = 0; s < S; ++s) {
            excluded[s] = 0.0;
            for (int i = 0; i < P; ++i) {
                if (!step.usable[s * P + i] || i == peak_of[s]) continue;
                min_variance = smaller(min_variance, step.variance[s * P + i]);
                any = any || peak_of[s] < 0.0;
            }
        }
        if (!any) return true;
        if (!predict_readings(modes, min_variance)) return false;
        const double* widest = widest_covariance(modes);
        for (int s = 0; s < S; ++s) {
            if (peak_of[s] >= 0.0) continue;
            const double variance = predicted_variance(widest, s);
            double square = infinity();
            for (int i = s * P; i < (s + 1) * P; ++i) {
                const double off = step.position[i] - expected.value[s];
                // A value that is no number is near nothing.
                if (step.usable[i] && off <= near_miss_px && -off <= near_miss_px)
                    square = smaller(square, off * off / (variance + step.variance[i]));
            }
            // A peak within the gate fits; it was only ambiguous.
            if (square < infinity() && square > step.gate)
                excluded[s] = smaller(square, max_excluded_nis);
        }
        return true;
    }

    // Writes what came of it; the states are those of `modes`.
    LUMILINE_FN void finish(int how, const double* modes) {
        if (how != status_updated) {
            count = 0;
            for (int s = 0; s < S; ++s) peak_of[s] = -1.0;
        }
        result[0] = how;
        result[1] = count;
        if (how == status_contested || how == status_indefinite) return;
        imm.mixed_pose(modes, mixture);
        pose_outputs(step, mixture, step.reported_pose);
        if (!find_excluded(modes)) result[0] = status_indefinite;
    }

    LUMILINE_FN void solve() {
        if (step.lit < 0) {
            imm.predict_mixed(step.before, mixture);
            pose_outputs(step, mixture, step.reported_pose);
            return;
        }
        imm.predict(step.before, step.predicted);
        const double* predicted = step.predicted;
        double min_variance = infinity();
        for (int i = 0; i < S * P; ++i)
            if (step.usable[i]) min_variance = smaller(min_variance, step.variance[i]);
        for (int s = 0; s < S; ++s) peak_of[s] = -1.0;
        result[2] = 0.0;
        if (!(min_variance < infinity())) {
            finish(status_updated, predicted);
            return;
        }
        if (!predict_readings(predicted, min_variance)) {
            finish(status_indefinite, predicted);
            return;
        }
        if (!gate_readings(predicted)) {
            finish(status_contested, predicted);
            return;
        }
        if (count == 0) {
            finish(status_updated, predicted);
            return;
        }
        // The widest first: it says whether the readings fit.
        bool definite = whiten_readings(predicted, K - 1);
        if (definite && !(nis[K - 1] <= step.chi2_limits[count])) {
            if (!exclude_contradicting()) {
                finish(status_misfit, predicted);
                return;
            }
            definite = whiten_readings(predicted, K - 1);
        }
        double* after = step.after;
        const int row = 1 + W;
        double highest = -infinity();
        for (int k = K - 1; k >= 0 && definite; --k) {
            if (k < K - 1) definite = whiten_readings(predicted, k);
            log_probability[k] = log(imm.probabilities_of(predicted)[k]) - 0.5 * nis[k] - log_size;
            highest = larger(highest, log_probability[k]);
            double *offset_after = imm.offsets_of(after) + k * D,
                   *covariance_after = imm.covariances_of(after) + k * D * W;
            copy(D, imm.offsets_of(predicted) + k * D, offset_after);
            copy(D * W, imm.covariances_of(predicted) + k * D * W, covariance_after);
            for (int i = 0; i < count; ++i) {
                const double* right = whitened_rows + (k * S + i) * row;
                for (int r = 0; r < D; ++r) {
                    offset_after[r] += right[1 + r] * right[0];
                    add(W, -right[1 + r], right + 1, covariance_after + r * W);
                }
            }
        }
        if (!definite) {
            finish(status_indefinite, predicted);
            return;
        }
        double sum = 0.0;
        int most_probable = 0;
        for (int k = 0; k < K; ++k) {
            sum += imm.probabilities_of(after)[k] = exp(log_probability[k] - highest);
            most_probable = log_probability[k] > log_probability[most_probable] ? k : most_probable;
        }
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

// Takes the steps of a FrameRecord, one after another; CPU only.
template <int S, int TERMS>
LUMILINE_FN void take_steps(unsigned long long frame_address) {
    const FrameRecord& frame = *(const FrameRecord*)frame_address;
    for (long long i = 0; i < frame.count; ++i) {
        StrobedStepKernel<S, TERMS> step(*(const StepRecord*)frame.steps[i]);
        step.solve();
    }
}

}  // namespace lumiline::pose
