// One ray through all surfaces: the operations of compute.optics.tracing.reference_tracer in the
// same order.
#pragma once

#include "compute/native/platform.h"
#include "compute/optics/tracing/native/definitions.gen.h"
#include "compute/optics/tracing/native/intersection.h"
#include "compute/optics/tracing/native/vectors.h"

namespace lumiline::tracing {

// Traces ray number `ray` of `rays`. Without toroids a thread takes fewer registers, and CUDA runs
// more of them. The arguments are those of compute.optics.tracing.ray_kernel.
template <bool has_toroids>
LUMILINE_FN void trace_ray(int ray, int rays, unsigned long long rays_address,
                           unsigned long long surfaces_address, int image,
                           unsigned long long results_address) {
    const double* in = (const double*)rays_address + ray;
    double* out = (double*)results_address + ray;
    const Surface* surfaces = (const Surface*)surfaces_address;
    const unsigned long long n = (unsigned long long)rays;
    Vector o{in[0], in[n], in[2 * n]}, d{in[3 * n], in[4 * n], in[5 * n]};
    double square_length = dot(d, d);
    if (!(square_length > min_squared_length && square_length < 1.0 / min_squared_length)) {
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
    Vector point, local;

    for (;; ++number) {
        const Surface& s = surfaces[number];
        Vector from{o.x - s.vertex_mm[0], o.y - s.vertex_mm[1], o.z - s.vertex_mm[2]};
        local = d;
        if (s.is_rotated) {
            from = rotate_back(s.rotation, from);
            local = rotate_back(s.rotation, d);
        }
        double distance;
        if (s.form == form_plane) {
            distance = -from.z / local.z;
            if (!(distance >= -backward_slack_mm && distance < infinity())) {
                lost = status_missed;
                break;
            }
            point = along(from, distance, local);
            point.z = 0.0;
        } else {
            const double shift = -dot(from, local);
            const Vector near = along(from, shift, local);
            const double t_min = -backward_slack_mm - shift;
            const double t = !has_toroids || s.form == form_quadric
                                 ? intersect_quadric(s, near, local, t_min)
                                 : intersect_toroid(s, near, local, t_min);
            distance = shift + t;
            if (distance != distance) {
                lost = status_missed;
                break;
            }
            point = along(near, t, local);
        }
        path = path + s.index_before * distance;
        if (number == image) break;
        bool passes;
        if (s.elliptical) {
            const double a = point.x / s.half_width_mm, b = point.y / s.half_height_mm;
            passes = a * a + b * b <= 1.0;
        } else {
            passes = fabs(point.x) <= s.half_width_mm && fabs(point.y) <= s.half_height_mm;
        }
        if (!passes) {
            lost = status_stopped;
            break;
        }
        if (s.refracts) {
            Vector n_out;
            double cosine;
            if (s.form == form_plane) {
                cosine = local.z;
                n_out = Vector{s.rotation[0][2], s.rotation[1][2], s.rotation[2][2]};
            } else {
                n_out = surface_normal<has_toroids>(s, point);
                cosine = dot(local, n_out);
                if (s.is_rotated) n_out = rotate(s.rotation, n_out);
            }
            const double ratio = s.ratio, inner = fabs(cosine);
            const double square = 1.0 - ratio * ratio * (1.0 - inner * inner);
            if (square < 0.0) {
                lost = status_totally_reflected;
                break;
            }
            const double outer = sqrt(square);
            const double bend = cosine < 0.0 ? ratio * inner - outer : outer - ratio * inner;
            Vector next{ratio * d.x + bend * n_out.x, ratio * d.y + bend * n_out.y,
                        ratio * d.z + bend * n_out.z};
            const double scale = 1.5 - 0.5 * dot(next, next);
            next = Vector{next.x * scale, next.y * scale, next.z * scale};
            const double a = s.index_before * inner, b = s.index_behind * outer;
            power = power * (4.0 * a * b / ((a + b) * (a + b)));
            const double stretch = 1.0 / dot(d, next);
            first = along(first, -(dot(first, next) * stretch), d);
            second = along(second, -(dot(second, next) * stretch), d);
            d = next;
        }
        if (s.is_rotated) point = rotate(s.rotation, point);
        o = Vector{point.x + s.vertex_mm[0], point.y + s.vertex_mm[1], point.z + s.vertex_mm[2]};
    }

    out[0] = lost ? not_a_number() : point.x;
    out[n] = lost ? not_a_number() : point.y;
    out[2 * n] = lost ? not_a_number() : local.x;
    out[3 * n] = lost ? not_a_number() : local.y;
    out[4 * n] = lost ? not_a_number() : local.z;
    out[5 * n] = lost ? not_a_number() : path;
    out[6 * n] = lost ? 0.0 : power * dot(first, first);
    out[7 * n] = lost ? 0.0 : power * dot(second, second);
    ((int*)((double*)results_address + 8 * n))[ray] = lost ? number * 4 + lost : 0;
}

}  // namespace lumiline::tracing
