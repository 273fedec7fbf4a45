// Predicted readings of the lit marker by all sensors: values, Jacobians by rotation and position,
// derivatives by the common errors; nan behind a lens. As
// compute.measurement.measurement_model and compute.pose.filtering.pose_filter.
#pragma once

#include "compute/native/platform.h"
#include "compute/pose/filtering/native/definitions.gen.h"
#include "compute/pose/filtering/native/imm_filter.h"
#include "compute/pose/filtering/native/pose_algebra.h"
#include "compute/reconstruction/native/cameras.h"
#include "compute/reconstruction/native/correction_table.h"
#include "compute/reconstruction/native/cubic_distortion.h"
#include "compute/reconstruction/native/lanes.h"

namespace lumiline::pose {

template <int S, int TERMS>
struct MeasurementPrediction {
    static constexpr int V = vector_count<S>;

    const StepRecord& step;
    const Cameras<S, TERMS> cameras;
    const CorrectionTable<S> table;
    const int E, W;
    double value[S], jacobian[S][6], arm[3], position[3], gains[S], by_position[S][3];
    double curvature[S][S];
    double* const by_common;

    LUMILINE_FN MeasurementPrediction(const StepRecord& from, Scratch& scratch)
        : step(from),
          cameras(from.cameras),
          table(from.cameras),
          E((int)from.errors),
          W(D + E),
          by_common(scratch.allocate(S * E)) {}

    // Readings of a marker at a position, their derivatives by it, and by the projected reading.
    LUMILINE_NOINLINE void predict_reading(const double* at, double* values, double (*by_axis)[3],
                                           double* by_projected) {
        Lanes p[V], g[3][V], corrected[V], by[3][V];
        cameras.project(at, p, g);
        if (table.exists()) table.correction(at, corrected, by);
        for (int s = 0; s < S; ++s) {
            auto of = [&](const Lanes* row) -> double { return ((const double*)row)[s]; };
            double gain = 1.0, reading = of(p);
            if (cameras.cubic[s] != 0.0)
                reading = invert_cubic(reading, cameras.principal_point[s], cameras.cubic[s], gain);
            values[s] = reading;
            by_projected[s] = gain;
            for (int axis = 0; axis < 3; ++axis) by_axis[s][axis] = gain * of(g[axis]);
            if (!table.exists()) continue;
            values[s] -= of(corrected);
            for (int axis = 0; axis < 3; ++axis) by_axis[s][axis] -= of(by[axis]);
        }
    }

    // The position of the marker that is lit in a pose.
    LUMILINE_FN void place_marker(const double* rotation, const double* centroid, double* at) {
        const double* marker = step.markers + 3 * step.lit;
        for (int i = 0; i < 3; ++i) {
            const double* r = rotation + 3 * i;
            arm[i] = r[0] * marker[0] + r[1] * marker[1] + r[2] * marker[2];
            at[i] = arm[i] + centroid[i];
        }
    }

    // Adds what the curvature does to values and to their covariance:
    // compute.pose.filtering.second_order. False: the covariance has no Cholesky root.
    LUMILINE_FN bool add_curvature(const double* pose, const double* covariance) {
        double root[6][6], even[6][S], shift[S], side[2][S], derivative[S][3], unused[S];
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j <= i; ++j) {
                double rest = covariance[i * W + j] + (i == j ? 1e-18 : 0.0);
                for (int k = 0; k < j; ++k) rest -= root[i][k] * root[j][k];
                if (i == j && !(rest > 0.0)) return false;
                root[i][j] = i == j ? sqrt(rest) : rest / root[j][j];
            }
        for (int s = 0; s < S; ++s) shift[s] = 0.0;
        for (int axis = 0; axis < 6; ++axis) {
            for (int sign = 0; sign < 2; ++sign) {
                double off[6], by[9], rotation[9], centroid[3], at[3];
                for (int i = 0; i < 6; ++i)
                    off[i] = i < axis
                                 ? 0.0
                                 : (sign ? -sigma_point_reach : sigma_point_reach) * root[i][axis];
                rotation_matrix(off, by);
                rotate(by, pose, rotation);
                for (int i = 0; i < 3; ++i) centroid[i] = pose[9 + i] + off[3 + i];
                place_marker(rotation, centroid, at);
                predict_reading(at, side[sign], derivative, unused);
            }
            for (int s = 0; s < S; ++s) {
                even[axis][s] = 0.5 * (side[0][s] + side[1][s]) - value[s];
                shift[s] += even[axis][s] / 6.0;
            }
        }
        bool all = true;
        for (int s = 0; s < S; ++s) all = all && shift[s] - shift[s] == 0.0;
        for (int s = 0; s < S; ++s) {
            // Part of where it may be lies behind a lens: nothing can be said of any reading.
            value[s] = all ? value[s] + shift[s] : not_a_number();
            for (int t = 0; t < S; ++t)
                for (int axis = 0; axis < 6; ++axis)
                    curvature[s][t] += even[axis][s] * even[axis][t] / 6.0;
        }
        return true;
    }

    // What all sensors are expected to read in a pose.
    LUMILINE_FN void predict_marker(const double* pose) {
        place_marker(pose, pose + 9, position);
        predict_reading(position, value, by_position, gains);
        double variance[S];
        if (table.exists()) {
            bool all[S];
            double ones[S];
            for (int s = 0; s < S; ++s) {
                all[s] = true;
                ones[s] = 1.0;
                variance[s] = 0.0;
            }
            table.add_variance(position, all, ones, variance);
        }
        for (int s = 0; s < S; ++s) {
            const double* derivative = by_position[s];
            for (int t = 0; t < S; ++t) curvature[s][t] = 0.0;
            for (int axis = 0; axis < 3; ++axis) jacobian[s][3 + axis] = derivative[axis];
            jacobian[s][0] = arm[1] * derivative[2] - arm[2] * derivative[1];
            jacobian[s][1] = arm[2] * derivative[0] - arm[0] * derivative[2];
            jacobian[s][2] = arm[0] * derivative[1] - arm[1] * derivative[0];
            double* common = by_common + s * E;
            zero(E, common);
            const int calibration_errors = (int)step.calibration_errors;
            if (calibration_errors > 0) {
                double by_parameter[Cameras<S, TERMS>::parameter_capacity];
                cameras.parameter_jacobian(s, position, by_parameter);
                for (int i = 0; i < cameras.parameters; ++i)
                    add(calibration_errors, gains[s] * by_parameter[i],
                        step.columns + (s * cameras.parameters + i) * calibration_errors, common);
            }
            if (E > calibration_errors)
                common[calibration_errors + step.lit * S + s] = sqrt(variance[s]);
        }
    }
};

}  // namespace lumiline::pose
