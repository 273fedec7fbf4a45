// Where a ray meets a quadric or a toroid: the operations of compute.optics.tracing.intersection in
// the same order, so that without fused multiply-adds both give the same numbers.
#pragma once

#include "compute/native/platform.h"
#include "compute/optics/tracing/native/definitions.gen.h"
#include "compute/optics/tracing/native/vectors.h"

namespace lumiline::tracing {

// Distance along the ray o + t d of its first crossing with a quadric, not below `t_min`; nan:
// none.
LUMILINE_FN double intersect_quadric(const Surface& s, const Vector& o, const Vector& d,
                                     double t_min) {
    const double a = s.cx * d.x * d.x + s.cy * d.y * d.y + s.e * d.z * d.z;
    const double b = s.cx * o.x * d.x + s.cy * o.y * d.y + (s.e * o.z - 1.0) * d.z;
    const double g = s.cx * o.x * o.x + s.cy * o.y * o.y + (s.e * o.z - 2.0) * o.z;
    const double root = sqrt(b * b - a * g);
    const double q = b < 0.0 ? root - b : -(root + b);
    const double one = g / q, two = q / a;
    const double first = one < two ? one : two, second = one < two ? two : one;
    if (first >= t_min && first < infinity() && 1.0 - s.e * (o.z + first * d.z) >= 0.0)
        return first;
    if (second >= t_min && second < infinity() && 1.0 - s.e * (o.z + second * d.z) >= 0.0)
        return second;
    return not_a_number();
}

// Height over a toroid along a ray, and what its two terms change by.
struct Height {
    double h, g_slope, f_slope;
};

LUMILINE_FN Height height(const Surface& s, const Vector& o, const Vector& d, double t) {
    const Vector v = along(o, t, d);
    const double p = 1.0 - s.cy * v.z, q = s.cy * v.y;
    const double r = sqrt(p * p + q * q);
    const double g = (2.0 * v.z - s.cy * (v.z * v.z + v.y * v.y)) / (1.0 + r);
    const double g_slope = ((1.0 - s.cy * v.z) * d.z - s.cy * v.y * d.y) / r;
    const double square = 1.0 - s.e * s.cx * v.x * v.x;
    const double w = sqrt(square > 0.0 ? square : 0.0);
    return Height{g - s.cx * v.x * v.x / (1.0 + w), g_slope, s.cx * v.x * d.x / w};
}

// Newton's method between two points on either side of a toroid.
LUMILINE_FN double refine_crossing(const Surface& s, const Vector& o, const Vector& d, double low,
                                   double high, bool low_negative) {
    const double close = s.radius_mm * convergence_fraction;
    double t = 0.5 * (low + high);
    for (int step = 0; step < max_steps; ++step) {
        const Height at = height(s, o, d, t);
        if ((at.h <= 0.0) == low_negative)
            low = t;
        else
            high = t;
        const double next = t - at.h / (at.g_slope - at.f_slope);
        const bool inside = next >= low && next <= high;
        const double moved = inside ? fabs(next - t) : high - low;
        t = inside ? next : 0.5 * (low + high);
        if (moved <= close + rounding * fabs(t)) break;
    }
    return t;
}

// As intersect_quadric for a toroid: intervals are halved until each has one crossing or none.
LUMILINE_FN double intersect_toroid(const Surface& s, const Vector& o, const Vector& d,
                                    double t_min) {
    double low = t_min > -s.reach_mm ? t_min : -s.reach_mm, high = s.reach_mm;
    if (s.profile_reach_mm < infinity()) {
        const double one = (-s.profile_reach_mm - o.x) / d.x,
                     two = (s.profile_reach_mm - o.x) / d.x;
        low = larger(low, smaller(one, two));
        high = smaller(high, larger(one, two));
    }
    const double at = 1.0 - s.cy * o.z, slope = s.cy * d.z, end = at / slope;
    if (slope > 0.0) high = smaller(high, end);
    if (slope < 0.0) low = larger(low, end);
    if (slope == 0.0 && at < 0.0) return not_a_number();
    if (!(low < high)) return not_a_number();
    const double finest = s.radius_mm * min_interval_fraction;
    double width = high - low;
    Height a = height(s, o, d, low);
    for (int interval = 0; interval < max_intervals; ++interval) {
        const double right = low + width < high ? low + width : high;
        const Height b = height(s, o, d, right);
        const double steepest = larger(a.g_slope, b.g_slope) - smaller(a.f_slope, b.f_slope);
        const double flattest = smaller(a.g_slope, b.g_slope) - larger(a.f_slope, b.f_slope);
        const bool sure =
            flattest >= 0.0 || steepest <= 0.0 || width <= finest + rounding * fabs(low);
        const bool negative = a.h <= 0.0;
        bool clear = false;
        if (negative != (b.h <= 0.0)) {
            if (sure) return refine_crossing(s, o, d, low, right, negative);
        } else {
            const double span = right - low;
            const double top =
                a.h + steepest * ((b.h - a.h - flattest * span) / (steepest - flattest));
            const double bottom =
                a.h + flattest * ((b.h - a.h - steepest * span) / (flattest - steepest));
            clear = sure || (negative ? top < 0.0 : bottom > 0.0);
        }
        if (clear && right >= high) return not_a_number();
        if (clear) {
            low = right;
            a = b;
        }
        width = clear ? 2.0 * width : 0.5 * width;
    }
    return not_a_number();
}

// The unit normal at a point on a curved surface, towards +z at the vertex.
template <bool has_toroids>
LUMILINE_FN Vector surface_normal(const Surface& s, const Vector& v) {
    Vector n;
    if (!has_toroids || s.form == form_quadric) {
        n = Vector{-(s.cx * v.x), -(s.cy * v.y), 1.0 - s.e * v.z};
    } else {
        const double p = 1.0 - s.cy * v.z, q = s.cy * v.y;
        const double r = sqrt(p * p + q * q);
        const double g = (2.0 * v.z - s.cy * (v.z * v.z + v.y * v.y)) / (1.0 + r);
        const double depth = (1.0 - s.e * g) / r;
        n = Vector{-(s.cx * v.x), -(depth * (s.cy * v.y)), depth * (1.0 - s.cy * v.z)};
    }
    const double scale = 1.0 / sqrt(dot(n, n));
    return Vector{n.x * scale, n.y * scale, n.z * scale};
}

}  // namespace lumiline::tracing
