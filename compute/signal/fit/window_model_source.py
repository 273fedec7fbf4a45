"""The native source of the model of a window: its shape, what it says of a pixel, its score."""

from typing import Final

from compute.signal.fit.fit_settings import NARROW_POWER

# All of a model has a value from the start: models are copied before they are fitted, and a copy of
# what has none is undefined. CUDA's compiler then gave fits the chi-square of an earlier pass.
MODEL_TYPES: Final = """
    const int max_parameters = 3 + 2 * joint_peaks;
    struct Window { int first, last, used; };
    struct Model {
        int peaks = 0;
        double level = 0.0, slope = 0.0, light[joint_peaks] = {}, x[joint_peaks] = {}, log_w = 0.0;
        double chi2 = 0.0, deviance = 0.0, covariance[joint_peaks][joint_peaks] = {};
        bool open_width = false;
    };
    // What a model says about a pixel.
    struct Pixel { double mean, variance, by[max_parameters]; };
    struct Edge { double share, density, moment; };
    // The pieces of the nodes about a place along the sensor.
    struct Rows { const Piece* near; const Piece* far; double far_part; };
"""

MODEL_SHAPE: Final = """
    auto joint_rows_at = [&](double position_px) -> Rows {
        if (plan.nodes == 1) return Rows{pieces, pieces, 0.0};
        const double node = (position_px - plan.first_node) / plan.node_step;
        const int below = node > 0.0 ? (node < plan.nodes - 2 ? (int)node : plan.nodes - 2) : 0;
        const double part = node - below;
        const Piece* near = pieces + below * plan.pieces;
        return Rows{near, near + plan.pieces, part > 0.0 ? (part < 1.0 ? part : 1.0) : 0.0};
    };
    auto joint_edge_at = [&](const Rows& rows, double t) -> Edge {
        // Half a piece beyond the last that counts is well within the constant one.
        double place = (t - plan.first) * plan.inverse_step;
        const double last = plan.pieces - 0.5;
        place = place > 0.0 ? (place < last ? place : last) : 0.0;
        const int k = (int)place;
        const double s = place - k;
        Piece piece = rows.near[k];
        if (plan.nodes > 1) {
            const Piece far = rows.far[k];
            const double part = rows.far_part;
            piece.c0 += part * (far.c0 - piece.c0);
            piece.c1 += part * (far.c1 - piece.c1);
            piece.c2 += part * (far.c2 - piece.c2);
            piece.c3 += part * (far.c3 - piece.c3);
        }
        const double share = piece.c0 + s * (piece.c1 + s * (piece.c2 + s * piece.c3));
        const double density =
            (piece.c1 + s * (2.0 * piece.c2 + s * 3.0 * piece.c3)) * plan.inverse_step;
        return Edge{share, density, t * density};
    };
    auto joint_middle_share = [&](double w, double position_px) -> double {
        const Rows rows = joint_rows_at(position_px);
        return joint_edge_at(rows, 0.5 / w).share - joint_edge_at(rows, -0.5 / w).share;
    };
"""

