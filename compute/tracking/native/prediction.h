// Mixing and prediction of the motion models' states of tracks, and their mixtures:
// mix_and_predict and combine_modes of compute.tracking.motion_model.
#pragma once

#include "compute/native/platform.h"
#include "compute/tracking/native/definitions.gen.h"

namespace lumiline::tracking {

// Means, covariances and covariances with S biases of one track's M states, or mixtures of them.
struct States {
    double *mean, *covariance, *bias;
    int sensors;

    LUMILINE_FN double* mean_of(int k) const { return mean + k * 9; }

    LUMILINE_FN double* covariance_of(int k) const { return covariance + k * 81; }

    LUMILINE_FN double* bias_of(int k) const { return bias + (long long)k * 9 * sensors; }
};

// The mixture of M states with given weights. Models without acceleration take that of the one
// that has it: ``source``, -1: none has, or all have.
LUMILINE_NOINLINE void mix_states(const States& from, int models, const long long* has, int source,
                                  const double* weight, double* mean, double* covariance,
                                  double* bias) {
    const int wide = 9 * from.sensors;
    for (int i = 0; i < 9; ++i) mean[i] = 0.0;
    for (int i = 0; i < 81; ++i) covariance[i] = 0.0;
    for (int i = 0; i < wide; ++i) bias[i] = 0.0;
    for (int k = 0; k < models; ++k) {
        const double *m = from.mean_of(k), *p = from.covariance_of(k), *q = from.bias_of(k);
        for (int i = 0; i < 9; ++i) mean[i] += weight[k] * m[i];
        for (int i = 0; i < 81; ++i) covariance[i] += weight[k] * p[i];
        for (int i = 0; i < wide; ++i) bias[i] += weight[k] * q[i];
        if (source < 0 || has[k]) continue;
        const double *acceleration = from.mean_of(source), *own = from.covariance_of(source);
        for (int i = 6; i < 9; ++i) {
            mean[i] += weight[k] * (acceleration[i] - m[i]);
            for (int j = 6; j < 9; ++j)
                covariance[9 * i + j] += weight[k] * (own[9 * i + j] - p[9 * i + j]);
        }
    }
    for (int k = 0; k < models; ++k) {
        const bool takes = source >= 0 && !has[k];
        const double* m = from.mean_of(k);
        double off[9];
        for (int i = 0; i < 9; ++i)
            off[i] = (takes && i >= 6 ? from.mean_of(source)[i] : m[i]) - mean[i];
        for (int i = 0; i < 9; ++i)
            for (int j = 0; j < 9; ++j) covariance[9 * i + j] += weight[k] * off[i] * off[j];
    }
}

// Transition and process noise of one axis over t: cv_transition and ca_transition.
LUMILINE_FN void axis_transition(bool accelerates, double psd, double t, double* f, double* q) {
    const double t2 = t * t, t3 = t2 * t;
    for (int i = 0; i < 9; ++i) f[i] = q[i] = 0.0;
    f[0] = f[4] = 1.0;
    f[1] = t;
    if (accelerates) {
        f[2] = 0.5 * t2;
        f[5] = t;
        f[8] = 1.0;
        q[0] = psd * t3 * t2 / 20.0;
        q[1] = q[3] = psd * t2 * t2 / 8.0;
        q[2] = q[6] = psd * t3 / 6.0;
        q[4] = psd * t3 / 3.0;
        q[5] = q[7] = psd * t2 / 2.0;
        q[8] = psd * t;
    } else {
        q[0] = psd * t3 / 3.0;
        q[1] = q[3] = psd * t2 / 2.0;
        q[4] = psd * t;
    }
}

// One state over t, in place: the axes move independently of one another.
LUMILINE_NOINLINE void predict_state(double* mean, double* covariance, double* bias, int sensors,
                                     bool accelerates, double psd, double t) {
    double f[9], q[9], moved[81];
    axis_transition(accelerates, psd, t, f, q);
    for (int a = 0; a < 3; ++a)
        for (int i = 0; i < 3; ++i)
            moved[3 * a + i] =
                f[3 * a] * mean[i] + f[3 * a + 1] * mean[3 + i] + f[3 * a + 2] * mean[6 + i];
    for (int i = 0; i < 9; ++i) mean[i] = moved[i];
    // F P, then (F P) F'.
    for (int a = 0; a < 3; ++a)
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 9; ++j) {
                const double* p = covariance + 9 * i + j;
                moved[9 * (3 * a + i) + j] =
                    f[3 * a] * p[0] + f[3 * a + 1] * p[27] + f[3 * a + 2] * p[54];
            }
    for (int i = 0; i < 9; ++i)
        for (int c = 0; c < 3; ++c)
            for (int j = 0; j < 3; ++j) {
                const double* p = moved + 9 * i + j;
                covariance[9 * i + 3 * c + j] =
                    f[3 * c] * p[0] + f[3 * c + 1] * p[3] + f[3 * c + 2] * p[6];
            }
    for (int a = 0; a < 3; ++a)
        for (int c = 0; c < 3; ++c)
            for (int i = 0; i < 3; ++i) covariance[9 * (3 * a + i) + 3 * c + i] += q[3 * a + c];
    for (int i = 0; i < 3; ++i)
        for (int s = 0; s < sensors; ++s) {
            double* b = bias + i * sensors + s;
            const double x = b[0], v = b[3 * sensors], w = b[6 * sensors];
            for (int a = 0; a < 3; ++a)
                b[3 * a * sensors] = f[3 * a] * x + f[3 * a + 1] * v + f[3 * a + 2] * w;
        }
}

