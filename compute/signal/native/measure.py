"""Native source: the run of pixels around a maximum, and its centre of gravity."""

from typing import Final

# `top` is a peak's maximum when no pixel of its run is higher, nor one to the left as high.
RUN: Final = """
    auto is_peak = [&](const Line& line, int top, Run& run) -> bool {
        const unsigned short* v = line.v;
        const int highest = v[top], cut = cut_of(line, highest);
        int right = top, left = top;
        while (right + 1 < pixels) {
            const int value = v[right + 1];
            if (value > highest) return false;
            if (value < cut) break;
            ++right;
        }
        while (left > 0) {
            const int value = v[left - 1];
            if (value < cut) break;
            if (value >= highest) return false;
            --left;
        }
        if (right - left + 1 < min_width_px) return false;
        run = Run{top, left, right};
        return true;
    };
"""

MEASURE: Final = """
    struct Edge { double beyond_px, slope, excess; };
    struct Lever { double weight, slope; };
    // Where the signal crosses the threshold beyond the run's last pixel, how steeply, and what
    // the sum over the run lacks of the integral because it ends between two pixels (there the
    // profile has a kink): the first term of Euler and Maclaurin, -B2(d)/2 f', d px inside.
    auto edge_of = [&](const Line& line, int pixel, int side, double cut) -> Edge {
        const int outside = pixel + side;
        if (outside < 0 || outside >= pixels) return Edge{0.5, 0.0, 0.0};
        const double slope = double(line.v[pixel] - line.v[outside]);
        const double d = (double(line.v[pixel]) - cut) / slope;
        return Edge{d, slope, slope * 0.5 * (d * d - d + 1.0 / 6.0)};
    };
    // Derivatives of excess * (position - centre) by the last pixel's weight and by the slope;
    // `arm` is the last pixel's position less the centre.
    auto lever_of = [&](Edge edge, int side, double arm) -> Lever {
        if (edge.slope == 0.0) return Lever{0.0, 0.0};
        const double d = edge.beyond_px, half_b2 = 0.5 * (d * d - d + 1.0 / 6.0);
        const double from_centre = arm + side * d;
        return Lever{
            from_centre * (d - 0.5) + side * half_b2,
            from_centre * 0.5 * (1.0 / 6.0 - d * d) - side * d * half_b2,
        };
    };
    // Error of the centre, times the total, by where the run's end falls between two pixels: the
    // next term of the formula, with d anywhere in 0 .. 1 (variances of B1, B2, B3: 1/12, 1/180,
    // 1/840), doubled after the correction for the interpolation's own error.
    auto phase_error = [&](Edge edge, double arm, double step) -> double {
        if (correct_edges) return edge.slope * (2.0 / 3.0) * 0.034503277967117714;
        if (weigh_above_threshold) return edge.slope * arm * 0.5 * 0.07453559924999299;
        return edge.slope == 0.0 ? 0.0 : step * arm * 0.28867513459481287;
    };
    auto measure = [&](const Line& line, Run run) -> Record {
        const unsigned short* v = line.v;
        const int top = run.top, left = run.left, right = run.right;
        const int width_px = right - left + 1;
        const int threshold = threshold_of(line, v[top]);
        // Moments relative to the maximum, exact in 64-bit integers.
        const int base = weigh_above_threshold ? threshold : line.background;
        long long weight_sum = 0, moment = 0, pixel_sum = 0;
        for (int p = left; p <= right; ++p) {
            const long long weight = (long long)v[p] * level_unit - base;
            weight_sum += weight;
            moment += weight * (p - top);
            pixel_sum += p - top;
        }
        const double cut = double(threshold) / level_unit;
        const Edge at_left = edge_of(line, left, -1, cut), at_right = edge_of(line, right, 1, cut);
        double total = double(weight_sum) / level_unit;
        double first_moment = double(moment) / level_unit;
        if (correct_edges) {
            const double left_px = double(left - top) - at_left.beyond_px;
            const double right_px = double(right - top) + at_right.beyond_px;
            total += at_left.excess + at_right.excess;
            first_moment += at_left.excess * left_px + at_right.excess * right_px;
        }
        const double centre = first_moment / total;
        // How the centre, times the total, moves with each value: the edges' pixels first.
        Lever by_left = {0.0, 0.0}, by_right = {0.0, 0.0};
        if (correct_edges) {
            by_left = lever_of(at_left, -1, double(left - top) - centre);
            by_right = lever_of(at_right, 1, double(right - top) - centre);
        }
        // The maximum moves the threshold, and with it every weight.
        double by_threshold = 0.0;
        if (weigh_above_threshold)
            by_threshold =
                -(double(pixel_sum) - width_px * centre) - by_left.weight - by_right.weight;
        const double by_top = by_threshold * double(fraction_units) / fraction_unit;
        const double valley2 = detection_sigma * detection_sigma * 2.0 * variance_of(line, v[top]);
        double variance = 0.0;
        int flags = left == 0 || right == pixels - 1 ? clipped : 0;
        int high = 0, low = -1;
        for (int p = left; p <= right; ++p) {
            const int value = v[p];
            double lever = double(p - top) - centre;
            if (p == left) lever += by_left.weight + by_left.slope;
            if (p == right) lever += by_right.weight + by_right.slope;
            if (p == top) lever += by_top;
            variance += lever * lever * variance_of(line, value);
            // A fall from the highest so far, then a rise from the lowest since.
            if (low < 0) {
                if (value > high) high = value;
                const double fall = double(high - value);
                if (fall * fall > valley2) low = value;
            } else {
                if (value < low) low = value;
                const double rise = double(value - low);
                if (rise * rise > valley2) flags |= merged;
            }
        }
        // The pixels just outside set the slopes.
        if (left > 0)
            variance += by_left.slope * by_left.slope * variance_of(line, v[left - 1]);
        if (right < pixels - 1)
            variance += by_right.slope * by_right.slope * variance_of(line, v[right + 1]);
        if (v[top] >= line.full_scale) flags |= saturated;
        const double step = cut - double(base) / level_unit;
        const double by_phase_left =
            phase_error(at_left, double(left - top) - at_left.beyond_px - centre, step);
        const double by_phase_right =
            phase_error(at_right, double(right - top) + at_right.beyond_px - centre, step);
        variance += by_phase_left * by_phase_left + by_phase_right * by_phase_right;
        Record record;
        record.position = double(top) + centre;
        // One pixel: anywhere in it.
        record.sigma = width_px == 1 ? 0.28867513f : (float)(sqrt(variance) / total);
        record.amplitude =
            (float)(double(v[top] * level_unit - line.background) / level_unit);
        record.width = (float)(double(right - left) + at_left.beyond_px + at_right.beyond_px);
        record.flags = flags;
        return record;
    };
    // No room: the faintest goes (the last of equals), the others move up. Returns where the
    // record may go, or -1.
    auto place_among = [&](Record* records, float amplitude) -> int {
        int faintest = 0;
        for (int k = 1; k < max_peaks; ++k)
            if (records[k].amplitude <= records[faintest].amplitude) faintest = k;
        if (amplitude <= records[faintest].amplitude) return -1;
        for (int k = faintest; k + 1 < max_peaks; ++k) records[k] = records[k + 1];
        return max_peaks - 1;
    };
    auto no_record = [&]() -> Record {
        union { unsigned bits; float value; } nan = {0x7fc00000u};
        return Record{double(nan.value), nan.value, nan.value, nan.value, 0};
    };
"""
