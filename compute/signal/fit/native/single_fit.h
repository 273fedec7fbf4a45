// The fit of one peak alone, in float32: nearly all peaks are fitted so.
//
// It gives an answer only where there is no doubt: the fit has converged in few steps, the peak is
// whole and not so bright that float32 would tell, and the misfit is clear of its limit: below, or
// not far above where that only is a flag. Else it returns 0, and the fit in float64 decides.
// Counts are taken from the scan's background, positions from the candidate's pixel: float32 then
// keeps 1e-6 px.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/elementary.h"
#include "compute/signal/fit/native/fit_scan.h"
#include "compute/signal/fit/native/groups.h"

namespace lumiline::signal {

constexpr float step_widths_f = (float)step_widths, step_log_width_f = (float)step_log_width;
constexpr float narrow_power_f = (float)narrow_power, open_width2_f = (float)open_width2;

// Parameters, `size` of them: level, [slope,] light, logarithm of the width, position: with the
// position last, its variance is that of the last pivot. A known width's row is nothing, and the
// compiler leaves it out.
template <int size, bool width_is_fitted, bool corrected>
LUMILINE_FN int fit_single_by(const FitScan& scan, const PeakRecord& c, int first, int last,
                              FittedPeak* out) {
    const int light_at = size - 3, width_at = size - 2, position_at = size - 1;
    const int max_passes = 8;
    // Beyond a thousand deviations float32 would tell.
    const double by_light = scan.photon * (double)c.amplitude;
    if ((double)c.amplitude * (double)c.amplitude > 1e6 * (scan.dark + by_light)) return 0;
    // Without its brightest pixels a fit hangs on little.
#if !defined(__CUDA_ARCH__)
    // Corrected counts and scales of the window, worked out once. CUDA's lanes work them out again:
    // their arrays would lie in memory.
    float counts[corrected ? max_window : 1], scales[corrected ? max_window : 1];
#endif
    int used = last - first + 1, masked = 0;
    for (int i = first; i <= last; ++i) {
        bool is_masked = false;
        if (corrected) {
            const PixelCorrection pixel = load_correction(scan.corrections, i);
#if !defined(__CUDA_ARCH__)
            counts[i - first] = corrected_count(*scan.sensor_correction, pixel, scan.v[i]);
            scales[i - first] = pixel.scale;
#endif
            is_masked = pixel.scale == 0.0f;
        }
        masked += is_masked;
        if (scan.v[i] >= scan.full_scale && !is_masked) return 0;
    }
    used -= masked;
    const int dof = used - size + !width_is_fitted + scan.plan.has_prior;
    if (dof < 1 + scan.plan.has_prior) return 0;
    const float chi2_limit = (float)scan.chi2_limits[dof];
    const bool may_split = scan.plan.further_peaks && scan.plan.max_joint_peaks > 1;

    const int origin = pixel_of(c), base = (int)floor(scan.level);
    const float dark_f = (float)scan.dark, photon_f = (float)scan.photon;
    const float above_offset = (float)((double)base - scan.offset);
    const float shape_error2 = (float)scan.plan.shape_error2;
    const float prior = (float)scan.plan.prior, prior_log = (float)scan.plan.log_width;
    const float narrow4 = (float)scan.plan.narrow4;
    const float min_log = (float)scan.plan.min_log, max_log = (float)scan.plan.max_log;
    const float inverse_step = (float)scan.plan.inverse_step;
    const float zero_position = (float)(-scan.plan.first * scan.plan.inverse_step);
    const float last_position = (float)(scan.plan.pieces - 0.5);
    const float middle = (float)(0.5 * (double)(first + last - 2 * origin));
    const float low_end = (float)(first - origin) - 0.5f;
    const float high_end = (float)(last - origin) + 0.5f;

    Rows<float> rows;
    auto take_rows_at = [&](float x) {
        rows = rows_at(scan.plan, scan.pieces_f, (double)origin + (double)x);
    };
    // The share of light below t widths, and its density by pieces.
    auto edge_at = [&](float t, float* fraction, float* density) {
        float table_position = t * inverse_step + zero_position;
        table_position = table_position > 0.0f
                             ? (table_position < last_position ? table_position : last_position)
                             : 0.0f;
        const int k = (int)table_position;
        const float s = table_position - (float)k;
        const PieceF piece = rows.piece(k);
        *fraction = piece.c0 + s * (piece.c1 + s * (piece.c2 + s * piece.c3));
        *density = piece.c1 + s * (2.0f * piece.c2 + s * (3.0f * piece.c3));
    };
    auto central_fraction = [&](float w) -> float {
        float below, above, density;
        edge_at(-0.5f / w, &below, &density);
        edge_at(0.5f / w, &above, &density);
        return above - below;
    };

    float w = (float)start_width(scan, c), log_w = (float)log_of(start_width(scan, c));
    float x = (float)(c.position_px - (double)origin);
    take_rows_at(x);
    float light = c.amplitude / central_fraction(w);
    float level = (float)(scan.level - (double)base), slope = (float)scan.slope;
    bool ended = false;
    float sigma2 = 0.0f, chi2 = 0.0f, last_rise = 0.0f;
    for (int pass = 0; pass < max_passes && !ended; ++pass) {
        take_rows_at(x);
        float information[size * (size + 1) / 2], score[size];
        LUMILINE_UNROLL
        for (int k = 0; k < size * (size + 1) / 2; ++k) information[k] = 0.0f;
        LUMILINE_UNROLL
        for (int k = 0; k < size; ++k) score[k] = 0.0f;
        chi2 = 0.0f;
        const float by_width = 1.0f / w;
        const float light_by_piece = light * inverse_step;
        const float light_by_px = light_by_piece * by_width;
        float t = (low_end - x) * by_width, fraction, density;
        edge_at(t, &fraction, &density);
        float moment = t * density;
        for (int i = first; i <= last; ++i) {
            const float fraction_before = fraction, density_before = density, before = moment;
            t = ((float)(i - origin) + 0.5f - x) * by_width;
            edge_at(t, &fraction, &density);
            moment = t * density;
            float by[size];
            by[0] = 1.0f;
            by[light_at] = fraction - fraction_before;
            by[width_at] = light_by_piece * (before - moment);
            by[position_at] = light_by_px * (density_before - density);
            const float lit = light * by[light_at];
            float mean = level + lit;
            if (size == 5) {
                by[1] = (float)(i - origin) - middle;
            }
            mean += slope * ((float)(i - origin) - middle);
            const float above = mean + above_offset;
            float count = (float)(scan.v[i] - base);
            float variance = dark_f + photon_f * (above > 0.0f ? above : 0.0f);
            float scale = 1.0f;
            if (corrected) {
#if defined(__CUDA_ARCH__)
                const PixelCorrection pixel = load_correction(scan.corrections, i);
                const float own = corrected_count(*scan.sensor_correction, pixel, scan.v[i]);
                scale = pixel.scale;
#else
                const float own = counts[i - first];
                scale = scales[i - first];
#endif
                count = own - (float)base;
                variance = scale * (scale * dark_f + photon_f * (above > 0.0f ? above : 0.0f));
            }
            variance += shape_error2 * lit * lit;
            // A masked pixel's scale is nothing, and so is its weight.
            const float weight = corrected && scale == 0.0f ? 0.0f : 1.0f / variance;
            const float residual = count - mean;
            const float weighted = residual * weight;
            chi2 += residual * weighted;
            LUMILINE_UNROLL
            for (int a = 0, k = 0; a < size; ++a) {
                const float by_a = by[a] * weight;
                score[a] += by[a] * weighted;
                LUMILINE_UNROLL
                for (int b = 0; b <= a; ++b, ++k) information[k] += by_a * by[b];
            }
        }

        const float away = prior_log - log_w;
        const int width_row = width_at * (width_at + 1) / 2;
        const int position_row = position_at * (position_at + 1) / 2;
        const float narrow = narrow4 * (by_width * by_width) * (by_width * by_width);
        score[width_at] += prior * away + narrow_power_f * narrow;
        information[width_row + width_at] += prior + narrow_power_f * narrow_power_f * narrow;
        chi2 += prior * away * away;
        const bool held = !width_is_fitted || (log_w <= min_log && score[width_at] < 0.0f)
                          || (log_w >= max_log && score[width_at] > 0.0f);
        if (held) {
            score[width_at] = 0.0f;
            LUMILINE_UNROLL
            for (int b = 0; b < width_at; ++b) information[width_row + b] = 0.0f;
            information[width_row + width_at] = 1.0f;
            information[position_row + width_at] = 0.0f;
        }
        bool regular = true;
        float length2 = 0.0f;
        LUMILINE_UNROLL
        for (int a = 0; a < size; ++a) {
            const int row = a * (a + 1) / 2;
            const float least = 1e-4f * information[row + a];
            LUMILINE_UNROLL
            for (int b = 0; b < a; ++b) {
                const int other = b * (b + 1) / 2;
                LUMILINE_UNROLL
                for (int k = 0; k < b; ++k)
                    information[row + b] -= information[row + k] * information[other + k];
            }
            float pivot = information[row + a];
            LUMILINE_UNROLL
            for (int b = 0; b < a; ++b) {
                const float factor = information[row + b] * information[b * (b + 1) / 2 + b];
                pivot -= factor * information[row + b];
                score[a] -= factor * score[b];
                information[row + b] = factor;
            }
            regular = regular && pivot > least && pivot < 1e30f;
            information[row + a] = 1.0f / pivot;
            length2 += score[a] * score[a] * information[row + a];
        }
        if (!regular) return 0;
        sigma2 = information[position_row + position_at];
        // Over open widths it is averaged, in float64; that soon shows.
        const float by_width_column = information[position_row + width_at];
        const float width2 =
            information[width_row + width_at] + by_width_column * by_width_column * sigma2;
        if (width_is_fitted && width2 > 2.0f * open_width2_f) return 0;
        LUMILINE_UNROLL
        for (int a = size - 1; a >= 0; --a) {
            score[a] *= information[a * (a + 1) / 2 + a];
            LUMILINE_UNROLL
            for (int b = a + 1; b < size; ++b)
                score[a] -= information[b * (b + 1) / 2 + a] * score[b];
        }
        // Where the shape misfits, steps shrink slowly, and rounding may tell which is the
        // last: float64 does then. Of others a further step is nothing.
        const float misfit = chi2 / (float)dof;
        const float end = (float)converged2 * (misfit > 1.0f ? misfit : 1.0f);
        if (misfit > 2.0f && length2 > 0.98f * end && length2 < 1.02f * end) return 0;
        ended = length2 < end;
        const float farthest = fabsf(score[position_at]) * by_width / step_widths_f;
        const float broadest = fabsf(score[width_at]) / step_log_width_f;
        float part = farthest > broadest ? farthest : broadest;
        part = part > 1.0f && !ended ? 1.0f / part : 1.0f;
        // Where the width turns back, the secant's step.
        const float turned = score[width_at] * last_rise;
        if (turned < 0.0f && !ended)
            part *= fabsf(last_rise) / (fabsf(last_rise) + part * fabsf(score[width_at]));
        level += part * score[0];
        if (size == 5) slope += part * score[1];
        light += part * score[light_at];
        x += part * score[position_at];
        if (width_is_fitted) {
            // exp to 1e-7: a step is a quarter at most.
            float rise = part * score[width_at];
            if (log_w + rise < min_log) rise = min_log - log_w;
            if (log_w + rise > max_log) rise = max_log - log_w;
            log_w += rise;
            last_rise = rise;
            w *= 1.0f
                 + rise
                       * (1.0f
                          + rise * (1.0f / 2.0f)
                                * (1.0f
                                   + rise * (1.0f / 3.0f)
                                         * (1.0f
                                            + rise * (1.0f / 4.0f)
                                                  * (1.0f
                                                     + rise * (1.0f / 5.0f)
                                                           * (1.0f + rise * (1.0f / 6.0f))))));
        }
        if (!(x > low_end && x < high_end && light > 0.0f)) return 0;
        if (ended) {
            if (width_is_fitted && !(width2 < 0.999f * open_width2_f)) return 0;
            // The light's variance: its column of the inverse of L, by the pivots.
            const float by_width_row = information[width_row + light_at];
            const float by_position_row = information[position_row + light_at]
                                          - information[position_row + width_at] * by_width_row;
            const float variance = information[light_at * (light_at + 1) / 2 + light_at]
                                   + by_width_row * by_width_row * information[width_row + width_at]
                                   + by_position_row * by_position_row * sigma2;
            if (!(light * light > 1.01f * variance)) return 0;
        }
    }

    const bool good = chi2 < 0.999f * chi2_limit;
    // Of a large misfit, steps shrink so slowly that the rounding of each adds up.
    const bool small = chi2 < 100.0f * (float)dof;
    const bool poor = chi2 > 1.001f * chi2_limit && small && !may_split;
    if (!ended || !(good || poor)) return 0;

    take_rows_at(x);
    const double position = (double)origin + (double)x, reach = 2.0 * (double)w;
    if (position - reach < -0.5 || position + reach > scan.pixels - 0.5) return 0;
    const float excess = chi2 - (float)scan.noise_chi2()[dof];
    const float factor = excess > 0.0f ? 1.0f + excess / (float)dof : 1.0f;
    *out = FittedPeak{
        position,
        sqrtf(sigma2 * factor),
        light * central_fraction(w),
        w * (float)scan.plan.width_unit,
        (c.flags & flag_merged) | (poor ? flag_poor_fit : 0) | (masked > 0 ? flag_masked : 0),
        chi2 / (float)dof,
        {0.0f, 0.0f, 0.0f}};
    return 1;
}

template <bool corrected>
LUMILINE_FN int fit_single(const FitScan& scan, const PeakRecord& c, int first, int last,
                           FittedPeak* out) {
    if (scan.plan.width_is_fitted)
        return scan.plan.sloped ? fit_single_by<5, true, corrected>(scan, c, first, last, out)
                                : fit_single_by<4, true, corrected>(scan, c, first, last, out);
    return scan.plan.sloped ? fit_single_by<5, false, corrected>(scan, c, first, last, out)
                            : fit_single_by<4, false, corrected>(scan, c, first, last, out);
}

}  // namespace lumiline::signal
