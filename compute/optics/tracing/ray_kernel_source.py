"""The native source of the ray kernel: one ray through all surfaces, in C++ for the CPU and CUDA.

The same operations in the same order as ``intersection`` and ``trace``, which explain them: with
no fused multiply-adds all three give the same numbers. It is native, because a surface is one
record that all threads read from the same place, and the branches on its form stay branches.

There are two of it: without toroids a thread takes fewer registers, and CUDA runs more of them.

The arguments are those of ``compute.optics.tracing.ray_kernel``.
"""

from typing import Final

from compute.optics.tracing.intersection import (
    CLOSE,
    FINEST,
    MAX_INTERVALS,
    MAX_STEPS,
    ROUNDING,
)
from compute.optics.tracing.reference_tracer import MIN_SQUARE
from compute.optics.tracing.surface_records import BACKWARD_SLACK_MM, Form
from compute.optics.tracing.traced_rays import RayStatus

_TYPES = f"""
    struct Record {{
        int form, turned, refracts, elliptical;
        double vertex[3], rotation[9];
        double cx, cy, e, before, behind, ratio;
        double half_width, half_height, profile_reach, reach, radius;
    }};
    struct Vector {{ double x, y, z; }};
    struct Height {{ double h, g_slope, f_slope; }};
    const int plane = {Form.PLANE:d}, quadric = {Form.QUADRIC:d};
    const int missed = {RayStatus.MISSED:d}, stopped = {RayStatus.STOPPED:d};
    const int totally_reflected = {RayStatus.TOTALLY_REFLECTED:d};
    const int max_intervals = {MAX_INTERVALS}, max_steps = {MAX_STEPS};
    const double min_square = {MIN_SQUARE!r};
    const double slack = {BACKWARD_SLACK_MM!r}, finest_share = {FINEST!r}, close_share = {CLOSE!r};
    const double rounding = {ROUNDING!r};
"""

_VECTORS = """
    const double infinity = 1.0 / 0.0, nan = infinity - infinity;
    auto dot = [](const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto along = [](const Vector& o, double t, const Vector& d) {
        return Vector{o.x + t * d.x, o.y + t * d.y, o.z + t * d.z};
    };
    auto turn = [](const double* m, const Vector& v) {
        return Vector{m[0] * v.x + m[1] * v.y + m[2] * v.z,
                      m[3] * v.x + m[4] * v.y + m[5] * v.z,
                      m[6] * v.x + m[7] * v.y + m[8] * v.z};
    };
    auto turn_back = [](const double* m, const Vector& v) {
        return Vector{m[0] * v.x + m[3] * v.y + m[6] * v.z,
                      m[1] * v.x + m[4] * v.y + m[7] * v.z,
                      m[2] * v.x + m[5] * v.y + m[8] * v.z};
    };
    auto larger = [](double a, double b) { return a > b ? a : b; };
    auto smaller = [](double a, double b) { return a < b ? a : b; };
"""

_QUADRIC = """
    auto meet_quadric = [&](const Record& s, const Vector& o, const Vector& d, double least) {
        const double a = s.cx * d.x * d.x + s.cy * d.y * d.y + s.e * d.z * d.z;
        const double b = s.cx * o.x * d.x + s.cy * o.y * d.y + (s.e * o.z - 1.0) * d.z;
        const double g = s.cx * o.x * o.x + s.cy * o.y * o.y + (s.e * o.z - 2.0) * o.z;
        const double root = sqrt(b * b - a * g);
        const double q = b < 0.0 ? root - b : -(root + b);
        const double one = g / q, two = q / a;
        const double first = one < two ? one : two, second = one < two ? two : one;
        if (first >= least && first < infinity && 1.0 - s.e * (o.z + first * d.z) >= 0.0)
            return first;
        if (second >= least && second < infinity && 1.0 - s.e * (o.z + second * d.z) >= 0.0)
            return second;
        return nan;
    };
"""

