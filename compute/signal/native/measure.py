"""Native source: the run of pixels around a maximum, and its centre of gravity."""

from typing import Final

# `top` is a peak's maximum when no pixel of its run is higher, nor one to the left as high.
RUN: Final = """
    auto is_peak = [&](const unsigned short* v, int background, int top, Run& run) -> bool {
        const int highest = v[top], cut = cut_of(background, highest);
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

# Positions are float64, what tells how good they are is float32.
MEASURE: Final = """
    struct Edge { float beyond_px, slope, half_b2; };
    struct Lever { float weight, slope; };
    // Derivatives of excess * (position - centre) by the last pixel's weight and by the slope;
    // `arm` is the last pixel's position less the centre.
    auto lever_of = [&](Edge edge, float side, float arm) -> Lever {
        if (edge.slope == 0.0f) return Lever{0.0f, 0.0f};
        const float d = edge.beyond_px, from_centre = arm + side * d;
        return Lever{
            from_centre * (d - 0.5f) + side * edge.half_b2,
            from_centre * 0.5f * (1.0f / 6.0f - d * d) - side * d * edge.half_b2,
        };
    };
    // Error of the centre, times the total, by where the run's end falls between two pixels: the
    // next term of the formula, with d anywhere in 0 .. 1 (variances of B1, B2, B3: 1/12, 1/180,
    // 1/840), doubled after the correction for the interpolation's own error.
    auto phase_error = [&](Edge edge, float arm, float step) -> float {
        if (correct_edges) return edge.slope * (2.0f / 3.0f) * 0.034503277967f;
        if (weigh_above_threshold) return edge.slope * arm * 0.5f * 0.074535599250f;
        return edge.slope == 0.0f ? 0.0f : step * arm * 0.288675134595f;
    };
    // A fall from the highest so far, then a rise from the lowest since, both more than noise
    // explains: a decision, in float64 and then in whole counts.
    auto has_valley = [&](const Line& line, Run run) -> bool {
        const double above_top = double(line.v[run.top]) - line.offset;
        const double valley2 = detection_sigma * detection_sigma * 2.0
            * (line.dark + (above_top > 0.0 ? line.photon * above_top : 0.0));
        int valley = valley2 < 4294836225.0 ? (int)sqrt(valley2) : 65535;
        if (double(valley) * valley > valley2) --valley;
        else if (double(valley + 1) * (valley + 1) <= valley2) ++valley;
        int high = 0, low = -1;
        for (int p = run.left; p <= run.right; ++p) {
            const int value = line.v[p];
            if (low < 0) {
                if (value > high) high = value;
                if (high - value > valley) low = value;
            } else {
                if (value < low) low = value;
                if (value - low > valley) return true;
            }
        }
        return false;
    };
    // To 1e-14: the float32's, once improved. A division in float64 is a subroutine on CUDA.
    auto inverse = [](double value) -> double {
        const double first = (double)(1.0f / (float)value);
        return first * (2.0 - value * first);
    };
    auto measure = [&](const Line& line, Run run) -> Record {
        const unsigned short* v = line.v;
        const int top = run.top, left = run.left, right = run.right;
        const int width_px = right - left + 1;
        const int threshold = threshold_of(line.background, v[top]);
        const float dark = (float)line.dark, photon = (float)line.photon;
        const float offset = (float)line.offset;
        auto variance_of = [&](int value) -> float {
            const float above = (float)(value) - offset;
            return dark + (above > 0.0f ? photon * above : 0.0f);
        };
        // Moments relative to the maximum, exact in 64-bit integers.
        const int base = weigh_above_threshold ? threshold : line.background;
        long long weight_sum = 0, moment = 0, pixel_sum = 0;
        for (int p = left; p <= right; ++p) {
            const int weight = v[p] * level_unit - base;
            weight_sum += weight;
            moment += (long long)weight * (p - top);
            pixel_sum += p - top;
        }
        const double cut = double(threshold) / level_unit;
        double total = double(weight_sum) / level_unit;
        double first_moment = double(moment) / level_unit;
        // Where the signal crosses the threshold beyond the run's last pixel, how steeply, and
        // what the sum over the run lacks of the integral because it ends between two pixels
        // (there the profile has a kink): the first term of Euler and Maclaurin, -B2(d)/2 f',
        // d px inside.
        auto edge_of = [&](int pixel, int side) -> Edge {
            const int outside = pixel + side;
            if (outside < 0 || outside >= pixels) return Edge{0.5f, 0.0f, 0.0f};
            const double slope = double(v[pixel] - v[outside]);
            const double d = (double(v[pixel]) - cut) * inverse(slope);
            const double half_b2 = 0.5 * (d * d - d + 1.0 / 6.0);
            if (correct_edges) {
                total += slope * half_b2;
                first_moment += slope * half_b2 * (double(pixel - top) + side * d);
            }
            return Edge{(float)d, (float)slope, (float)half_b2};
        };
        const Edge at_left = edge_of(left, -1), at_right = edge_of(right, 1);
        const double centre_px = first_moment * inverse(total);
        const float centre = (float)centre_px;
        const float left_arm = (float)(left - top) - centre;
        const float right_arm = (float)(right - top) - centre;
        // How the centre, times the total, moves with each value: the edges' pixels first.
        Lever by_left = {0.0f, 0.0f}, by_right = {0.0f, 0.0f};
        if (correct_edges) {
            by_left = lever_of(at_left, -1.0f, left_arm);
            by_right = lever_of(at_right, 1.0f, right_arm);
        }
        // The maximum moves the threshold, and with it every weight.
        float by_threshold = 0.0f;
        if (weigh_above_threshold)
            by_threshold =
                -((float)(pixel_sum) - width_px * centre) - by_left.weight - by_right.weight;
        const float by_top = by_threshold * (float)(fraction_units) / fraction_unit;
        float variance = 0.0f;
        int flags = left == 0 || right == pixels - 1 ? clipped : 0;
        bool fell = false, dips = false;
        for (int p = left; p <= right; ++p) {
            const int value = v[p];
            float lever = (float)(p - top) - centre;
            if (p == left) lever += by_left.weight + by_left.slope;
            if (p == right) lever += by_right.weight + by_right.slope;
            if (p == top) lever += by_top;
            variance += lever * lever * variance_of(value);
            const int before = p > left ? v[p - 1] : 0;
            if (value < before) fell = true;
            else if (value > before && fell) dips = true;
        }
        if (dips && has_valley(line, run)) flags |= merged;
        // The pixels just outside set the slopes.
        if (left > 0)
            variance += by_left.slope * by_left.slope * variance_of(v[left - 1]);
        if (right < pixels - 1)
            variance += by_right.slope * by_right.slope * variance_of(v[right + 1]);
        if (v[top] >= line.full_scale) flags |= saturated;
        const float step = (float)(cut - double(base) / level_unit);
        const float by_phase_left = phase_error(at_left, left_arm - at_left.beyond_px, step);
        const float by_phase_right = phase_error(at_right, right_arm + at_right.beyond_px, step);
        variance += by_phase_left * by_phase_left + by_phase_right * by_phase_right;
        Record record;
        record.position = double(top) + centre_px;
        // One pixel: anywhere in it.
        record.sigma = width_px == 1 ? 0.28867513f : sqrtf(variance) / (float)total;
        record.amplitude =
            (float)(double(v[top] * level_unit - line.background) / level_unit);
        record.width = (float)(right - left) + at_left.beyond_px + at_right.beyond_px;
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
