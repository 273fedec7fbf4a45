// Vectors of three and rotation matrices.
#pragma once

#include "compute/native/platform.h"

namespace lumiline::tracing {

struct Vector {
    double x, y, z;
};

LUMILINE_FN double dot(const Vector& a, const Vector& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

LUMILINE_FN Vector along(const Vector& o, double t, const Vector& d) {
    return Vector{o.x + t * d.x, o.y + t * d.y, o.z + t * d.z};
}

LUMILINE_FN Vector rotate(const double (&m)[3][3], const Vector& v) {
    return Vector{m[0][0] * v.x + m[0][1] * v.y + m[0][2] * v.z,
                  m[1][0] * v.x + m[1][1] * v.y + m[1][2] * v.z,
                  m[2][0] * v.x + m[2][1] * v.y + m[2][2] * v.z};
}

LUMILINE_FN Vector rotate_back(const double (&m)[3][3], const Vector& v) {
    return Vector{m[0][0] * v.x + m[1][0] * v.y + m[2][0] * v.z,
                  m[0][1] * v.x + m[1][1] * v.y + m[2][1] * v.z,
                  m[0][2] * v.x + m[1][2] * v.y + m[2][2] * v.z};
}

}  // namespace lumiline::tracing
