// Functions of the kernels' headers for a host compiler: called one by one by the tests, and all
// kernels instantiated, so that the linter sees their templates.
#include "compute/optics/tracing/native/ray_tracing.h"
#include "compute/pose/filtering/native/pose_reliability.h"
#include "compute/pose/filtering/native/strobed_step.h"
#include "compute/reconstruction/native/triangulation.h"
#include "compute/signal/fit/native/fit_peaks.h"
#include "compute/signal/native/find_peaks.h"
#include "compute/tracking/native/association.h"

using namespace lumiline;

namespace lumiline {

template void tracing::trace_ray<true>(int, int, unsigned long long, unsigned long long, int,
                                       unsigned long long);
template void tracing::trace_ray<false>(int, int, unsigned long long, unsigned long long, int,
                                        unsigned long long);
template void solve_point<3, 0>(int, unsigned long long);
template void solve_point<4, 8>(int, unsigned long long);
template void tracking::associate_frame<3, 0>(unsigned long long);
template void tracking::associate_frame<4, 8>(unsigned long long);
template void pose::take_steps<3, 0>(unsigned long long);
template void pose::take_steps<4, 8>(unsigned long long);
template void pose::pose_reliability<3, 0>(unsigned long long);
template void pose::pose_reliability<4, 8>(unsigned long long);
template void signal::find_peaks<4, signal::Length::block, false>(const signal::Search&, int);
template void signal::find_peaks<4, signal::Length::block, true>(const signal::Search&, int);

}  // namespace lumiline

extern "C" {

// Rays.

double host_intersect_quadric(const tracing::Surface* s, const double* o, const double* d,
                              double least) {
    return tracing::intersect_quadric(*s, {o[0], o[1], o[2]}, {d[0], d[1], d[2]}, least);
}

double host_intersect_toroid(const tracing::Surface* s, const double* o, const double* d,
                             double least) {
    return tracing::intersect_toroid(*s, {o[0], o[1], o[2]}, {d[0], d[1], d[2]}, least);
}

void host_surface_normal(const tracing::Surface* s, const double* at, double* normal) {
    const tracing::Vector n = tracing::surface_normal<true>(*s, {at[0], at[1], at[2]});
    normal[0] = n.x;
    normal[1] = n.y;
    normal[2] = n.z;
}

// Points: four sensors with room for eight terms.

double host_solve_ldl(const double* matrix, const double* right, double* x) {
    double l[3], d[3];
    const double determinant = factor_ldl(matrix, l, d);
    solve_ldl(l, d, right, x);
    return determinant;
}

double host_singular_ratio(const double* matrix) {
    double a[3][3];
    for (int i = 0; i < 9; ++i) a[i / 3][i % 3] = matrix[i];
    return singular_ratio(a);
}

void host_project(const CameraRecord* record, const double* x, double* reading, double* gradient) {
    const Cameras<4, 8> cameras(*record);
    Lanes p[1], g[3][1];
    cameras.project(x, p, g);
    for (int s = 0; s < 4; ++s) {
        reading[s] = p[0][s];
        for (int axis = 0; axis < 3; ++axis) gradient[3 * s + axis] = g[axis][0][s];
    }
}

int host_parameter_jacobian(const CameraRecord* record, int s, const double* x, double* jacobian) {
    const Cameras<4, 8> cameras(*record);
    cameras.parameter_jacobian(s, x, jacobian);
    return cameras.parameters;
}

bool host_correction(const CameraRecord* record, const double* x, double* value, double* gradient,
                     double* variance) {
    const CorrectionTable<4> table(*record);
    Lanes v[1], by[3][1];
    table.correction(x, v, by);
    const bool used[4] = {true, true, true, true};
    const double ones[4] = {1.0, 1.0, 1.0, 1.0};
    for (int s = 0; s < 4; ++s) {
        value[s] = v[0][s];
        for (int axis = 0; axis < 3; ++axis) gradient[3 * s + axis] = by[axis][0][s];
        variance[s] = 0.0;
    }
    table.add_variance(x, used, ones, variance);
    return table.is_valid(x, used);
}

double host_invert_cubic(double projected, double principal_point, double cubic,
                         double* derivative) {
    return invert_cubic(projected, principal_point, cubic, *derivative);
}

// Tracks.

double host_merge_probability(double apart, double variance, double resolution) {
    return tracking::merge_probability(apart, variance, resolution);
}

double host_log_determinant(double* matrix, int n) { return tracking::cholesky<4>(matrix, n); }

// Marginal probabilities (n, m) of peaks, of their own or shared, for n tracks; -1: no room.
int host_joint_events(const tracking::AssociationJob* job, int n, const double* at,
                      const double* va, int m, const double* z, const double* vz, double* own,
                      double* shared) {
    static tracking::PartialEvent partials[80000];
    static int order[80000];
    tracking::AssociationJob mine = *job;
    mine.partials = (unsigned char*)partials;
    mine.order = order;
    tracking::JointEvents events(mine);
    double pruned_weight = 0.0;
    const int options = events.evaluate(n, at, va, m, z, vz, pruned_weight);
    for (int o = 0; o < options; ++o) {
        const tracking::Option& option = events.options[o];
        const double probability = events.option_probability[o];
        if (option.two < 0) {
            own[option.one * m + option.peak] += probability;
        } else {
            shared[option.one * m + option.peak] += probability;
            shared[option.two * m + option.peak] += probability;
        }
    }
    return options;
}

// Poses.

void host_rotation_matrix(const double* vector, double* matrix) {
    pose::rotation_matrix(vector, matrix);
}

// Peaks.

double host_log(double value) { return signal::log_of(value); }

double host_exp(double value) { return signal::exp_of(value); }

void host_edge(const unsigned long long* plan, double position_px, double t, double* edge) {
    const signal::Search search = {};
    signal::FitScan scan(search, (unsigned long long)plan);
    scan.pieces = scan.all_pieces;
    const signal::Rows<double> rows = signal::rows_at(scan.plan, scan.pieces, position_px);
    const signal::CumulativeEdge found = signal::edge_at(scan, rows, t);
    edge[0] = found.fraction;
    edge[1] = found.density;
}

double host_central_fraction(const unsigned long long* plan, double position_px, double width) {
    const signal::Search search = {};
    signal::FitScan scan(search, (unsigned long long)plan);
    scan.pieces = scan.all_pieces;
    return signal::central_fraction(scan, width, position_px);
}

int host_threshold(int background, int value, int fraction_units) {
    signal::Search search = {};
    search.fraction_units = fraction_units;
    return search.threshold_of(background, value);
}
}
