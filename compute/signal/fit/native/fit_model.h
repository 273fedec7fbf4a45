// The model of a window: its line-spread function, the expected count of a pixel, and its score.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/elementary.h"
#include "compute/signal/fit/native/fit_scan.h"

namespace lumiline::signal {

// All of a model has a value from the start: models are copied before they are fitted, and a copy
// of what has none is undefined. CUDA's compiler then gave fits the chi-square of an earlier pass.

constexpr int max_parameters = 3 + 2 * joint_peaks;

struct Window {
    int first, last, used, masked;
};

struct Model {
    int peaks = 0;
    double level = 0.0, slope = 0.0, light[joint_peaks] = {}, x[joint_peaks] = {}, log_w = 0.0;
    double chi2 = 0.0, deviance = 0.0, covariance[joint_peaks][joint_peaks] = {};
    bool open_width = false;
};

// What a model says about a pixel.
struct Pixel {
    double mean, variance, by[max_parameters];
};

struct CumulativeEdge {
    double fraction, density, moment;
};

// The fraction of light below t widths, its density, and t times that.
LUMILINE_FN CumulativeEdge edge_at(const FitScan& scan, const Rows<double>& rows, double t) {
    // Half a piece beyond the last that counts is well within the constant one.
    double table_position = (t - scan.plan.first) * scan.plan.inverse_step;
    const double last = scan.plan.pieces - 0.5;
    table_position = table_position > 0.0 ? (table_position < last ? table_position : last) : 0.0;
    const int k = (int)table_position;
    const double s = table_position - k;
    const Piece piece = rows.piece(k);
    const double fraction = piece.c0 + s * (piece.c1 + s * (piece.c2 + s * piece.c3));
    const double density =
        (piece.c1 + s * (2.0 * piece.c2 + s * 3.0 * piece.c3)) * scan.plan.inverse_step;
    return CumulativeEdge{fraction, density, t * density};
}

// The fraction of a stripe's light in a pixel about its centre.
LUMILINE_FN double central_fraction(const FitScan& scan, double w, double position_px) {
    const Rows<double> rows = rows_at(scan.plan, scan.pieces, position_px);
    return edge_at(scan, rows, 0.5 / w).fraction - edge_at(scan, rows, -0.5 / w).fraction;
}

// Level, [slope,] lights, positions, [logarithm of the width].
LUMILINE_FN int parameters_of(const FitScan& scan, int peaks) {
    return 1 + scan.plan.sloped + 2 * peaks + scan.plan.width_is_fitted;
}

// Tell `each(pixel, value, what the model says)` of each pixel that counts.
template <class Each>
LUMILINE_FN void evaluate(const FitScan& scan, const Model& m, const Window& in, Each each) {
    const int lights = 1 + scan.plan.sloped, positions = lights + m.peaks,
              width = positions + m.peaks;
    const double w = exp_of(m.log_w), by_width = 1.0 / w, middle = 0.5 * (in.first + in.last);
    Rows<double> rows[joint_peaks];
    CumulativeEdge before[joint_peaks];
    for (int k = 0; k < m.peaks; ++k) {
        rows[k] = rows_at(scan.plan, scan.pieces, m.x[k]);
        before[k] = edge_at(scan, rows[k], (in.first - 0.5 - m.x[k]) * by_width);
    }
    Pixel pixel;
    pixel.by[0] = 1.0;
    for (int i = in.first; i <= in.last; ++i) {
        double lit = 0.0;
        pixel.by[width] = 0.0;
        for (int k = 0; k < m.peaks; ++k) {
            const CumulativeEdge edge = edge_at(scan, rows[k], (i + 0.5 - m.x[k]) * by_width);
            const double fraction = edge.fraction - before[k].fraction;
            const double light = m.light[k];
            lit += light * fraction;
            pixel.by[lights + k] = fraction;
            pixel.by[positions + k] = light * by_width * (before[k].density - edge.density);
            pixel.by[width] += light * (before[k].moment - edge.moment);
            before[k] = edge;
        }
        pixel.mean = m.level + lit + scan.slope * (i - middle);
        if (scan.plan.sloped) {
            pixel.by[1] = i - middle;
            pixel.mean += m.slope * pixel.by[1];
        }
        pixel.variance =
            scan.variance_at(i, pixel.mean - scan.offset) + scan.plan.shape_error2 * lit * lit;
        if (scan.is_used(i)) each(i, scan.count_at(i), pixel);
    }
}

// Chi-square with that of the width's prior, and the deviance of a model.
struct Misfit {
    double chi2, deviance;
};

// The information, its lower half, and the score; with the width's prior.
LUMILINE_FN Misfit accumulate(const FitScan& scan, const Model& m, const Window& in, double* root,
                              double* score) {
    const int size = parameters_of(scan, m.peaks), width = size - 1;
    for (int a = 0; a < size; ++a) {
        score[a] = 0.0;
        for (int b = 0; b <= a; ++b) root[a * max_parameters + b] = 0.0;
    }
    // The logarithm of many variances' product: one of each is slow.
    double chi2 = 0.0, log_variance = 0.0, product = 1.0;
    evaluate(scan, m, in, [&](int, double value, const Pixel& pixel) {
        const double weight = 1.0 / pixel.variance;
        const double residual = value - pixel.mean;
        const double weighted = residual * weight;
        chi2 += residual * weighted;
        product *= pixel.variance;
        if (product > 1e100 || product < 1e-100) {
            log_variance += log_of(product);
            product = 1.0;
        }
        for (int a = 0; a < size; ++a) {
            const double by_a = pixel.by[a] * weight;
            score[a] += pixel.by[a] * weighted;
            for (int b = 0; b <= a; ++b) root[a * max_parameters + b] += by_a * pixel.by[b];
        }
    });
    double narrow = 0.0;
    if (scan.plan.width_is_fitted) {
        const double away = scan.plan.log_width - m.log_w;
        narrow = scan.plan.narrow4 * exp_of(-narrow_power * m.log_w);
        score[width] += scan.plan.prior * away + narrow_power * narrow;
        root[width * max_parameters + width] +=
            scan.plan.prior + narrow_power * narrow_power * narrow;
        chi2 += scan.plan.prior * away * away;
    }
    return Misfit{chi2, chi2 + log_variance + log_of(product) + 2.0 * narrow};
}

// Cholesky's root in place of the information, and by it the score's first substitution.
LUMILINE_FN bool factor_information(int size, double* root, const double* score, double* step) {
    for (int a = 0; a < size; ++a) {
        double* row = root + a * max_parameters;
        const double diagonal = row[a];
        double sum = score[a], pivot = diagonal;
        for (int b = 0; b < a; ++b) {
            const double* other = root + b * max_parameters;
            double entry = row[b];
            for (int k = 0; k < b; ++k) entry -= row[k] * other[k];
            entry /= other[b];
            row[b] = entry;
            pivot -= entry * entry;
            sum -= entry * step[b];
        }
        if (!(pivot >= min_pivot * diagonal && diagonal > 0.0 && diagonal < 1e300)) return false;
        row[a] = sqrt(pivot);
        step[a] = sum / row[a];
    }
    return true;
}

}  // namespace lumiline::signal
