"""Native source: what the sensors are expected to read of the marker that is lit."""

from typing import Final

# As ReadingModel.full and pose_filter.innovations: values, slopes by turn and place, slopes by the
# common errors, of all sensors; nan behind a lens.
READINGS: Final = """
    double value[S], slopes[S][6], arm[3], place[3];
    double* by_common = room(S * E);
    auto expect = [&](const double* pose) {
        const double* marker = step.markers + 3 * step.lit;
        for (int i = 0; i < 3; ++i) {
            const double* r = pose + 3 * i;
            arm[i] = r[0] * marker[0] + r[1] * marker[1] + r[2] * marker[2];
            place[i] = arm[i] + pose[9 + i];
        }
        Lanes p[V], g[3][V], corrected[V], by[3][V];
        project(place, p, g);
        double variance[S];
        if (job.degree != 0) {
            correction(place, corrected, by);
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
            auto of = [&](Lanes* row) -> double { return ((const double*)row)[s]; };
            double gain = 1.0, slope[3];
            value[s] = of(p);
            if (cubic[s] != 0.0) {
                // p + D (p - p0)^3 as projected, [5.12].
                double reading = value[s];
                for (int turn = 0; turn < 4; ++turn) {
                    const double apart = reading - principal_point[s];
                    const double bend = cubic[s] * apart * apart;
                    reading -= (reading + bend * apart - value[s]) / (1.0 + 3.0 * bend);
                }
                const double apart = reading - principal_point[s];
                gain = 1.0 / (1.0 + 3.0 * cubic[s] * apart * apart);
                value[s] = reading;
            }
            for (int axis = 0; axis < 3; ++axis) slope[axis] = gain * of(g[axis]);
            if (job.degree != 0) {
                value[s] -= of(corrected);
                for (int axis = 0; axis < 3; ++axis) slope[axis] -= of(by[axis]);
            }
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
                    add(own, gain * jacobian[i], step.columns + (s * width + i) * own, common);
            }
            if (E > own) common[own + step.lit * S + s] = sqrt(variance[s]);
        }
    };
"""
