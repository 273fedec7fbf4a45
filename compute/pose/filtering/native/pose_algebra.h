// Vector sums and rotations: compute.transform.
#pragma once

#include "compute/native/platform.h"
#include "compute/pose/filtering/native/definitions.gen.h"

namespace lumiline::pose {

LUMILINE_NOINLINE void add(int count, double factor, const double* __restrict__ from,
                           double* __restrict__ to) {
    for (int i = 0; i < count; ++i) to[i] += factor * from[i];
}

LUMILINE_NOINLINE void copy(int count, const double* __restrict__ from, double* __restrict__ to) {
    for (int i = 0; i < count; ++i) to[i] = from[i];
}

LUMILINE_NOINLINE void zero(int count, double* to) {
    for (int i = 0; i < count; ++i) to[i] = 0.0;
}

// The rotation by a rotation vector.
LUMILINE_NOINLINE void rotation_matrix(const double* w, double* r) {
    const double x = w[0], y = w[1], z = w[2];
    const double square = x * x + y * y + z * z, angle = sqrt(square);
    double first = 1.0 - square / 6.0, second = 0.5 - square / 24.0;
    if (angle >= 1e-4) {
        const double half = sin(0.5 * angle) / angle;
        first = sin(angle) / angle;
        second = 2.0 * half * half;
    }
    const double diagonal = 1.0 - second * square;
    const double xy = second * x * y, xz = second * x * z, yz = second * y * z;
    r[0] = diagonal + second * x * x;
    r[1] = xy - first * z;
    r[2] = xz + first * y;
    r[3] = xy + first * z;
    r[4] = diagonal + second * y * y;
    r[5] = yz - first * x;
    r[6] = xz - first * y;
    r[7] = yz + first * x;
    r[8] = diagonal + second * z * z;
}

// The product of two rotations; `to` may be `from`.
LUMILINE_FN void rotate(const double* by, const double* from, double* to) {
    double rotation[9];
    for (int i = 0; i < 9; ++i) rotation[i] = from[i];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            to[3 * i + j] = by[3 * i] * rotation[j] + by[3 * i + 1] * rotation[3 + j]
                            + by[3 * i + 2] * rotation[6 + j];
}

// A pose after a step: rotation, centroid, velocity, angular velocity.
LUMILINE_FN void retract(const double* from, const double* off, double* to) {
    double by[9];
    rotation_matrix(off, by);
    rotate(by, from, to);
    for (int i = 0; i < 9; ++i) to[9 + i] = from[9 + i] + off[3 + i];
}

// States after a time h, in each column.
LUMILINE_FN void propagate(int columns, double h, const double* rotation, double* x) {
    const double half = 0.5 * h * h;
    for (int c = 0; c < columns; ++c) {
        const double a = x[c], b = x[columns + c], d = x[2 * columns + c];
        for (int i = 0; i < 3; ++i)
            x[i * columns + c] =
                rotation[3 * i] * a + rotation[3 * i + 1] * b + rotation[3 * i + 2] * d;
    }
    auto row = [&](int to, int from, double factor) {
        add(3 * columns, factor, x + from * columns, x + to * columns);
    };
    row(0, 9, h);
    row(0, 15, half);
    row(3, 6, h);
    row(3, 12, half);
    row(6, 12, h);
    row(9, 15, h);
}

}  // namespace lumiline::pose
