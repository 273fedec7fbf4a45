// Fisher scoring of a model, in float64.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/elementary.h"
#include "compute/signal/fit/native/fit_model.h"
#include "compute/signal/fit/native/fit_scan.h"

namespace lumiline::signal {

// The chi-square above which a model misfits.
LUMILINE_FN double chi2_limit_of(const FitScan& scan, const Model& m, const Window& in) {
    return scan.chi2_limits[in.used - parameters_of(scan, m.peaks) + scan.plan.has_prior];
}

// The positions' covariance, from the Cholesky root of the information: its last rows are
// those of lights, positions and, if it is one of them, the width; the inverse of their product
// is their part of all. False: a light is not above its own deviation.
LUMILINE_FN bool find_covariance(const FitScan& scan, Model& m, const double* root,
                                 bool with_width) {
    const int from = 1 + scan.plan.sloped, part = 2 * m.peaks + with_width;
    double inverse[2 * joint_peaks + 1][2 * joint_peaks + 1];
    for (int b = 0; b < part; ++b) {
        for (int a = b; a < part; ++a) {
            const double* row = root + (from + a) * max_parameters + from;
            double sum = a == b ? 1.0 : 0.0;
            for (int k = b; k < a; ++k) sum -= row[k] * inverse[k][b];
            inverse[a][b] = sum / row[a];
        }
    }
    bool lit = true;
    for (int a = 0; a < m.peaks; ++a) {
        double variance = 0.0;
        for (int k = a; k < part; ++k) variance += inverse[k][a] * inverse[k][a];
        lit = lit && m.light[a] > sqrt(variance);
        const int at = m.peaks + a;
        for (int b = 0; b <= a; ++b) {
            double sum = 0.0;
            for (int k = at; k < part; ++k) sum += inverse[k][at] * inverse[k][m.peaks + b];
            m.covariance[a][b] = m.covariance[b][a] = sum;
        }
    }
    return lit;
}

// Take a step, but for the width; false: a position leaves the window.
LUMILINE_FN bool apply_step(const FitScan& scan, Model& m, const Window& in, const double* step,
                            double part) {
    const int lights = 1 + scan.plan.sloped, positions = lights + m.peaks;
    m.level += part * step[0];
    if (scan.plan.sloped) m.slope += part * step[1];
    bool inside = true;
    for (int k = 0; k < m.peaks; ++k) {
        m.light[k] += part * step[lights + k];
        m.x[k] += part * step[positions + k];
        inside = inside && m.x[k] >= in.first - 0.5 && m.x[k] <= in.last + 0.5;
    }
    return inside;
}

// Fisher scoring, until it has ended (true) or cannot: the deviance then is the least of the way.
LUMILINE_FN bool iterate(const FitScan& scan, Model& m, const Window& in) {
    const int size = parameters_of(scan, m.peaks), width = size - 1;
    const int positions = 1 + scan.plan.sloped + m.peaks;
    m.deviance = 1e300;
    if (in.used <= size) return false;
    const int dof = in.used - size + scan.plan.has_prior;
    double root[max_parameters * max_parameters], last_change = 0.0;
    for (int pass = 0; pass < max_iterations; ++pass) {
        double score[max_parameters], step[max_parameters];
        const Misfit now = accumulate(scan, m, in, root, score);
        if (scan.plan.width_is_fitted
            && ((m.log_w <= scan.plan.min_log && score[width] < 0.0)
                || (m.log_w >= scan.plan.max_log && score[width] > 0.0))) {
            double* row = root + width * max_parameters;
            for (int b = 0; b < width; ++b) row[b] = 0.0;
            row[width] = 1.0;
            score[width] = 0.0;
        }
        if (now.deviance < m.deviance) m.deviance = now.deviance;
        if (!factor_information(size, root, score, step)) return false;
        double length2 = 0.0;
        for (int a = 0; a < size; ++a) length2 += step[a] * step[a];
        for (int a = size - 1; a >= 0; --a) {
            for (int b = a + 1; b < size; ++b) step[a] -= root[b * max_parameters + a] * step[b];
            step[a] /= root[a * max_parameters + a];
        }
        const double misfit = now.chi2 / dof;
        const bool ended = length2 < converged2 * (misfit > 1.0 ? misfit : 1.0);
        double part = 1.0;
        if (!ended) {
            double most = 1.0;
            const double w = exp_of(m.log_w);
            for (int k = 0; k < m.peaks; ++k) {
                const double far = fabs(step[positions + k]) / (step_widths * w);
                if (far > most) most = far;
            }
            if (scan.plan.width_is_fitted) {
                const double broad = fabs(step[width]) / step_log_width;
                if (broad > most) most = broad;
            }
            part = 1.0 / most;
            // Where one line's width turns back, the secant's step.
            if (scan.plan.width_is_fitted && m.peaks == 1 && step[width] * last_change < 0.0)
                part *= fabs(last_change) / (fabs(last_change) + part * fabs(step[width]));
        }
        if (!apply_step(scan, m, in, step, part)) return false;
        if (scan.plan.width_is_fitted) {
            const double before = m.log_w;
            m.log_w += part * step[width];
            if (m.log_w < scan.plan.min_log) m.log_w = scan.plan.min_log;
            if (m.log_w > scan.plan.max_log) m.log_w = scan.plan.max_log;
            last_change = m.log_w - before;
        }
        if (ended) {
            const double pivot = root[width * max_parameters + width];
            // Of a width that is held at a limit it is one.
            m.open_width = scan.plan.width_is_fitted && pivot * pivot < min_closed_information;
            m.chi2 = now.chi2;
            m.deviance = now.deviance;
            return find_covariance(scan, m, root, scan.plan.width_is_fitted);
        }
    }
    return false;
}

}  // namespace lumiline::signal
