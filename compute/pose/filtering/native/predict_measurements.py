"""Native source: what the sensors are expected to read of the marker that is lit."""

from typing import Final

# As MeasurementModel.full and pose_filter.innovations: values, slopes by turn and place, slopes by the
# common errors, of all sensors; nan behind a lens.
READINGS: Final = """
    double value[S], slopes[S][6], arm[3], place[3], gains[S], by_place[S][3];
    double* by_common = room(S * E);
    // Values at a place, their slopes by it, and those of a reading by what is projected.
    auto read = [&](const double* at, double* values, double (*by_axis)[3],
                    double* by_projected) __attribute__((noinline)) {
        Lanes p[V], g[3][V], corrected[V], by[3][V];
        project(at, p, g);
        if (job.degree != 0) correction(at, corrected, by);
        for (int s = 0; s < S; ++s) {
            auto of = [&](Lanes* row) -> double { return ((const double*)row)[s]; };
            double gain = 1.0, reading = of(p);
            if (cubic[s] != 0.0) {
                // p + D (p - p0)^3 as projected, [5.12].
                const double projected = reading;
                for (int turn = 0; turn < 4; ++turn) {
                    const double apart = reading - principal_point[s];
                    const double bend = cubic[s] * apart * apart;
                    reading -= (reading + bend * apart - projected) / (1.0 + 3.0 * bend);
                }
                const double apart = reading - principal_point[s];
                gain = 1.0 / (1.0 + 3.0 * cubic[s] * apart * apart);
            }
            values[s] = reading;
            by_projected[s] = gain;
            for (int axis = 0; axis < 3; ++axis) by_axis[s][axis] = gain * of(g[axis]);
            if (job.degree == 0) continue;
            values[s] -= of(corrected);
            for (int axis = 0; axis < 3; ++axis) by_axis[s][axis] -= of(by[axis]);
        }
    };
    auto stand = [&](const double* rotation, const double* middle, double* at) {
        const double* marker = step.markers + 3 * step.lit;
        for (int i = 0; i < 3; ++i) {
            const double* r = rotation + 3 * i;
            arm[i] = r[0] * marker[0] + r[1] * marker[1] + r[2] * marker[2];
            at[i] = arm[i] + middle[i];
        }
    };
    // What the curvature adds, as of compute.pose.filtering.second_order: to values, and to their covariance.
    double curvature[S][S];
    auto bend = [&](const double* pose, const double* spread) -> bool {
        double root[6][6], even[6][S], shift[S], side[2][S], slope[S][3], unused[S];
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j <= i; ++j) {
                double rest = spread[i * W + j] + (i == j ? 1e-18 : 0.0);
                for (int k = 0; k < j; ++k) rest -= root[i][k] * root[j][k];
                if (i == j && !(rest > 0.0)) return false;
                root[i][j] = i == j ? sqrt(rest) : rest / root[j][j];
            }
        for (int s = 0; s < S; ++s) shift[s] = 0.0;
        for (int axis = 0; axis < 6; ++axis) {
            for (int sign = 0; sign < 2; ++sign) {
                double off[6], by[9], rotation[9], middle[3], at[3];
                for (int i = 0; i < 6; ++i)
                    off[i] = i < axis ? 0.0 : (sign ? -reach : reach) * root[i][axis];
                rotation_of(off, by);
                turn(by, pose, rotation);
                for (int i = 0; i < 3; ++i) middle[i] = pose[9 + i] + off[3 + i];
                stand(rotation, middle, at);
                read(at, side[sign], slope, unused);
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
            value[s] = all ? value[s] + shift[s] : nan;
            for (int t = 0; t < S; ++t)
                for (int axis = 0; axis < 6; ++axis)
                    curvature[s][t] += even[axis][s] * even[axis][t] / 6.0;
        }
        return true;
    };
    auto expect = [&](const double* pose) {
        stand(pose, pose + 9, place);
        read(place, value, by_place, gains);
        double variance[S];
        if (job.degree != 0) {
            bool all[S];
            double ones[S];
            for (int s = 0; s < S; ++s) {
                all[s] = true;
                ones[s] = 1.0;
                variance[s] = 0.0;
            }
            add_table(place, all, ones, variance);
        }
        for (int s = 0; s < S; ++s) {
            const double* slope = by_place[s];
            for (int t = 0; t < S; ++t) curvature[s][t] = 0.0;
            for (int axis = 0; axis < 3; ++axis) slopes[s][3 + axis] = slope[axis];
            slopes[s][0] = arm[1] * slope[2] - arm[2] * slope[1];
            slopes[s][1] = arm[2] * slope[0] - arm[0] * slope[2];
            slopes[s][2] = arm[0] * slope[1] - arm[1] * slope[0];
            double* common = by_common + s * E;
            zero(E, common);
            const int own = (int)step.own_errors;
            if (own > 0) {
                double jacobian[width_room];
                by_parameters(s, place, jacobian);
                for (int i = 0; i < width; ++i)
                    add(own, gains[s] * jacobian[i], step.columns + (s * width + i) * own, common);
            }
            if (E > own) common[own + step.lit * S + s] = sqrt(variance[s]);
        }
    };
"""
