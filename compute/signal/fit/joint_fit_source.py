"""The native source of the joint fit, in float64, and of the choice of the number of peaks.

It takes the same steps as the reference, so that hard cases end alike.
"""

from typing import Final

from compute.signal.fit.fit_settings import (
    LOG_WIDTH_SIGMA_THRESHOLD,
    MIN_PIVOT,
    SPLIT_LOG_WIDTH,
    SPLIT_WIDTHS,
    STEP_LOG_WIDTH,
    STEP_WIDTHS,
)
from compute.signal.fit.width_marginalisation_source import AVERAGE_WIDTHS
from compute.signal.fit.window_model_source import (
    MODEL_SCORE,
    MODEL_SHAPE,
    MODEL_SUMS,
    MODEL_TYPES,
)

_STEP_LIMITS: Final = f"""
    const double step_widths = {STEP_WIDTHS!r}, step_log_width = {STEP_LOG_WIDTH!r};
    const double split_widths = {SPLIT_WIDTHS!r}, split_log_width = {SPLIT_LOG_WIDTH!r};
    const double min_pivot = {MIN_PIVOT!r}, min_closed = {LOG_WIDTH_SIGMA_THRESHOLD**-2!r};
"""

_STEPS: Final = """
    auto limit_of = [&](const Model& m, const Window& in) -> double {
        return chi2_limits[in.used - parameters_of(m.peaks) + plan.has_prior];
    };
    // The positions' covariance, from the Cholesky root of the information: its last rows are
    // those of lights, positions and, if it is one of them, the width; the inverse of their product
    // is their part of all. False: a light is not above its own deviation.
    auto find_covariance = [&](Model& m, const double* root, bool with_width) -> bool {
        const int from = 1 + plan.sloped, part = 2 * m.peaks + with_width;
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
    };
    // Take a step, but for the width; false: a position leaves the window.
    auto move_by = [&](Model& m, const Window& in, const double* step, double part) -> bool {
        const int lights = 1 + plan.sloped, places = lights + m.peaks;
        m.level += part * step[0];
        if (plan.sloped) m.slope += part * step[1];
        bool inside = true;
        for (int k = 0; k < m.peaks; ++k) {
            m.light[k] += part * step[lights + k];
            m.x[k] += part * step[places + k];
            inside = inside && m.x[k] >= in.first - 0.5 && m.x[k] <= in.last + 0.5;
        }
        return inside;
    };
    // Fisher scoring, until it has ended (true) or cannot: the deviance then is the least of the way.
    auto settle = [&](Model& m, const Window& in) -> bool {
        const int size = parameters_of(m.peaks), width = size - 1;
        const int places = 1 + plan.sloped + m.peaks;
        m.deviance = 1e300;
        if (in.used <= size) return false;
        const int freedom = in.used - size + plan.has_prior;
        double root[max_parameters * max_parameters], last_change = 0.0;
        for (int pass = 0; pass < max_iterations; ++pass) {
            double score[max_parameters], step[max_parameters];
            const Misfit now = sum_up(m, in, root, score);
            if (plan.width_is_fitted
                && ((m.log_w <= plan.min_log && score[width] < 0.0)
                    || (m.log_w >= plan.max_log && score[width] > 0.0))) {
                double* row = root + width * max_parameters;
                for (int b = 0; b < width; ++b) row[b] = 0.0;
                row[width] = 1.0;
                score[width] = 0.0;
            }
            if (now.deviance < m.deviance) m.deviance = now.deviance;
            if (!take_root(size, root, score, step)) return false;
            double length2 = 0.0;
            for (int a = 0; a < size; ++a) length2 += step[a] * step[a];
            for (int a = size - 1; a >= 0; --a) {
                for (int b = a + 1; b < size; ++b)
                    step[a] -= root[b * max_parameters + a] * step[b];
                step[a] /= root[a * max_parameters + a];
            }
            const double misfit = now.chi2 / freedom;
            const bool ended = length2 < converged2 * (misfit > 1.0 ? misfit : 1.0);
            double part = 1.0;
            if (!ended) {
                double most = 1.0;
                const double w = exp_of(m.log_w);
                for (int k = 0; k < m.peaks; ++k) {
                    const double far = fabs(step[places + k]) / (step_widths * w);
                    if (far > most) most = far;
                }
                if (plan.width_is_fitted) {
                    const double broad = fabs(step[width]) / step_log_width;
                    if (broad > most) most = broad;
                }
                part = 1.0 / most;
                // Where one line's width turns back, the secant's step.
                if (plan.width_is_fitted && m.peaks == 1 && step[width] * last_change < 0.0)
                    part *= fabs(last_change)
                        / (fabs(last_change) + part * fabs(step[width]));
            }
            if (!move_by(m, in, step, part)) return false;
            if (plan.width_is_fitted) {
                const double before = m.log_w;
                m.log_w += part * step[width];
                if (m.log_w < plan.min_log) m.log_w = plan.min_log;
                if (m.log_w > plan.max_log) m.log_w = plan.max_log;
                last_change = m.log_w - before;
            }
            if (ended) {
                const double pivot = root[width * max_parameters + width];
                // Of a width that is held at a limit it is one.
                m.open_width = plan.width_is_fitted && pivot * pivot < min_closed;
                m.chi2 = now.chi2;
                m.deviance = now.deviance;
                return find_covariance(m, root, plan.width_is_fitted);
            }
        }
        return false;
    };
"""

