"""Native source: projections by all sensors, their slopes, and their covariance."""

from typing import Final

CAMERAS: Final = """
    const double* camera = job.cameras;
    const int terms = ROOM > 0 ? (int)job.terms : 0, top_power = (int)job.top_power;
    const double *principal_distance = camera, *principal_point = camera + R;
    const double *rotation = camera + 2 * R, *offset = camera + 11 * R;
    const double *cubic = camera + 14 * R, *row_behind = camera + 15 * R;
    const Lanes nans = nan + Lanes{};
    auto along = [&](int axis, int s, const double* x) -> double {
        const double* r = rotation + 3 * axis * R + s;
        return r[0] * x[0] + r[R] * x[1] + r[2 * R] * x[2];
    };
    auto lanes = [&](const double* row, int v) -> Lanes { return ((const Lanes*)row)[v]; };
    // Readings p of a point x[3] and their slopes g[3][V]; nan at and behind a lens.
    auto project = [&](const double* x, Lanes* p, Lanes (*g)[V]) {
        for (int v = 0; v < V; ++v) {
            auto framed = [&](int axis) -> Lanes {
                const double* r = rotation + 3 * axis * R;
                return lanes(r, v) * x[0] + lanes(r + R, v) * x[1] + lanes(r + 2 * R, v) * x[2]
                    + lanes(offset + axis * R, v);
            };
            const Lanes z = framed(2);
            const Lanes depth = z > 0.0 ? z : nans, near = 1.0 / depth;
            const Lanes u = framed(0) * near;
            Lanes angle = u, by_u = 1.0 + Lanes{}, by_v = Lanes{}, w = Lanes{}, to_row = Lanes{};
            if (ROOM > 0) {
                to_row = 1.0 / (depth + lanes(row_behind, v));
                w = framed(1) * to_row;
                Lanes u_to[powers_room], w_to[powers_room];
                u_to[0] = w_to[0] = 1.0 + Lanes{};
                for (int power = 1; power <= top_power; ++power) {
                    u_to[power] = u_to[power - 1] * u;
                    w_to[power] = w_to[power - 1] * w;
                }
                for (int k = 0; k < terms; ++k) {
                    const int a = job.powers[2 * k], b = job.powers[2 * k + 1];
                    const Lanes coefficient = lanes(job.coefficients + k * R, v);
                    const Lanes by_a = coefficient * w_to[b];
                    angle += by_a * u_to[a];
                    by_u += by_a * (double(a) * u_to[a > 0 ? a - 1 : 0]);
                    by_v += coefficient * u_to[a] * (double(b) * w_to[b > 0 ? b - 1 : 0]);
                }
            }
            const Lanes c = lanes(principal_distance, v);
            const Lanes by_x = c * near * by_u;
            Lanes by_y = Lanes{}, by_z = -u * by_x;
            if (ROOM > 0) {
                by_y = c * to_row * by_v;
                by_z -= w * by_y;
            }
            p[v] = lanes(principal_point, v) + c * angle;
            for (int axis = 0; axis < 3; ++axis) {
                const double* r = rotation + axis * R;
                g[axis][v] = by_x * lanes(r, v) + by_z * lanes(r + 6 * R, v);
                if (ROOM > 0) g[axis][v] += by_y * lanes(r + 3 * R, v);
            }
        }
    };
    // d reading / d parameters of one sensor, in the order of CameraStack; 0 behind its lens.
    const int width = ROOM > 0 ? 8 + terms : 7, width_room = ROOM > 0 ? 8 + ROOM : 7;
    auto by_parameters = [&](int s, const double* x, double* jacobian) {
        const double a = along(0, s, x), b = along(1, s, x), d = along(2, s, x);
        const double depth = d + offset[2 * R + s], c = principal_distance[s];
        if (!(depth > 0.0)) {
            for (int i = 0; i < width; ++i) jacobian[i] = 0.0;
            return;
        }
        const double u = (a + offset[s]) / depth;
        double angle = u, by_x = c / depth, by_y = 0.0, by_z = -u * by_x;
        if (ROOM > 0) {
            const double to_row = depth + row_behind[s], v = (b + offset[R + s]) / to_row;
            double u_to[powers_room], v_to[powers_room], by_u = 1.0, by_v = 0.0;
            u_to[0] = v_to[0] = 1.0;
            for (int power = 1; power <= top_power; ++power) {
                u_to[power] = u_to[power - 1] * u;
                v_to[power] = v_to[power - 1] * v;
            }
            for (int k = 0; k < terms; ++k) {
                const int i = job.powers[2 * k], j = job.powers[2 * k + 1];
                const double coefficient = job.coefficients[k * R + s];
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
