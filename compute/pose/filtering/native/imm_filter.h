// Prediction and mixture of the modes of an interacting multiple model:
// compute.pose.filtering.imm.
#pragma once

#include "compute/native/platform.h"
#include "compute/pose/filtering/native/definitions.gen.h"
#include "compute/pose/filtering/native/pose_algebra.h"

namespace lumiline::pose {

// Takes one array after another from memory to work in.
struct Scratch {
    double* next;

    LUMILINE_FN double* allocate(int count) {
        double* const first = next;
        next += count;
        return first;
    }
};

// K modes of D states and E common errors. They lie in one array: the pose of the widest mode, the
// probabilities, each mode's offset from the widest, the covariances (D, W).
struct ImmFilter {
    const StepRecord& step;
    const int K, E, W;
    double *const mixing, *const square, *const mean, *const joint;

    LUMILINE_FN ImmFilter(const StepRecord& from, Scratch& scratch)
        : step(from),
          K((int)from.modes),
          E((int)from.errors),
          W(D + E),
          mixing(scratch.allocate(K * K)),
          square(scratch.allocate(D * D)),
          mean(scratch.allocate(D)),
          joint(scratch.allocate(D * W)) {}

    template <class T>
    LUMILINE_FN T* probabilities_of(T* modes) const {
        return modes + pose_size;
    }

    template <class T>
    LUMILINE_FN T* offsets_of(T* modes) const {
        return modes + pose_size + K;
    }

    template <class T>
    LUMILINE_FN T* covariances_of(T* modes) const {
        return modes + pose_size + K + K * D;
    }

    // The modes after step.time_s.
    LUMILINE_FN void predict(const double* from, double* to) {
        const double h = step.time_s;
        if (h == 0.0) {
            copy(pose_size + K * (1 + D + D * W), from, to);
            return;
        }
        const double stay = K > 1 ? 1.0 - (K - 1) * step.switch_probability : 1.0;
        const double more = step.manoeuvre_factor * step.manoeuvre_factor;
        const double *probability = probabilities_of(from), *off = offsets_of(from),
                     *covariance = covariances_of(from);
        double *probability_to = probabilities_of(to), *offset_to = offsets_of(to),
               *covariance_to = covariances_of(to);
        for (int j = 0; j < K; ++j) {
            double sum = 0.0;
            for (int i = 0; i < K; ++i)
                sum += mixing[j * K + i] =
                    probability[i] * (i == j ? stay : step.switch_probability);
            for (int i = 0; i < K; ++i) mixing[j * K + i] /= sum;
            probability_to[j] = sum;
        }
        for (int j = 0; j < K; ++j) {
            double *mode_covariance = covariance_to + j * D * W, *at = offset_to + j * D,
                   renewal = 0.0;
            zero(D, at);
            zero(D * W, mode_covariance);
            for (int i = 0; i < K; ++i) {
                add(D, mixing[j * K + i], off + i * D, at);
                add(D * W, mixing[j * K + i], covariance + i * D * W, mode_covariance);
                renewal += mixing[j * K + i] * step.renewal[i];
            }
            for (int i = 0; i < K; ++i) {
                double about[D];
                for (int r = 0; r < D; ++r) about[r] = off[i * D + r] - at[r];
                for (int r = 0; r < D; ++r)
                    add(D, mixing[j * K + i] * about[r], about, mode_covariance + r * W);
            }
            // Where an acceleration does not last there is none; one that begins to is anything.
            const double *persists = step.persistence + j * D,
                         *fresh = step.initial_covariance + j * D * D;
            for (int r = 0; r < D; ++r) {
                at[r] *= persists[r];
                for (int c = 0; c < D; ++c)
                    mode_covariance[r * W + c] =
                        mode_covariance[r * W + c] * (persists[r] * persists[c])
                        + more * renewal * fresh[r * D + c];
                for (int c = D; c < W; ++c) mode_covariance[r * W + c] *= persists[r];
            }
        }
        double rotation[9], rotation_step[3], last[D];
        copy(D, offset_to + (K - 1) * D, last);
        retract(from, last, to);
        for (int i = 0; i < 3; ++i) rotation_step[i] = h * to[15 + i];
        rotation_matrix(rotation_step, rotation);
        rotate(rotation, to, to);
        for (int i = 0; i < 3; ++i) to[9 + i] += h * to[12 + i];
        for (int j = 0; j < K; ++j) {
            double *mode_covariance = covariance_to + j * D * W, *at = offset_to + j * D;
            for (int r = 0; r < D; ++r) at[r] -= last[r];
            propagate(1, h, rotation, at);
            propagate(W, h, rotation, mode_covariance);
            for (int r = 0; r < D; ++r) copy(D, mode_covariance + r * W, square + r * D);
            // The columns as well, as the rows: but for the rotation of the rows it is symmetric.
            for (int r = 0; r < D; ++r)
                for (int c = 0; c < r; ++c) {
                    const double above = square[r * D + c];
                    square[r * D + c] = square[c * D + r];
                    square[c * D + r] = above;
                }
            propagate(D, h, rotation, square);
            double power = more;
            for (int term = 0; term < 5; ++term) {
                power *= h;
                add(D * D, power, step.terms + (term * K + j) * D * D, square);
            }
            // Symmetric to the bit: what rounding leaves would grow.
            for (int r = 0; r < D; ++r)
                for (int c = 0; c <= r; ++c)
                    mode_covariance[r * W + c] = mode_covariance[c * W + r] =
                        0.5 * square[r * D + c] + 0.5 * square[c * D + r];
        }
    }

