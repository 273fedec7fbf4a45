// The joint fit of several peaks, in float64, and the choice of their number: the same steps as
// compute.signal.fit.model_order, so that hard cases end alike.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/elementary.h"
#include "compute/signal/fit/native/fit_model.h"
#include "compute/signal/fit/native/fit_scan.h"
#include "compute/signal/fit/native/groups.h"
#include "compute/signal/fit/native/scoring.h"
#include "compute/signal/fit/native/width_average.h"

namespace lumiline::signal {

// The best of what one peak more can do: false where nothing ends.
LUMILINE_FN bool add_peak(const FitScan& scan, const Model& m, const Window& in, Model* best) {
    const double w = exp_of(m.log_w);
    bool any = false;
    for (int k = 0; k <= m.peaks; ++k) {
        Model more = m;
        more.peaks = m.peaks + 1;
        if (k < m.peaks) {
            for (int j = m.peaks; j > k; --j) {
                more.light[j] = more.light[j - 1];
                more.x[j] = more.x[j - 1];
            }
            more.light[k] = more.light[k + 1] = 0.5 * m.light[k];
            more.x[k] = m.x[k] - split_widths * w;
            more.x[k + 1] = m.x[k] + split_widths * w;
            if (scan.plan.width_is_fitted) {
                more.log_w -= split_log_width;
                if (more.log_w < scan.plan.min_log) more.log_w = scan.plan.min_log;
            }
        } else {
            double worst = 0.0, height = 0.0;
            int at = -1;
            evaluate(scan, m, in, [&](int i, double value, const Pixel& pixel) {
                const double residual = value - pixel.mean;
                const double deviations = residual / sqrt(pixel.variance);
                if (at < 0 || deviations > worst) {
                    worst = deviations;
                    height = residual;
                    at = i;
                }
            });
            more.light[m.peaks] = height / central_fraction(scan, w, at);
            more.x[m.peaks] = at;
        }
        if (!iterate(scan, more, in)) continue;
        if (!any || more.deviance < best->deviance) *best = more;
        any = true;
    }
    return any;
}

// Writes a model's peaks in the order of their positions.
LUMILINE_FN void write_joint(const FitScan& scan, const Model& m, const PeakRecord* c,
                             int candidate_count, const Window& in, FittedPeak* out) {
    int order[joint_peaks];
    for (int k = 0; k < m.peaks; ++k) {
        int slot = k;
        for (; slot > 0 && m.x[order[slot - 1]] > m.x[k]; --slot) order[slot] = order[slot - 1];
        order[slot] = k;
    }
    const int dof = in.used - parameters_of(scan, m.peaks) + scan.plan.has_prior;
    int group_flags = m.chi2 > chi2_limit_of(scan, m, in) ? flag_poor_fit : 0;
    if (m.peaks > 1) group_flags |= flag_joint;
    if (in.masked > 0) group_flags |= flag_masked;
    if (in.used + in.masked < in.last - in.first + 1) group_flags |= flag_saturated;
    const double factor = scan.variance_factor(m.chi2, dof);
    const double w = exp_of(m.log_w), reach = 2.0 * w;
    for (int k = 0; k < m.peaks; ++k) {
        const int of = order[k];
        const double x = m.x[of];
        int flags = group_flags;
        if (x - reach < -0.5 || x + reach > scan.pixels - 0.5) flags |= flag_clipped;
        if (m.peaks == candidate_count) flags |= c[k].flags & flag_merged;
        out[k] = FittedPeak{x,
                            (float)sqrt(m.covariance[of][of] * factor),
                            (float)(m.light[of] * central_fraction(scan, w, x)),
                            (float)(w * scan.plan.width_unit),
                            flags,
                            (float)(m.chi2 / dof),
                            {0.0f, 0.0f, 0.0f}};
        for (int j = k + 1; j < m.peaks; ++j)
            out[k].covariance_px2[j - k - 1] = (float)(m.covariance[of][order[j]] * factor);
    }
}

LUMILINE_FN Window window_between(const FitScan& scan, int first, int last) {
    Window in = {first, last, 0, 0};
    for (int i = first; i <= last; ++i) {
        in.used += scan.is_used(i);
        in.masked += scan.is_masked(i);
    }
    return in;
}

// Fit candidates; returns the number of peaks, none where that is not possible.
LUMILINE_FN int fit_jointly(const FitScan& scan, int begin, int end, int first, int last,
                            FittedPeak* out) {
    const PeakRecord* c = scan.candidates + begin;
    const int count = end - begin;
    Model start;
    start.peaks = count;
    start.level = scan.level;
    for (int k = 0; k < count; ++k) start.log_w += log_of(start_width(scan, c[k]));
    start.log_w /= count;
    for (int k = 0; k < count; ++k) {
        start.x[k] = c[k].position_px;
        start.light[k] =
            (double)c[k].amplitude / central_fraction(scan, exp_of(start.log_w), c[k].position_px);
    }
    const Window narrow = window_between(scan, first, last);
    Model one = start;
    const bool ended = iterate(scan, one, narrow);
    const bool enough =
        ended && !(scan.plan.further_peaks && one.chi2 > chi2_limit_of(scan, one, narrow));
    // Written in one place: the code of averages is long, and three copies were a third slower.
    Model chosen = one;
    Window used = narrow;
    if (count == scan.plan.max_joint_peaks || enough) {
        if (!ended) return 0;
    } else {
        // More peaks are looked for in more pixels.
        int wide_first = 0, wide_last = 0;
        grown_window_of(scan, begin, end, first, last, &wide_first, &wide_last);
        const Window wide = window_between(scan, wide_first, wide_last);
        Model base = ended ? one : start, again = base;
        const bool ended_again = iterate(scan, again, wide);
        if (ended_again) base = again;
        base.deviance = again.deviance;
        const double min_improvement = 2.0 * log_of(wide.used) + scan.plan.margin;
        Model more;
        while (scan.plan.further_peaks && base.peaks < scan.plan.max_joint_peaks
               && add_peak(scan, base, wide, &more)
               && base.deviance - more.deviance > min_improvement) {
            base = more;
            if (!(base.chi2 > chi2_limit_of(scan, base, wide))) break;
        }
        if (base.peaks > count) {
            chosen = base;
            used = wide;
        } else if (!ended) {
            if (!ended_again) return 0;
            chosen = again;
            used = wide;
        }
    }
    marginalise_width(scan, chosen, used);
    write_joint(scan, chosen, c, count, used, out);
    return chosen.peaks;
}

}  // namespace lumiline::signal
