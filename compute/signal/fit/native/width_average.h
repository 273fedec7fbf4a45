// Covariances of faint lines: averages over the widths that the fit leaves open. As
// compute.signal.fit.width_marginalisation.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/elementary.h"
#include "compute/signal/fit/native/fit_model.h"
#include "compute/signal/fit/native/fit_scan.h"
#include "compute/signal/fit/native/scoring.h"

namespace lumiline::signal {

// A model at one width, how it leads to others, and the slope of its likelihood along there.
struct Node {
    Model m;
    double lead[max_parameters] = {}, score = 0.0, information = 0.0, log_sigma = 0.0;
};

// Take one scoring step to the best of a node's model at its width; false: there is no such, or a
// light of it is not positive.
LUMILINE_FN bool score_node(const FitScan& scan, Node& node, const Window& in) {
    Model& m = node.m;
    const int size = parameters_of(scan, m.peaks), width = size - 1;
    const int positions = 1 + scan.plan.sloped + m.peaks;
    double root[max_parameters * max_parameters];
    double score[max_parameters], step[max_parameters];
    accumulate(scan, m, in, root, score);
    if (!factor_information(size, root, score, step)) return false;
    const double* last = root + width * max_parameters;
    node.score = step[width] * last[width];
    node.information = last[width] * last[width];
    double deviations = 1.0;
    for (int a = width - 1; a >= 0; --a) {
        const double by_pivot = 1.0 / root[a * max_parameters + a];
        double go = step[a], lead = -last[a];
        for (int b = a + 1; b < width; ++b) {
            const double entry = root[b * max_parameters + a];
            go -= entry * step[b];
            lead -= entry * node.lead[b];
        }
        step[a] = go * by_pivot;
        node.lead[a] = lead * by_pivot;
        if (a >= positions) deviations *= by_pivot;
    }
    node.log_sigma = log_of(deviations) / m.peaks;
    find_covariance(scan, m, root, false);
    bool lit = apply_step(scan, m, in, step, 1.0);
    for (int k = 0; k < m.peaks; ++k) lit = lit && m.light[k] > 0.0;
    return lit;
}

LUMILINE_FN bool follow_width(const FitScan& scan, Node& node, const Window& in, double apart) {
    apply_step(scan, node.m, in, node.lead, apart);
    node.m.log_w += apart;
    return score_node(scan, node, in);
}

// Where the width is open, the covariance becomes the mean one of all widths and what the
// positions move between them. The model stays the best one.
LUMILINE_FN void marginalise_width(const FitScan& scan, Model& m, const Window& in) {
    if (!m.open_width) return;
    const int peaks = m.peaks;
    Node middle;
    middle.m = m;
    if (!score_node(scan, middle, in)) return;
    double step = 1.0 / sqrt(middle.information);
    if (step > step_log_width) step = step_log_width;
    double total = 1.0, first[joint_peaks], second[joint_peaks][joint_peaks];
    for (int a = 0; a < peaks; ++a) {
        first[a] = 0.0;
        for (int b = 0; b <= a; ++b) second[a][b] = middle.m.covariance[a][b];
    }
    for (int side = -1; side <= 1; side += 2) {
        Node node = middle;
        double rise = 0.0;
        for (int k = 0; k < max_nodes; ++k) {
            const double before = node.score;
            if (!follow_width(scan, node, in, side * step)) break;
            if (node.m.log_w < scan.plan.min_log || node.m.log_w > scan.plan.max_log) break;
            rise += 0.5 * (before + node.score) * side * step;
            const double weight = rise + node.log_sigma - middle.log_sigma;
            if (!(weight > min_log_weight && rise < max_log_likelihood_rise)) break;
            const double part = exp_of(weight);
            total += part;
            for (int a = 0; a < peaks; ++a) {
                const double away = node.m.x[a] - middle.m.x[a];
                first[a] += part * away;
                for (int b = 0; b <= a; ++b)
                    second[a][b] +=
                        part * (node.m.covariance[a][b] + away * (node.m.x[b] - middle.m.x[b]));
            }
        }
    }
    for (int a = 0; a < peaks; ++a)
        for (int b = 0; b <= a; ++b)
            m.covariance[a][b] = m.covariance[b][a] =
                second[a][b] / total - first[a] / total * (first[b] / total);
}

}  // namespace lumiline::signal
