"""The native source of the kernel: the peaks of one line, in C++ for the CPU and CUDA.

It is native, because the compiler vectorises its search for bright blocks and does not vectorise
a loop of Warp's own over the pixels (a factor of eight on the CPU). On CUDA the lanes of a warp
share the background and the search, then all walk the same peak, with the same loads, and the
first lane writes it. Every decision is taken in integers, so that both take the same.

The arguments are those of ``compute.signal.centroid_kernel``.
"""

from typing import Final

from compute.signal.peaks import PeakFlag
from compute.signal.settings import FRACTION_UNIT, GROUP_PIXELS, LEVEL_UNIT, SAMPLE_GROUPS

_CONSTANTS = f"""
    const int level_unit = {LEVEL_UNIT};
    const int fraction_unit = {FRACTION_UNIT};
    const int group_pixels = {GROUP_PIXELS};
    const int sample_groups = {SAMPLE_GROUPS};
    const int saturated = {PeakFlag.SATURATED:d}, clipped = {PeakFlag.CLIPPED:d};
    const int merged = {PeakFlag.MERGED:d}, truncated = {PeakFlag.TRUNCATED:d};
"""

_TYPES = """
    struct Record { double position; float sigma, amplitude, width; int flags; };
    const unsigned short* v = (const unsigned short*)line_address;
    struct Edge { double beyond_px, slope, excess; };
    struct Lever { double weight, slope; };
    int* count = (int*)record_address;
    Record* records = (Record*)(record_address + 8);
"""

# The background: the groups' first quartile and first sixteenth, by rank. Keys are unique, since
# the group's number is in their low bits.
_BACKGROUND = """
    const int groups = pixels / group_pixels < sample_groups
        ? pixels / group_pixels : sample_groups;
    const int step = (pixels - group_pixels) / (groups - 1);
    const int rank_quartile = (groups - 1) / 4, rank_sixteenth = (groups - 1) / 16;
    int quartile = 0, sixteenth = 0;
#if defined(__CUDA_ARCH__)
    int key = 0x7fffffff;
    if (lane < groups) {
        const unsigned short* group = v + lane * step / group_pixels * group_pixels;
        int sum = 0;
        for (int i = 0; i < group_pixels; ++i) sum += group[i];
        key = sum * sample_groups + lane;
    }
    int rank = 0;
    for (int g = 0; g < groups; ++g) rank += __shfl_sync(0xffffffffu, key, g) < key;
    const unsigned at_quartile = __ballot_sync(0xffffffffu, lane < groups && rank == rank_quartile);
    const unsigned at_sixteenth =
        __ballot_sync(0xffffffffu, lane < groups && rank == rank_sixteenth);
    quartile = __shfl_sync(0xffffffffu, key, __ffs(at_quartile) - 1) / sample_groups;
    sixteenth = __shfl_sync(0xffffffffu, key, __ffs(at_sixteenth) - 1) / sample_groups;
#else
    int keys[sample_groups];
    for (int g = 0; g < sample_groups; ++g) keys[g] = 0x7fffffff;
    for (int g = 0; g < groups; ++g) {
        const unsigned short* group = v + g * step / group_pixels * group_pixels;
        int sum = 0;
        for (int i = 0; i < group_pixels; ++i) sum += group[i];
        keys[g] = sum * sample_groups + g;
    }
    for (int g = 0; g < groups; ++g) {
        int rank = 0;
        for (int j = 0; j < sample_groups; ++j) rank += keys[j] < keys[g];
        if (rank == rank_quartile) quartile = keys[g] / sample_groups;
        if (rank == rank_sixteenth) sixteenth = keys[g] / sample_groups;
    }
#endif
    const int background = quartile * (level_unit / group_pixels);
    const double spread = double((quartile - sixteenth) * (level_unit / group_pixels)) / level_unit;
    double light = double(background) / level_unit - offset;
    if (light < 0.0) light = 0.0;
    double sigma = sqrt(dark_variance + photon_variance * light);
    if (sigma < spread) sigma = spread;
    const double limit_level = ceil(double(background) / level_unit + detection_sigma * sigma);
    const int limit = limit_level > 65536.0 ? 65536 : (int)limit_level;
"""

