// Projections by all sensors, their derivatives, and their covariance from the calibration's.
#pragma once

#include "compute/native/platform.h"
#include "compute/reconstruction/native/definitions.gen.h"
#include "compute/reconstruction/native/lanes.h"

namespace lumiline {

// S sensors whose distortion has at most TERMS terms.
template <int S, int TERMS>
struct Cameras {
    static constexpr int V = vector_count<S>, R = row_length<S>;
    static constexpr int parameter_capacity = TERMS > 0 ? 8 + TERMS : 7;

    const CameraRecord& record;
    const double *principal_distance, *principal_point, *rotation, *offset, *cubic, *row_behind;
    const int terms, max_power, parameters;

    LUMILINE_FN explicit Cameras(const CameraRecord& from)
        : record(from),
          principal_distance(from.models),
          principal_point(from.models + R),
          rotation(from.models + 2 * R),
          offset(from.models + 11 * R),
          cubic(from.models + 14 * R),
          row_behind(from.models + 15 * R),
          terms(TERMS > 0 ? (int)from.terms : 0),
          max_power((int)from.max_power),
          parameters(TERMS > 0 ? 8 + terms : 7) {}

    LUMILINE_FN double along(int axis, int s, const double* x) const {
        const double* r = rotation + 3 * axis * R + s;
        return r[0] * x[0] + r[R] * x[1] + r[2 * R] * x[2];
    }

    // Readings p[V] of a point x[3] and their gradients g[3][V]; nan at and behind a lens.
    LUMILINE_FN void project(const double* x, Lanes* p, Lanes (*g)[V]) const {
        for (int v = 0; v < V; ++v) {
            auto framed = [&](int axis) -> Lanes {
                const double* r = rotation + 3 * axis * R;
                return lanes(r, v) * x[0] + lanes(r + R, v) * x[1] + lanes(r + 2 * R, v) * x[2]
                       + lanes(offset + axis * R, v);
            };
            const Lanes z = framed(2);
            const Lanes depth = z > 0.0 ? z : not_a_number() + Lanes{}, near = 1.0 / depth;
            const Lanes u = framed(0) * near;
            Lanes angle = u, du = 1.0 + Lanes{}, dv = Lanes{}, w = Lanes{}, to_row = Lanes{};
            if (TERMS > 0) {
                to_row = 1.0 / (depth + lanes(row_behind, v));
                w = framed(1) * to_row;
                Lanes u_to[power_capacity], w_to[power_capacity];
                u_to[0] = w_to[0] = 1.0 + Lanes{};
                for (int power = 1; power <= max_power; ++power) {
                    u_to[power] = u_to[power - 1] * u;
                    w_to[power] = w_to[power - 1] * w;
                }
                for (int k = 0; k < terms; ++k) {
                    const int a = record.powers[2 * k], b = record.powers[2 * k + 1];
                    const Lanes coefficient = lanes(record.coefficients + k * R, v);
                    const Lanes by_a = coefficient * w_to[b];
                    angle += by_a * u_to[a];
                    du += by_a * (double(a) * u_to[a > 0 ? a - 1 : 0]);
                    dv += coefficient * u_to[a] * (double(b) * w_to[b > 0 ? b - 1 : 0]);
                }
            }
            const Lanes c = lanes(principal_distance, v);
            const Lanes by_x = c * near * du;
            Lanes by_y = Lanes{}, by_z = -u * by_x;
            if (TERMS > 0) {
                by_y = c * to_row * dv;
                by_z -= w * by_y;
            }
            p[v] = lanes(principal_point, v) + c * angle;
            for (int axis = 0; axis < 3; ++axis) {
                const double* r = rotation + axis * R;
                g[axis][v] = by_x * lanes(r, v) + by_z * lanes(r + 6 * R, v);
                if (TERMS > 0) g[axis][v] += by_y * lanes(r + 3 * R, v);
            }
        }
    }

    // d reading / d parameters of one sensor, in the order of CameraStack; 0 behind its lens.
    LUMILINE_FN void parameter_jacobian(int s, const double* x, double* jacobian) const {
        const double a = along(0, s, x), b = along(1, s, x), d = along(2, s, x);
        const double depth = d + offset[2 * R + s], c = principal_distance[s];
        if (!(depth > 0.0)) {
            for (int i = 0; i < parameters; ++i) jacobian[i] = 0.0;
            return;
        }
        const double u = (a + offset[s]) / depth;
        double angle = u, by_x = c / depth, by_y = 0.0, by_z = -u * by_x;
        if (TERMS > 0) {
            const double to_row = depth + row_behind[s], v = (b + offset[R + s]) / to_row;
            double u_to[power_capacity], v_to[power_capacity], du = 1.0, dv = 0.0;
            u_to[0] = v_to[0] = 1.0;
            for (int power = 1; power <= max_power; ++power) {
                u_to[power] = u_to[power - 1] * u;
                v_to[power] = v_to[power - 1] * v;
            }
            for (int k = 0; k < terms; ++k) {
                const int i = record.powers[2 * k], j = record.powers[2 * k + 1];
                const double coefficient = record.coefficients[k * R + s];
                const double value = u_to[i] * v_to[j];
                angle += coefficient * value;
                du += coefficient * (i * u_to[i > 0 ? i - 1 : 0] * v_to[j]);
                dv += coefficient * (j * u_to[i] * v_to[j > 0 ? j - 1 : 0]);
                jacobian[8 + k] = c * value;
            }
            by_x = c / depth * du;
            by_y = c / to_row * dv;
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
    }

    // Adds J P J' of the cameras' parameters to the lower triangle of covariance_px2[S][S].
    LUMILINE_FN void add_parameter_covariance(const double* covariance, const double* x,
                                              const bool* used, double (*covariance_px2)[S]) const {
        double jacobian[S][parameter_capacity];
        for (int s = 0; s < S; ++s) {
            if (used[s])
                parameter_jacobian(s, x, jacobian[s]);
            else
                for (int i = 0; i < parameters; ++i) jacobian[s][i] = 0.0;
        }
        const int all = S * parameters;
        for (int s = 0; s < S; ++s) {
            if (!used[s]) continue;
            const double* block = covariance + (long long)s * parameters * all;
#if defined(__CUDA_ARCH__)
            for (int t = 0; t <= s; ++t)
                for (int j = 0; j < parameters; ++j) {
                    double sum = 0.0;
                    for (int i = 0; i < parameters; ++i)
                        sum += jacobian[s][i] * block[i * all + t * parameters + j];
                    covariance_px2[s][t] += sum * jacobian[t][j];
                }
#else
            double sums[S * parameter_capacity];
            const int columns = (s + 1) * parameters;
            for (int j = 0; j < columns; ++j) sums[j] = jacobian[s][0] * block[j];
            for (int i = 1; i < parameters; ++i)
                for (int j = 0; j < columns; ++j) sums[j] += jacobian[s][i] * block[i * all + j];
            for (int t = 0; t <= s; ++t)
                for (int j = 0; j < parameters; ++j)
                    covariance_px2[s][t] += sums[t * parameters + j] * jacobian[t][j];
#endif
        }
    }
};

}  // namespace lumiline