_CHOICE: Final = """
    // The best of what one peak more can do: false where nothing ends.
    auto add_peak = [&](const Model& m, const Window& in, Model* best) -> bool {
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
                if (plan.width_is_fitted) {
                    more.log_w -= split_log_width;
                    if (more.log_w < plan.min_log) more.log_w = plan.min_log;
                }
            } else {
                double worst = 0.0, height = 0.0;
                int at = -1;
                evaluate(m, in, [&](int i, double value, const Pixel& pixel) {
                    const double residual = value - pixel.mean;
                    const double deviations = residual / sqrt(pixel.variance);
                    if (at < 0 || deviations > worst) {
                        worst = deviations;
                        height = residual;
                        at = i;
                    }
                });
                more.light[m.peaks] = height / joint_middle_share(w, at);
                more.x[m.peaks] = at;
            }
            if (!settle(more, in)) continue;
            if (!any || more.deviance < best->deviance) *best = more;
            any = true;
        }
        return any;
    };
"""

_RESULT: Final = """
    auto write_joint = [&](
        const Model& m, const Candidate* c, int candidate_count, const Window& in, Fitted* out) {
        int order[joint_peaks];
        for (int k = 0; k < m.peaks; ++k) {
            int place = k;
            for (; place > 0 && m.x[order[place - 1]] > m.x[k]; --place)
                order[place] = order[place - 1];
            order[place] = k;
        }
        const int freedom = in.used - parameters_of(m.peaks) + plan.has_prior;
        int group_flags = m.chi2 > limit_of(m, in) ? poor_fit : 0;
        if (m.peaks > 1) group_flags |= joint;
        if (in.used < in.last - in.first + 1) group_flags |= saturated;
        const double w = exp_of(m.log_w), reach = 2.0 * w;
        for (int k = 0; k < m.peaks; ++k) {
            const int of = order[k];
            const double x = m.x[of];
            int flags = group_flags;
            if (x - reach < -0.5 || x + reach > pixels - 0.5) flags |= clipped;
            if (m.peaks == candidate_count) flags |= c[k].flags & merged;
            out[k] = Fitted{
                x, (float)sqrt(m.covariance[of][of]),
                (float)(m.light[of] * joint_middle_share(w, x)), (float)(w * plan.width_unit),
                flags, (float)(m.chi2 / freedom), {0.0f, 0.0f, 0.0f}};
            for (int j = k + 1; j < m.peaks; ++j)
                out[k].covariance[j - k - 1] = (float)m.covariance[of][order[j]];
        }
    };
    auto window_between = [&](int first, int last) -> Window {
        Window in = {first, last, 0};
        for (int i = first; i <= last; ++i) in.used += v[i] < full_scale;
        return in;
    };
    // Fit candidates; returns the number of peaks, none where that is not possible.
    auto fit_jointly = [&](int begin, int end, int first, int last, Fitted* out) -> int {
        const Candidate* c = candidates + begin;
        const int count = end - begin;
        Model start;
        start.peaks = count;
        start.level = line_background;
        for (int k = 0; k < count; ++k) start.log_w += log_of(start_width(c[k]));
        start.log_w /= count;
        for (int k = 0; k < count; ++k) {
            start.x[k] = c[k].position;
            start.light[k] = (double)c[k].amplitude
                / joint_middle_share(exp_of(start.log_w), c[k].position);
        }
        const Window narrow = window_between(first, last);
        Model one = start;
        const bool ended = settle(one, narrow);
        const bool enough = ended && !(plan.further_peaks && one.chi2 > limit_of(one, narrow));
        // Written in one place: the code of averages is long, and three copies were a third slower.
        Model chosen = one;
        Window used = narrow;
        if (count == plan.max_joint_peaks || enough) {
            if (!ended) return 0;
        } else {
            // More peaks are looked for in more pixels.
            int wide_first = 0, wide_last = 0;
            grown_window_of(begin, end, first, last, &wide_first, &wide_last);
            const Window wide = window_between(wide_first, wide_last);
            Model base = ended ? one : start, again = base;
            const bool ended_again = settle(again, wide);
            if (ended_again) base = again;
            base.deviance = again.deviance;
            const double min_fall = 2.0 * log_of(wide.used) + plan.margin;
            Model more;
            while (plan.further_peaks && base.peaks < plan.max_joint_peaks && add_peak(base, wide, &more)
                   && base.deviance - more.deviance > min_fall) {
                base = more;
                if (!(base.chi2 > limit_of(base, wide))) break;
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
        marginalise_width(chosen, used);
        write_joint(chosen, c, count, used, out);
        return chosen.peaks;
    };
"""

FIT_JOINTLY: Final = (
    _STEP_LIMITS
    + MODEL_TYPES
    + MODEL_SHAPE
    + MODEL_SCORE
    + MODEL_SUMS
    + _STEPS
    + AVERAGE_WIDTHS
    + _CHOICE
    + _RESULT
)