# The next pixel at the limit or above it, from `from` on; `pixels` when there is none.
_SEARCH = """
    auto search = [&](int from) -> int {
#if defined(__CUDA_ARCH__)
        for (int start = from; start < pixels; start += 8 * 32) {
            // Eight loads in flight, then eight votes.
            int value[8];
            #pragma unroll
            for (int i = 0; i < 8; ++i) {
                const int p = start + i * 32 + lane;
                value[i] = p < pixels ? v[p] : -1;
            }
            #pragma unroll
            for (int i = 0; i < 8; ++i) {
                const unsigned bright = __ballot_sync(0xffffffffu, value[i] >= limit);
                if (bright != 0) return start + i * 32 + __ffs(bright) - 1;
            }
        }
        return pixels;
#else
        int p = from;
        const int block = 64;
        for (; p + block <= pixels; p += block) {
            unsigned short top = 0;
            for (int i = 0; i < block; ++i) top = v[p + i] > top ? v[p + i] : top;
            if (top >= limit) break;
        }
        while (p < pixels && v[p] < limit) ++p;
        return p;
#endif
    };
"""

# Climb to the maximum of the run, see that no pixel of the run is higher, then measure it.
_PEAKS = """
    auto threshold_of = [&](int value) -> int {
        const long long excess = (long long)value * level_unit - background;
        return background + (int)(excess * fraction_units / fraction_unit);
    };
    auto variance_of = [&](int value) -> double {
        const double above = double(value) - offset;
        return dark_variance + (above > 0.0 ? photon_variance * above : 0.0);
    };
    // Where the signal crosses the threshold beyond the run's last pixel, how steeply, and what
    // the sum over the run lacks of the integral because it ends between two pixels (there the
    // profile has a kink): the first term of Euler and Maclaurin, -B2(d)/2 f', d px inside.
    auto edge_of = [&](int pixel, int side, double cut) -> Edge {
        const int outside = pixel + side;
        if (outside < 0 || outside >= pixels) return Edge{0.5, 0.0, 0.0};
        const double slope = double(v[pixel] - v[outside]);
        const double d = (double(v[pixel]) - cut) / slope;
        return Edge{d, slope, slope * 0.5 * (d * d - d + 1.0 / 6.0)};
    };
    // Derivatives of excess * (position - centre) by the last pixel's weight and by the slope;
    // `arm` is the last pixel's position less the centre.
    auto lever_of = [&](Edge edge, int side, double arm) -> Lever {
        if (edge.slope == 0.0) return Lever{0.0, 0.0};
        const double d = edge.beyond_px, half_b2 = edge.excess / edge.slope;
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
        if (correct_edges) return edge.slope * (2.0 / 3.0) * sqrt(1.0 / 840.0);
        if (weigh_above_threshold) return edge.slope * arm * 0.5 * sqrt(1.0 / 180.0);
        return edge.slope == 0.0 ? 0.0 : step * arm * sqrt(1.0 / 12.0);
    };
    // The first lane writes what all read.
    auto synchronise = [&]() {
#if defined(__CUDA_ARCH__)
        __syncwarp();
#endif
    };
    const bool writes = lane == 0;
    int found = 0, lost = 0;
    for (int from = search(0); from < pixels;) {
        int top = from, threshold = threshold_of(v[from]), right = from;
        while (right + 1 < pixels && v[right + 1] * level_unit > threshold) {
            ++right;
            if (v[right] > v[top]) { top = right; threshold = threshold_of(v[top]); }
        }
        int left = top;
        bool highest = true;
        while (left > 0 && v[left - 1] * level_unit > threshold) {
            --left;
            if (v[left] >= v[top]) { highest = false; break; }
        }
        const int width_px = right - left + 1;
        if (highest && width_px >= min_width_px) {
            // Moments relative to the maximum, exact in 64-bit integers.
            const int base = weigh_above_threshold ? threshold : background;
            long long weight_sum = 0, moment = 0, pixel_sum = 0;
            for (int p = left; p <= right; ++p) {
                const long long weight = (long long)v[p] * level_unit - base;
                weight_sum += weight;
                moment += weight * (p - top);
                pixel_sum += p - top;
            }
            const double cut = double(threshold) / level_unit;
            const Edge at_left = edge_of(left, -1, cut), at_right = edge_of(right, 1, cut);
            double total = double(weight_sum) / level_unit;
            double centre = double(moment) / double(weight_sum);
            if (correct_edges) {
                const double left_px = double(left - top) - at_left.beyond_px;
                const double right_px = double(right - top) + at_right.beyond_px;
                total += at_left.excess + at_right.excess;
                centre = (double(moment) / level_unit + at_left.excess * left_px
                    + at_right.excess * right_px) / total;
            }
            // How the centre, times the total, moves with each value: the edges' pixels first.
            Lever by_left = {0.0, 0.0}, by_right = {0.0, 0.0};
            if (correct_edges) {
                by_left = lever_of(at_left, -1, double(left - top) - centre);
                by_right = lever_of(at_right, 1, double(right - top) - centre);
            }
            // The maximum moves the threshold, and with it every weight.
            double by_threshold = 0.0;
            if (weigh_above_threshold)
                by_threshold = -(double(pixel_sum) - width_px * centre)
                    - by_left.weight - by_right.weight;
            const double by_top = by_threshold * double(fraction_units) / fraction_unit;
            const double top_variance = variance_of(v[top]);
            const double valley2 = detection_sigma * detection_sigma * 2.0 * top_variance;
            double variance = 0.0;
            int flags = left == 0 || right == pixels - 1 ? clipped : 0;
            int high = 0, low = -1;
            for (int p = left; p <= right; ++p) {
                const int value = v[p];
                double lever = double(p - top) - centre;
                if (p == left) lever += by_left.weight + by_left.slope;
                if (p == right) lever += by_right.weight + by_right.slope;
                if (p == top) lever += by_top;
                variance += lever * lever * variance_of(value);
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
                variance += by_left.slope * by_left.slope * variance_of(v[left - 1]);
            if (right < pixels - 1)
                variance += by_right.slope * by_right.slope * variance_of(v[right + 1]);
            if (v[top] >= full_scale) flags |= saturated;
            const double step = cut - double(base) / level_unit;
            const double by_phase_left =
                phase_error(at_left, double(left - top) - at_left.beyond_px - centre, step);
            const double by_phase_right =
                phase_error(at_right, double(right - top) + at_right.beyond_px - centre, step);
            variance += by_phase_left * by_phase_left + by_phase_right * by_phase_right;
            double deviation = sqrt(variance) / total;
            // One pixel: anywhere in it.
            if (width_px == 1) deviation = sqrt(1.0 / 12.0);
            Record record;
            record.position = double(top) + centre;
            record.sigma = (float)deviation;
            record.amplitude = (float)(double(v[top] * level_unit - background) / level_unit);
            record.width = (float)(double(right - left) + at_left.beyond_px + at_right.beyond_px);
            record.flags = flags;
            int place = found;
            if (found < max_peaks) {
                ++found;
            } else {
                // No room: the faintest goes (the last of equals), the others move up.
                lost = 1;
                place = 0;
                for (int k = 1; k < found; ++k)
                    if (records[k].amplitude <= records[place].amplitude) place = k;
                const bool replaces = record.amplitude > records[place].amplitude;
                synchronise();
                if (replaces && writes)
                    for (int k = place; k + 1 < found; ++k) records[k] = records[k + 1];
                place = replaces ? found - 1 : -1;
            }
            if (writes && place >= 0) records[place] = record;
            synchronise();
        }
        from = search(right + 1);
    }
    if (writes) {
        *count = found;
        union { unsigned bits; float value; } nan = {0x7fc00000u};
        const Record none = {double(nan.value), nan.value, nan.value, nan.value, 0};
        for (int k = 0; k < max_peaks; ++k) {
            if (k >= found) records[k] = none;
            else if (lost) records[k].flags |= truncated;
        }
    }
"""

FIND_PEAKS_OF_LINE: Final = _CONSTANTS + _TYPES + _BACKGROUND + _SEARCH + _PEAKS