# `at_width` is the logarithm of the width, the last. Without it one parameter less.
MODEL_SCORE: Final = """
    auto parameters_of = [&](int peaks) -> int {
        return 1 + plan.sloped + 2 * peaks + plan.width_is_fitted;
    };
    // Tell `each(pixel, value, what the model says)` of each pixel that counts.
    auto evaluate = [&](const Model& m, const Window& in, auto each) {
        const int lights = 1 + plan.sloped, places = lights + m.peaks, width = places + m.peaks;
        const double w = exp_of(m.log_w), by_width = 1.0 / w, middle = 0.5 * (in.first + in.last);
        Rows rows[joint_peaks];
        Edge before[joint_peaks];
        for (int k = 0; k < m.peaks; ++k) {
            rows[k] = joint_rows_at(m.x[k]);
            before[k] = joint_edge_at(rows[k], (in.first - 0.5 - m.x[k]) * by_width);
        }
        Pixel pixel;
        pixel.by[0] = 1.0;
        for (int i = in.first; i <= in.last; ++i) {
            double lit = 0.0;
            pixel.by[width] = 0.0;
            for (int k = 0; k < m.peaks; ++k) {
                const Edge edge = joint_edge_at(rows[k], (i + 0.5 - m.x[k]) * by_width);
                const double share = edge.share - before[k].share;
                const double light = m.light[k];
                lit += light * share;
                pixel.by[lights + k] = share;
                pixel.by[places + k] = light * by_width * (before[k].density - edge.density);
                pixel.by[width] += light * (before[k].moment - edge.moment);
                before[k] = edge;
            }
            pixel.mean = m.level + lit;
            if (plan.sloped) {
                pixel.by[1] = i - middle;
                pixel.mean += m.slope * pixel.by[1];
            }
            const double above = pixel.mean - offset;
            pixel.variance = dark_variance + (above > 0.0 ? photon_variance * above : 0.0)
                + plan.shape_error2 * lit * lit;
            const int value = v[i];
            if (value < full_scale) each(i, (double)value, pixel);
        }
    };
"""

MODEL_SUMS: Final = f"""
    const double narrow_power = {NARROW_POWER};
    // Chi-square with that of the width's prior, and the deviance of a model.
    struct Misfit {{ double chi2, deviance; }};
    // The information, its lower half, and the score; with the width's prior.
    auto sum_up = [&](const Model& m, const Window& in, double* root, double* score) -> Misfit {{
        const int size = parameters_of(m.peaks), width = size - 1;
        for (int a = 0; a < size; ++a) {{
            score[a] = 0.0;
            for (int b = 0; b <= a; ++b) root[a * max_parameters + b] = 0.0;
        }}
        // The logarithm of many variances' product: one of each is slow.
        double chi2 = 0.0, log_variance = 0.0, product = 1.0;
        evaluate(m, in, [&](int, double value, const Pixel& pixel) {{
            const double weight = 1.0 / pixel.variance;
            const double residual = value - pixel.mean;
            const double weighted = residual * weight;
            chi2 += residual * weighted;
            product *= pixel.variance;
            if (product > 1e100 || product < 1e-100) {{
                log_variance += log_of(product);
                product = 1.0;
            }}
            for (int a = 0; a < size; ++a) {{
                const double by_a = pixel.by[a] * weight;
                score[a] += pixel.by[a] * weighted;
                for (int b = 0; b <= a; ++b) root[a * max_parameters + b] += by_a * pixel.by[b];
            }}
        }});
        double narrow = 0.0;
        if (plan.width_is_fitted) {{
            const double away = plan.log_width - m.log_w;
            narrow = plan.narrow4 * exp_of(-narrow_power * m.log_w);
            score[width] += plan.prior * away + narrow_power * narrow;
            root[width * max_parameters + width] +=
                plan.prior + narrow_power * narrow_power * narrow;
            chi2 += plan.prior * away * away;
        }}
        return Misfit{{chi2, chi2 + log_variance + log_of(product) + 2.0 * narrow}};
    }};
    // Cholesky's root in place of the information, and by it the score's first substitution.
    auto take_root = [&](int size, double* root, const double* score, double* step) -> bool {{
        for (int a = 0; a < size; ++a) {{
            double* row = root + a * max_parameters;
            const double diagonal = row[a];
            double sum = score[a], pivot = diagonal;
            for (int b = 0; b < a; ++b) {{
                const double* other = root + b * max_parameters;
                double entry = row[b];
                for (int k = 0; k < b; ++k) entry -= row[k] * other[k];
                entry /= other[b];
                row[b] = entry;
                pivot -= entry * entry;
                sum -= entry * step[b];
            }}
            if (!(pivot >= min_pivot * diagonal && diagonal > 0.0 && diagonal < 1e300))
                return false;
            row[a] = sqrt(pivot);
            step[a] = sum / row[a];
        }}
        return true;
    }};
"""