_TOROID = """
    auto height = [&](const Record& s, const Vector& o, const Vector& d, double t) {
        const Vector v = along(o, t, d);
        const double p = 1.0 - s.cy * v.z, q = s.cy * v.y;
        const double r = sqrt(p * p + q * q);
        const double g = (2.0 * v.z - s.cy * (v.z * v.z + v.y * v.y)) / (1.0 + r);
        const double g_slope = ((1.0 - s.cy * v.z) * d.z - s.cy * v.y * d.y) / r;
        const double square = 1.0 - s.e * s.cx * v.x * v.x;
        const double w = sqrt(square > 0.0 ? square : 0.0);
        return Height{g - s.cx * v.x * v.x / (1.0 + w), g_slope, s.cx * v.x * d.x / w};
    };
    auto newton = [&](const Record& s, const Vector& o, const Vector& d, double low, double high,
                      bool low_negative) {
        const double close = s.radius * close_share;
        double t = 0.5 * (low + high);
        for (int step = 0; step < max_steps; ++step) {
            const Height at = height(s, o, d, t);
            if ((at.h <= 0.0) == low_negative) low = t; else high = t;
            const double next = t - at.h / (at.g_slope - at.f_slope);
            const bool inside = next >= low && next <= high;
            const double moved = inside ? fabs(next - t) : high - low;
            t = inside ? next : 0.5 * (low + high);
            if (moved <= close + rounding * fabs(t)) break;
        }
        return t;
    };
    auto meet_toroid = [&](const Record& s, const Vector& o, const Vector& d, double least) {
        double low = least > -s.reach ? least : -s.reach, high = s.reach;
        if (s.profile_reach < infinity) {
            const double one = (-s.profile_reach - o.x) / d.x, two = (s.profile_reach - o.x) / d.x;
            low = larger(low, smaller(one, two));
            high = smaller(high, larger(one, two));
        }
        const double at = 1.0 - s.cy * o.z, slope = s.cy * d.z, end = at / slope;
        if (slope > 0.0) high = smaller(high, end);
        if (slope < 0.0) low = larger(low, end);
        if (slope == 0.0 && at < 0.0) return nan;
        if (!(low < high)) return nan;
        const double finest = s.radius * finest_share;
        double width = high - low;
        Height a = height(s, o, d, low);
        for (int interval = 0; interval < max_intervals; ++interval) {
            const double right = low + width < high ? low + width : high;
            const Height b = height(s, o, d, right);
            const double steepest = larger(a.g_slope, b.g_slope) - smaller(a.f_slope, b.f_slope);
            const double flattest = smaller(a.g_slope, b.g_slope) - larger(a.f_slope, b.f_slope);
            const bool sure = flattest >= 0.0 || steepest <= 0.0
                || width <= finest + rounding * fabs(low);
            const bool negative = a.h <= 0.0;
            bool clear = false;
            if (negative != (b.h <= 0.0)) {
                if (sure) return newton(s, o, d, low, right, negative);
            } else {
                const double span = right - low;
                const double top =
                    a.h + steepest * ((b.h - a.h - flattest * span) / (steepest - flattest));
                const double bottom =
                    a.h + flattest * ((b.h - a.h - steepest * span) / (flattest - steepest));
                clear = sure || (negative ? top < 0.0 : bottom > 0.0);
            }
            if (clear && right >= high) return nan;
            if (clear) { low = right; a = b; }
            width = clear ? 2.0 * width : 0.5 * width;
        }
        return nan;
    };
"""

_NORMAL = """
    auto normal = [&](const Record& s, const Vector& v) {
        Vector n;
        if (!toroids || s.form == quadric) {
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
    };
"""

_START = """
    const double* in = (const double*)rays_address + ray;
    double* out = (double*)results_address + ray;
    const Record* surfaces = (const Record*)surfaces_address;
    const unsigned long long n = (unsigned long long)rays;
    Vector o{in[0], in[n], in[2 * n]}, d{in[3 * n], in[4 * n], in[5 * n]};
    double square_length = dot(d, d);
    if (!(square_length > min_square && square_length < 1.0 / min_square)) {
        const double largest = larger(larger(fabs(d.x), fabs(d.y)), fabs(d.z));
        d = Vector{d.x / largest, d.y / largest, d.z / largest};
        square_length = dot(d, d);
    }
    const double unit = 1.0 / sqrt(square_length);
    d = Vector{d.x * unit, d.y * unit, d.z * unit};
    const double h = sqrt(d.y * d.y + d.z * d.z);
    const double across = 1.0 / h;
    const double u = h == 0.0 ? 1.0 : d.z * across, v = h == 0.0 ? 0.0 : -d.y * across;
    Vector first{h, v * d.x, -(u * d.x)}, second{0.0, u, v};
    double power = 1.0, path = 0.0;
    int lost = 0, number = 0;
    Vector place, local;
"""

