"""Native source: projections by all sensors, their slopes, and their covariance."""

from typing import Final

# Loops over sensors are innermost on the CPU, where the compiler makes vectors of them. CUDA takes
# one sensor after another: its powers of u and v stay small.
CAMERAS: Final = """
#if defined(__CUDA_ARCH__)
    const int group = 1;
#else
    const int group = S;
#endif
    const double* camera = job.cameras;
    const int terms = ROOM > 0 ? (int)job.terms : 0, top_power = (int)job.top_power;
    const double *principal_distance = camera, *principal_point = camera + S;
    const double *rotation = camera + 2 * S, *offset = camera + 11 * S;
    const double *cubic = camera + 14 * S, *row_behind = camera + 15 * S;
    auto along = [&](int axis, int s, const double* x) -> double {
        const double* r = rotation + 3 * axis * S + s;
        return r[0] * x[0] + r[S] * x[1] + r[2 * S] * x[2];
    };
    // Readings p[S] of a point x[3] and their slopes g[3][S]; nan at and behind a lens.
    auto project = [&](const double* x, double* p, double (*g)[S]) {
        for (int first = 0; first < S; first += group) {
            double u[group], v[group], depth[group], to_row[group];
            double angle[group], by_u[group], by_v[group];
            for (int i = 0; i < group; ++i) {
                const int s = first + i;
                const double z = along(2, s, x) + offset[2 * S + s];
                depth[i] = z > 0.0 ? z : nan;
                u[i] = (along(0, s, x) + offset[s]) / depth[i];
                angle[i] = u[i];
                by_u[i] = 1.0;
                by_v[i] = 0.0;
            }
            if (ROOM > 0) {
                double u_to[powers_room][group], v_to[powers_room][group];
                for (int i = 0; i < group; ++i) {
                    const int s = first + i;
                    to_row[i] = depth[i] + row_behind[s];
                    v[i] = (along(1, s, x) + offset[S + s]) / to_row[i];
                    u_to[0][i] = v_to[0][i] = 1.0;
                }
                for (int power = 1; power <= top_power; ++power)
                    for (int i = 0; i < group; ++i) {
                        u_to[power][i] = u_to[power - 1][i] * u[i];
                        v_to[power][i] = v_to[power - 1][i] * v[i];
                    }
                for (int k = 0; k < terms; ++k) {
                    const int a = job.powers[2 * k], b = job.powers[2 * k + 1];
                    const int a_less = a > 0 ? a - 1 : 0, b_less = b > 0 ? b - 1 : 0;
                    const double *coefficient = job.coefficients + k * S + first;
                    for (int i = 0; i < group; ++i) {
                        const double by_a = coefficient[i] * v_to[b][i];
                        const double by_b = coefficient[i] * u_to[a][i];
                        angle[i] += by_a * u_to[a][i];
                        by_u[i] += by_a * (a * u_to[a_less][i]);
                        by_v[i] += by_b * (b * v_to[b_less][i]);
                    }
                }
            }
            for (int i = 0; i < group; ++i) {
                const int s = first + i;
                const double c = principal_distance[s];
                const double by_x = c / depth[i] * by_u[i];
                double by_y = 0.0, by_z = -u[i] * by_x;
                if (ROOM > 0) {
                    by_y = c / to_row[i] * by_v[i];
                    by_z -= v[i] * by_y;
                }
                p[s] = principal_point[s] + c * angle[i];
                for (int axis = 0; axis < 3; ++axis) {
                    const double* r = rotation + axis * S + s;
                    g[axis][s] = by_x * r[0] + by_z * r[6 * S];
                    if (ROOM > 0) g[axis][s] += by_y * r[3 * S];
                }
            }
        }
    };
    // d reading / d parameters of one sensor, in the order of CameraStack; 0 behind its lens.
    const int width = ROOM > 0 ? 8 + terms : 7, width_room = ROOM > 0 ? 8 + ROOM : 7;
    auto by_parameters = [&](int s, const double* x, double* jacobian) {
        const double a = along(0, s, x), b = along(1, s, x), d = along(2, s, x);
        const double depth = d + offset[2 * S + s], c = principal_distance[s];
        if (!(depth > 0.0)) {
            for (int i = 0; i < width; ++i) jacobian[i] = 0.0;
            return;
        }
        const double u = (a + offset[s]) / depth;
        double angle = u, by_x = c / depth, by_y = 0.0, by_z = -u * by_x;
        if (ROOM > 0) {
            const double to_row = depth + row_behind[s], v = (b + offset[S + s]) / to_row;
            double u_to[powers_room], v_to[powers_room], by_u = 1.0, by_v = 0.0;
            u_to[0] = v_to[0] = 1.0;
            for (int power = 1; power <= top_power; ++power) {
                u_to[power] = u_to[power - 1] * u;
                v_to[power] = v_to[power - 1] * v;
            }
            for (int k = 0; k < terms; ++k) {
                const int i = job.powers[2 * k], j = job.powers[2 * k + 1];
                const double coefficient = job.coefficients[k * S + s];
                const double value = u_to[i] * v_to[j];
                angle += coefficient * value;
                by_u += coefficient * (i * u_to[i > 0 ? i - 1 : 0] * v_to[j]);
                by_v += coefficient * (j * u_to[i] * v_to[j > 0 ? j - 1 : 0]);
                jacobian[8 + k] = c * value;
            }
            by_x = c / depth * by_u;
            by_y = c / to_row * by_v;
            by_z = -(u * by_x + v * by_y);
            jacobian[7] = by_y;
        }
        jacobian[0] = angle;
        jacobian[1] = 1.0;
        jacobian[2] = b * by_z - d * by_y;
        jacobian[3] = d * by_x - a * by_z;
        jacobian[4] = a * by_y - b * by_x;
        jacobian[5] = by_x;
        jacobian[6] = by_z;
    };
    // Adds J P J' of the cameras' parameters to the lower triangle of spread[S][S].
    auto add_parameters = [&](const double* x, const bool* used, double (*spread)[S]) {
        double jacobian[S][width_room];
        for (int s = 0; s < S; ++s) {
            if (used[s]) by_parameters(s, x, jacobian[s]);
            else for (int i = 0; i < width; ++i) jacobian[s][i] = 0.0;
        }
        const int all = S * width;
        for (int s = 0; s < S; ++s) {
            if (!used[s]) continue;
            const double* block = job.parameters + (long long)s * width * all;
#if defined(__CUDA_ARCH__)
            for (int t = 0; t <= s; ++t)
                for (int j = 0; j < width; ++j) {
                    double sum = 0.0;
                    for (int i = 0; i < width; ++i)
                        sum += jacobian[s][i] * block[i * all + t * width + j];
                    spread[s][t] += sum * jacobian[t][j];
                }
#else
            double sums[S * width_room];
            const int columns = (s + 1) * width;
            for (int j = 0; j < columns; ++j) sums[j] = jacobian[s][0] * block[j];
            for (int i = 1; i < width; ++i)
                for (int j = 0; j < columns; ++j) sums[j] += jacobian[s][i] * block[i * all + j];
            for (int t = 0; t <= s; ++t)
                for (int j = 0; j < width; ++j)
                    spread[s][t] += sums[t * width + j] * jacobian[t][j];
#endif
        }
    };
"""
