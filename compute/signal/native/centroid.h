// The run of pixels around a maximum, and its centre of gravity.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

namespace lumiline::signal {

// The run of pixels above the threshold around a maximum, with the moments about the maximum of
// what lies above the run's least count; in a narrow run they fit in 32 bits.
struct Run {
    int top, left, right, least;
    unsigned sum, moment, moment2;
    bool dips;
};

constexpr int max_narrow_arm = 15;

// The least raw count at which one of the pixels from `first` to `last` may be bright. A maximum
// has to reach the limit with its raw count, too: all pixels are compared with one number.
LUMILINE_FN int raw_limit_of(const Search& search, const Scan& scan, int limit, int first,
                             int last) {
    if (scan.ramp == 0) return limit;
    return limit + ramp_at(scan.ramp, search.pixels, scan.ramp > 0 ? first : last);
}

// Whether a pixel, adjusted at the limit, is also bright by its raw count, and beside the noise of
// the background where it lies.
LUMILINE_FN bool is_bright(const Search& search, const Scan& scan, int limit, int top, int value,
                           int raw) {
    if (raw < raw_limit_of(search, scan, limit, top, top)) return false;
    if (scan.ramp == 0) return true;
    const double excess = double(value) - double(scan.background) / level_unit;
    double light =
        double(scan.background) / level_unit + ramp_at(scan.ramp, search.pixels, top) - scan.offset;
    if (light < 0.0) light = 0.0;
    return excess * excess
           >= search.detection_sigma * search.detection_sigma * (scan.dark + scan.photon * light);
}

// Looks for the run around a maximum by steps to both sides at once. `top` is a peak's maximum when
// no pixel of its run is higher, nor one to the left as high. Of others the run is as far as
// looked.
template <class Where, class Pixels>
LUMILINE_FN bool is_peak(const Search& search, Where where, const Pixels& v, int background,
                         int top, Run& run) {
    const int highest = v[top], least = search.cut_of(background, highest);
    int left = top, right = top, left_value = highest, right_value = highest, rise = 0;
    unsigned sum = highest - least, moment = 0u, moment2 = 0u;
    int step = 0;
    do {
        ++step;
        // Beyond the end of the line nothing is bright enough.
        int next_right = -1, next_left = -1;
        if (right_value >= least && (where || top + step < search.pixels))
            next_right = v[top + step];
        if (left_value >= least && (where || top >= step)) next_left = v[top - step];
        rise = larger(rise, next_right - right_value);
        rise = larger(rise, next_left - left_value);
        right_value = next_right;
        left_value = next_left;
        if (right_value >= least) {
            const unsigned above = right_value - least, arm = step * above;
            right = top + step;
            sum += above;
            moment += arm;
            moment2 += step * arm;
        }
        if (left_value >= least) {
            const unsigned above = left_value - least, arm = step * above;
            left = top - step;
            sum += above;
            moment -= arm;
            moment2 += step * arm;
        }
        if (right_value > highest || left_value >= highest) {
            run.left = left;
            run.right = right;
            return false;
        }
    } while (right_value >= least || left_value >= least);
    run = Run{top, left, right, least, sum, moment, moment2, rise > 0};
    return right - left + 1 >= search.min_width_px;
}

// Where the signal crosses the threshold beyond the run's last pixel, and how steeply.
struct Edge {
    float beyond_px, slope, half_b2;
};

struct EdgeDerivatives {
    float weight, slope;
};

// Derivatives of excess * (position - centre) by the last pixel's weight and by the slope;
// `arm` is the last pixel's position less the centre.
LUMILINE_FN EdgeDerivatives edge_derivatives(Edge edge, float side, float arm) {
    if (edge.slope == 0.0f) return EdgeDerivatives{0.0f, 0.0f};
    const float d = edge.beyond_px, from_centre = arm + side * d;
    return EdgeDerivatives{
        from_centre * (d - 0.5f) + side * edge.half_b2,
        from_centre * 0.5f * (1.0f / 6.0f - d * d) - side * d * edge.half_b2,
    };
}

// Error of the centre, times the total, by where the run's end falls between two pixels: the
// next term of the formula, with d anywhere in 0 .. 1 (variances of B1, B2, B3: 1/12, 1/180,
// 1/840), doubled after the correction for the interpolation's own error.
LUMILINE_FN float phase_error(const Search& search, Edge edge, float arm, float step) {
    if (search.correct_edges) return edge.slope * (2.0f / 3.0f) * 0.034503277967f;
    if (search.weigh_above_threshold) return edge.slope * arm * 0.5f * 0.074535599250f;
    return edge.slope == 0.0f ? 0.0f : step * arm * 0.288675134595f;
}

// A fall from the highest so far, then a rise from the lowest since, both more than noise
// explains: a decision, in float64 and then in whole counts.
template <class Pixels>
LUMILINE_FN bool has_valley(const Search& search, const Scan& scan, const Pixels& v,
                            const Run& run) {
    const double above_top = double(v[run.top]) - scan.offset;
    const double valley2 = search.detection_sigma * search.detection_sigma * 2.0
                           * (scan.dark + (above_top > 0.0 ? scan.photon * above_top : 0.0));
    int valley = valley2 < 4294836225.0 ? (int)sqrt(valley2) : 65535;
    if (double(valley) * valley > valley2)
        --valley;
    else if (double(valley + 1) * (valley + 1) <= valley2)
        ++valley;
    int high = 0, low = -1;
    for (int p = run.left; p <= run.right; ++p) {
        const int value = v[p];
        if (low < 0) {
            if (value > high) high = value;
            if (high - value > valley) low = value;
        } else {
            if (value < low) low = value;
            if (value - low > valley) return true;
        }
    }
    return false;
}

// To 1e-14: the float32's, once improved. A division in float64 is a subroutine on CUDA.
LUMILINE_FN double fast_inverse(double value) {
    const double first = (double)(1.0f / (float)value);
    return first * (2.0 - value * first);
}

// The centre of gravity of a run and its standard deviation. Positions and sums are float64, what
// tells how good they are is float32. `raw_top` is the maximum's count as it was read.
template <class Pixels>
LUMILINE_FN PeakRecord measure(const Search& search, const Scan& scan, const Pixels& v,
                               const Run& run, int raw_top) {
    const int top = run.top, left = run.left, right = run.right, least = run.least;
    const int highest = v[top], left_value = v[left], right_value = v[right];
    const int width_px = right - left + 1;
    const bool left_ends = left > 0, right_ends = right + 1 < search.pixels;
    const int before = left_ends ? v[left - 1] : 0, behind = right_ends ? v[right + 1] : 0;
    const int threshold = search.threshold_of(scan.background, highest);
    const float dark = (float)scan.dark, photon = (float)scan.photon;
    const float offset = (float)scan.offset;
    auto variance_of = [&](int value) -> float {
        const float above = (float)(value)-offset;
        return dark + (above > 0.0f ? photon * above : 0.0f);
    };
    // Moments relative to the maximum, exact: of what lies above the run's least count, ...
    const int base = search.weigh_above_threshold ? threshold : scan.background;
    const bool is_narrow = top - left <= max_narrow_arm && right - top <= max_narrow_arm;
    double total = double((int)run.sum), first_moment = double((int)run.moment);
    if (!is_narrow) {
        long long sum = 0, moment = 0;
        for (int p = left; p <= right; ++p) {
            sum += v[p] - least;
            moment += (long long)(v[p] - least) * (p - top);
        }
        total = double(sum);
        first_moment = double(moment);
    }
    // ... and of what lies below it, the same for every pixel.
    const double min_weight = double(least * level_unit - base) / level_unit;
    const double pixel_sum = 0.5 * double(width_px) * double(right + left - 2 * top);
    total += min_weight * width_px;
    first_moment += min_weight * pixel_sum;
    // Where the signal crosses the threshold beyond the run's last pixel, how steeply, and
    // what the sum over the run lacks of the integral because it ends between two pixels
    // (there the profile has a kink): the first term of Euler and Maclaurin, -B2(d)/2 f',
    // d px inside.
    const double cut = double(threshold) / level_unit;
    auto edge_of = [&](bool ends, int pixel, int value, int outside, int side) -> Edge {
        const double slope = double(ends ? value - outside : 1);
        const double d = (double(value) - cut) * fast_inverse(slope);
        const double half_b2 = 0.5 * (d * d - d + 1.0 / 6.0);
        const double lacks = ends && search.correct_edges ? slope * half_b2 : 0.0;
        total += lacks;
        first_moment += lacks * (double(pixel - top) + side * d);
        return Edge{ends ? (float)d : 0.5f, ends ? (float)slope : 0.0f,
                    ends ? (float)half_b2 : 0.0f};
    };
    const Edge at_left = edge_of(left_ends, left, left_value, before, -1);
    const Edge at_right = edge_of(right_ends, right, right_value, behind, 1);
    const double centre_px = first_moment * fast_inverse(total);
    const float centre = (float)centre_px;
    const float left_arm = (float)(left - top) - centre;
    const float right_arm = (float)(right - top) - centre;
    // How the centre, times the total, moves with each value: with its distance, and with more
    // at the run's ends and at the maximum, which moves the threshold and so every weight.
    EdgeDerivatives by_left = {0.0f, 0.0f}, by_right = {0.0f, 0.0f};
    if (search.correct_edges) {
        by_left = edge_derivatives(at_left, -1.0f, left_arm);
        by_right = edge_derivatives(at_right, 1.0f, right_arm);
    }
    float by_threshold = 0.0f;
    if (search.weigh_above_threshold)
        by_threshold = -((float)(pixel_sum)-width_px * centre) - by_left.weight - by_right.weight;
    const float by_top = by_threshold * (float)(search.fraction_units) / fraction_unit;
    const float more_left = by_left.weight + by_left.slope;
    const float more_right = by_right.weight + by_right.slope;
    float variance = 0.0f;
    if (is_narrow && centre >= -1.0f && centre <= 1.0f && (float)least >= offset) {
        // The pixels between these three have a variance that grows with their height: from
        // the moments less those of the three.
        const bool on_left = left<top, on_right = right> top;
        const int far_left = top - left, far_right = right - top;
        const int above_left = on_left ? left_value - least : 0;
        const int above_right = on_right ? right_value - least : 0;
        const int sum = (int)run.sum - (highest - least) - above_left - above_right;
        const int moment = (int)run.moment + far_left * above_left - far_right * above_right;
        const int moment2 = (int)run.moment2 - far_left * far_left * above_left
                            - far_right * far_right * above_right;
        const int to_left = far_left - on_left, to_right = far_right - on_right;
        const int twice_left = to_left * (to_left + 1), twice_right = to_right * (to_right + 1);
        const int pixels2 = twice_left * (2 * to_left + 1) + twice_right * (2 * to_right + 1);
        const float twice = 2.0f * centre, square = centre * centre;
        variance = variance_of(least)
                   * ((float)pixels2 * (1.0f / 6.0f) - centre * (float)(twice_right - twice_left)
                      + square * (float)(to_left + to_right));
        variance += photon * ((float)moment2 - twice * (float)moment + square * (float)sum);
        // Rounding may leave less than nothing.
        variance = variance > 0.0f ? variance : 0.0f;
        const float at_top =
            by_top - centre + (on_left ? 0.0f : more_left) + (on_right ? 0.0f : more_right);
        const float by_last_left = on_left ? left_arm + more_left : 0.0f;
        const float by_last_right = on_right ? right_arm + more_right : 0.0f;
        variance += at_top * at_top * variance_of(highest);
        variance += by_last_left * by_last_left * variance_of(left_value);
        variance += by_last_right * by_last_right * variance_of(right_value);
    } else {
        for (int p = left; p <= right; ++p) {
            float lever = (float)(p - top) - centre;
            if (p == left) lever += more_left;
            if (p == right) lever += more_right;
            if (p == top) lever += by_top;
            variance += lever * lever * variance_of(v[p]);
        }
    }
    // The pixels just outside set the slopes.
    variance += by_left.slope * by_left.slope * variance_of(before);
    variance += by_right.slope * by_right.slope * variance_of(behind);
    int flags = left_ends && right_ends ? 0 : flag_clipped;
    if (run.dips && has_valley(search, scan, v, run)) flags |= flag_merged;
    if (raw_top >= scan.full_scale) flags |= flag_saturated;
    const float step = (float)(cut - double(base) / level_unit);
    const float by_phase_left = phase_error(search, at_left, left_arm - at_left.beyond_px, step);
    const float by_phase_right =
        phase_error(search, at_right, right_arm + at_right.beyond_px, step);
    variance += by_phase_left * by_phase_left + by_phase_right * by_phase_right;
    PeakRecord record;
    record.position_px = double(top) + centre_px;
    // One pixel: anywhere in it.
    record.sigma_px = width_px == 1 ? 0.28867513f : sqrtf(variance) / (float)total;
    record.amplitude = (float)(double(highest * level_unit - scan.background) / level_unit);
    record.width_px = (float)(right - left) + at_left.beyond_px + at_right.beyond_px;
    record.flags = flags;
    return record;
}

// No room: the faintest goes (the last of equals), the others move up. Returns where the
// record may go, or -1.
LUMILINE_FN int make_room(const Search& search, PeakRecord* records, float amplitude) {
    int faintest = 0;
    for (int k = 1; k < search.max_peaks; ++k)
        if (records[k].amplitude <= records[faintest].amplitude) faintest = k;
    if (amplitude <= records[faintest].amplitude) return -1;
    for (int k = faintest; k + 1 < search.max_peaks; ++k) records[k] = records[k + 1];
    return search.max_peaks - 1;
}

LUMILINE_FN float quiet_nan() {
    union {
        unsigned bits;
        float value;
    } nan = {0x7fc00000u};

    return nan.value;
}

LUMILINE_FN PeakRecord empty_record() {
    return PeakRecord{(double)quiet_nan(), quiet_nan(), quiet_nan(), quiet_nan(), 0};
}

}  // namespace lumiline::signal