_SURFACES = """
    for (;; ++number) {
        const Record& s = surfaces[number];
        Vector from{o.x - s.vertex[0], o.y - s.vertex[1], o.z - s.vertex[2]};
        local = d;
        if (s.turned) { from = turn_back(s.rotation, from); local = turn_back(s.rotation, d); }
        double distance;
        if (s.form == plane) {
            distance = -from.z / local.z;
            if (!(distance >= -slack && distance < infinity)) { lost = missed; break; }
            place = along(from, distance, local);
            place.z = 0.0;
        } else {
            const double shift = -dot(from, local);
            const Vector near = along(from, shift, local);
            const double least = -slack - shift;
            const double t = !toroids || s.form == quadric ? meet_quadric(s, near, local, least)
                                                           : meet_toroid(s, near, local, least);
            distance = shift + t;
            if (distance != distance) { lost = missed; break; }
            place = along(near, t, local);
        }
        path = path + s.before * distance;
        if (number == image) break;
        bool passes;
        if (s.elliptical) {
            const double a = place.x / s.half_width, b = place.y / s.half_height;
            passes = a * a + b * b <= 1.0;
        } else {
            passes = fabs(place.x) <= s.half_width && fabs(place.y) <= s.half_height;
        }
        if (!passes) { lost = stopped; break; }
        if (s.refracts) {
            Vector n_out;
            double cosine;
            if (s.form == plane) {
                cosine = local.z;
                n_out = Vector{s.rotation[2], s.rotation[5], s.rotation[8]};
            } else {
                n_out = normal(s, place);
                cosine = dot(local, n_out);
                if (s.turned) n_out = turn(s.rotation, n_out);
            }
            const double ratio = s.ratio, inner = fabs(cosine);
            const double square = 1.0 - ratio * ratio * (1.0 - inner * inner);
            if (square < 0.0) { lost = totally_reflected; break; }
            const double outer = sqrt(square);
            const double bend = cosine < 0.0 ? ratio * inner - outer : outer - ratio * inner;
            Vector next{ratio * d.x + bend * n_out.x, ratio * d.y + bend * n_out.y,
                        ratio * d.z + bend * n_out.z};
            const double scale = 1.5 - 0.5 * dot(next, next);
            next = Vector{next.x * scale, next.y * scale, next.z * scale};
            const double a = s.before * inner, b = s.behind * outer;
            power = power * (4.0 * a * b / ((a + b) * (a + b)));
            const double stretch = 1.0 / dot(d, next);
            first = along(first, -(dot(first, next) * stretch), d);
            second = along(second, -(dot(second, next) * stretch), d);
            d = next;
        }
        if (s.turned) place = turn(s.rotation, place);
        o = Vector{place.x + s.vertex[0], place.y + s.vertex[1], place.z + s.vertex[2]};
    }
"""

_END = """
    out[0] = lost ? nan : place.x;
    out[n] = lost ? nan : place.y;
    out[2 * n] = lost ? nan : local.x;
    out[3 * n] = lost ? nan : local.y;
    out[4 * n] = lost ? nan : local.z;
    out[5 * n] = lost ? nan : path;
    out[6 * n] = lost ? 0.0 : power * dot(first, first);
    out[7 * n] = lost ? 0.0 : power * dot(second, second);
    ((int*)((double*)results_address + 8 * n))[ray] = lost ? number * 4 + lost : 0;
"""

_TRACE_ONE_RAY = _TYPES + _VECTORS + _QUADRIC + _TOROID + _NORMAL + _START + _SURFACES + _END

WITH_TOROIDS: Final = "const bool toroids = true;" + _TRACE_ONE_RAY
WITHOUT_TOROIDS: Final = "const bool toroids = false;" + _TRACE_ONE_RAY
