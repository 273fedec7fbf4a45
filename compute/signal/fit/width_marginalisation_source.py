"""The native source of faint lines' covariances: means over the widths that are open, in float64.

It takes the same steps as ``compute.signal.fit.width_marginalisation``.
"""

from typing import Final

from compute.signal.fit.fit_settings import MAX_WIDTH_NODES, MIN_LOG_WEIGHT

AVERAGE_WIDTHS: Final = f"""
    const int max_nodes = {MAX_WIDTH_NODES};
    const double min_log_weight = {MIN_LOG_WEIGHT!r};
    // A model at one width, how it leads to others, and the slope of its likelihood along there.
    struct Node {{
        Model m;
        double lead[max_parameters] = {{}}, score = 0.0, information = 0.0, log_deviation = 0.0;
    }};
    // Take one scoring step to the best of a node's model at its width; false: there is no such.
    auto find_node = [&](Node& node, const Window& in) -> bool {{
        Model& m = node.m;
        const int size = parameters_of(m.peaks), width = size - 1;
        const int places = 1 + plan.sloped + m.peaks;
        double root[max_parameters * max_parameters];
        double score[max_parameters], step[max_parameters];
        sum_up(m, in, root, score);
        if (!take_root(size, root, score, step)) return false;
        const double* last = root + width * max_parameters;
        node.score = step[width] * last[width];
        node.information = last[width] * last[width];
        double deviations = 1.0;
        for (int a = width - 1; a >= 0; --a) {{
            const double by_pivot = 1.0 / root[a * max_parameters + a];
            double go = step[a], lead = -last[a];
            for (int b = a + 1; b < width; ++b) {{
                const double entry = root[b * max_parameters + a];
                go -= entry * step[b];
                lead -= entry * node.lead[b];
            }}
            step[a] = go * by_pivot;
            node.lead[a] = lead * by_pivot;
            if (a >= places) deviations *= by_pivot;
        }}
        node.log_deviation = log_of(deviations) / m.peaks;
        find_covariance(m, root, false);
        return move_by(m, in, step, 1.0);
    }};
    auto lead_on = [&](Node& node, const Window& in, double apart) -> bool {{
        move_by(node.m, in, node.lead, apart);
        node.m.log_w += apart;
        return find_node(node, in);
    }};
    // Where the width is open, the covariance becomes the mean one of all widths and what the
    // positions move between them. The model stays the best one.
    auto marginalise_width = [&](Model& m, const Window& in) {{
        if (!m.open_width) return;
        const int peaks = m.peaks;
        Node middle;
        middle.m = m;
        if (!find_node(middle, in)) return;
        double step = 1.0 / sqrt(middle.information);
        if (step > step_log_width) step = step_log_width;
        double total = 1.0, first[joint_peaks], second[joint_peaks][joint_peaks];
        for (int a = 0; a < peaks; ++a) {{
            first[a] = 0.0;
            for (int b = 0; b <= a; ++b) second[a][b] = middle.m.covariance[a][b];
        }}
        for (int side = -1; side <= 1; side += 2) {{
            Node node = middle;
            double rise = 0.0;
            for (int k = 0; k < max_nodes; ++k) {{
                const double before = node.score;
                if (!lead_on(node, in, side * step)) break;
                if (node.m.log_w < plan.min_log || node.m.log_w > plan.max_log) break;
                rise += 0.5 * (before + node.score) * side * step;
                const double weight = rise + node.log_deviation - middle.log_deviation;
                if (!(weight > min_log_weight)) break;
                const double part = exp_of(weight);
                total += part;
                for (int a = 0; a < peaks; ++a) {{
                    const double away = node.m.x[a] - middle.m.x[a];
                    first[a] += part * away;
                    for (int b = 0; b <= a; ++b)
                        second[a][b] += part * (
                            node.m.covariance[a][b] + away * (node.m.x[b] - middle.m.x[b]));
                }}
            }}
        }}
        for (int a = 0; a < peaks; ++a)
            for (int b = 0; b <= a; ++b)
                m.covariance[a][b] = m.covariance[b][a] =
                    second[a][b] / total - first[a] / total * (first[b] / total);
    }};
"""