    // The state of all modes together: a pose, its covariance and that with the common errors.
    LUMILINE_FN void mix(const double* modes, int rows) {
        const double *probability = probabilities_of(modes), *off = offsets_of(modes),
                     *covariance = covariances_of(modes);
        zero(D, mean);
        zero(rows * W, joint);
        for (int i = 0; i < K; ++i) {
            add(D, probability[i], off + i * D, mean);
            add(rows * W, probability[i], covariance + i * D * W, joint);
        }
        for (int i = 0; i < K; ++i) {
            double about[D];
            for (int r = 0; r < rows; ++r) about[r] = off[i * D + r] - mean[r];
            for (int r = 0; r < rows; ++r)
                add(rows, probability[i] * about[r], about, joint + r * W);
        }
    }

    // The pose of all modes together.
    LUMILINE_FN void mixed_pose(const double* modes, double* mixture) {
        mix(modes, 12);
        retract(modes, mean, mixture);
        for (int r = 0; r < 12; ++r) {
            copy(12, joint + r * W, mixture + pose_size + 12 * r);
            copy(E, joint + r * W + D, mixture + pose_size + 144 + E * r);
        }
    }

    // That at a later instant, as ImmState.predict_combined.
    LUMILINE_FN void predict_mixed(const double* from, double* mixture) {
        const double h = step.time_s, stay = K > 1 ? 1.0 - (K - 1) * step.switch_probability : 1.0;
        double rotation[9], rotation_step[3], later[18];
        mix(from, D);
        for (int i = 0; i < 3; ++i) rotation_step[i] = h * from[15 + i];
        rotation_matrix(rotation_step, rotation);
        propagate(1, h, rotation, mean);
        propagate(W, h, rotation, joint);
        for (int r = 0; r < D; ++r)
            for (int c = 0; c < D; ++c) square[c * D + r] = joint[r * W + c];
        propagate(D, h, rotation, square);
        for (int j = 0; j < K; ++j) {
            double power = 0.0;
            for (int i = 0; i < K; ++i)
                power += probabilities_of(from)[i] * (i == j ? stay : step.switch_probability);
            for (int term = 0; term < 5; ++term) {
                power *= h;
                add(D * D, power, step.terms + (term * K + j) * D * D, square);
            }
        }
        copy(18, from, later);
        rotate(rotation, from, later);
        for (int i = 0; i < 3; ++i) later[9 + i] += h * from[12 + i];
        retract(later, mean, mixture);
        for (int r = 0; r < 12; ++r) {
            for (int c = 0; c < 12; ++c) mixture[pose_size + 12 * r + c] = square[c * D + r];
            copy(E, joint + r * W + D, mixture + pose_size + 144 + E * r);
        }
    }
};

}  // namespace lumiline::pose