// The states of T tracks, predicted, and their mixtures, each where there is memory for it.
LUMILINE_FN void predict_tracks(unsigned long long address) {
    PredictionJob& job = *(PredictionJob*)address;
    const int models = (int)job.models, sensors = (int)job.sensors, wide = 9 * sensors,
              source = (int)job.acceleration_source;
    for (int t = 0; t < (int)job.tracks; ++t) {
        const double step = job.step_s[t];
        const States before{(double*)job.mean + (long long)t * models * 9,
                            (double*)job.covariance + (long long)t * models * 81,
                            (double*)job.bias + (long long)t * models * wide, sensors};
        const double* probability = job.probability + t * models;
        const States after{job.predicted_mean + (long long)t * models * 9,
                           job.predicted_covariance + (long long)t * models * 81,
                           job.predicted_bias + (long long)t * models * wide, sensors};
        double* ahead = job.predicted_probability + t * models;
        const bool moves = step != 0.0;
        // The probability of a switch, (1 - exp(-2 t)) / 2: a Poisson process in continuous time.
        const double sojourns = step / job.mean_sojourn_s;
        const double change = exp(-sojourns) * sinh(sojourns);
        for (int to = 0; to < models; ++to) {
            double weight[2] = {0.0, 0.0};
            if (models == 1 || !moves) {
                weight[to] = 1.0;
                ahead[to] = probability[to];
            } else {
                weight[to] = probability[to] * (1.0 - change);
                weight[1 - to] = probability[1 - to] * change;
                ahead[to] = weight[0] + weight[1];
                weight[0] /= ahead[to];
                weight[1] /= ahead[to];
            }
            double *m = after.mean_of(to), *p = after.covariance_of(to), *b = after.bias_of(to);
            mix_states(before, models, job.has_acceleration, source, weight, m, p, b);
            if (models > 1 && !job.has_acceleration[to])
                for (int i = 6; i < 9; ++i) {
                    m[i] = 0.0;
                    for (int j = 0; j < 9; ++j) p[9 * i + j] = p[9 * j + i] = 0.0;
                    for (int s = 0; s < sensors; ++s) b[i * sensors + s] = 0.0;
                }
            if (moves)
                predict_state(m, p, b, sensors, job.has_acceleration[to] != 0, job.noise_psd[to],
                              step);
        }
        if (job.mixed_mean)
            mix_states(after, models, job.has_acceleration, source, ahead,
                       job.mixed_mean + (long long)t * 9, job.mixed_covariance + (long long)t * 81,
                       job.mixed_bias + (long long)t * wide);
    }
}

}  // namespace lumiline::tracking
