"""The Warp kernel that finds the peaks of line scans, on the CPU and on CUDA.

Only ``compute.signal.finder`` imports this module, when a finder is made: it loads Warp.

The kernel is one native snippet, because the compiler vectorises a snippet's search for bright
blocks and does not vectorise a loop of Warp's own (a factor of eight on the CPU). On the CPU one
thread takes a line; on CUDA a warp of 32 takes it: its lanes share the background and the search,
then all walk the same peak, with the same loads, and the first lane writes it. Every decision is
taken in integers, so that both take the same.
"""

from typing import Final

import numpy as np
import warp as wp

from compute.signal.settings import FRACTION_UNIT, GROUP_PIXELS, LEVEL_UNIT, SAMPLE_GROUPS

# Its greeting and its compile times are nothing to a user of ours.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
wp.set_module_options({"enable_backward": False, "fast_math": False})

CUDA_LANES: Final = 32
"""Threads that share a line on CUDA: the size of a warp."""

PEAK_RECORD: Final = np.dtype(
    [
        ("position_px", "<f8"),
        ("sigma_px", "<f4"),
        ("amplitude", "<f4"),
        ("width_px", "<f4"),
        ("flags", "<i4"),
    ]
)
"""One peak as the kernel writes it."""


def line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: the count, then room for its peaks."""
    return np.dtype([("count", "<i4"), ("spare", "<i4"), ("peaks", PEAK_RECORD, (max_peaks,))])


_CONSTANTS = f"""
    const int level_unit = {LEVEL_UNIT};
    const int fraction_unit = {FRACTION_UNIT};
    const int group_pixels = {GROUP_PIXELS};
    const int sample_groups = {SAMPLE_GROUPS};
    const int saturated = 1, clipped = 2, merged = 4, truncated = 8;
"""

_PEAK_STRUCT = """
    struct Record { double position; float sigma, amplitude, width; int flags; };
    const unsigned short* v = (const unsigned short*)line_address;
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
    // The lanes read what the first has written.
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
            long long weight_sum = 0, moment = 0, pixel_sum = 0;
            for (int p = left; p <= right; ++p) {
                const long long weight = (long long)v[p] * level_unit - threshold;
                weight_sum += weight;
                moment += weight * (p - top);
                pixel_sum += p - top;
            }
            const double centre = double(moment) / double(weight_sum);
            const double total = double(weight_sum) / level_unit;
            // The maximum moves the threshold, and with it every weight.
            const double shift = (double(pixel_sum) - width_px * centre)
                * double(fraction_units) / fraction_unit;
            const double top_variance = variance_of(v[top]);
            const double valley2 = detection_sigma * detection_sigma * 2.0 * top_variance;
            double variance = 0.0;
            int flags = left == 0 || right == pixels - 1 ? clipped : 0;
            int high = 0, low = -1;
            for (int p = left; p <= right; ++p) {
                const int value = v[p];
                double lever = double(p - top) - centre;
                if (p == top) lever -= shift;
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
            if (v[top] >= full_scale) flags |= saturated;
            double deviation = sqrt(variance) / total;
            // One pixel: anywhere in it.
            if (width_px == 1) deviation = sqrt(1.0 / 12.0);
            const double rise_px = left > 0 ? (double(v[left]) - double(threshold) / level_unit)
                / double(v[left] - v[left - 1]) : 0.5;
            const double fall_px = right < pixels - 1
                ? (double(v[right]) - double(threshold) / level_unit)
                / double(v[right] - v[right + 1]) : 0.5;
            Record record;
            record.position = double(top) + centre;
            record.sigma = (float)deviation;
            record.amplitude = (float)(double(v[top] * level_unit - background) / level_unit);
            record.width = (float)(double(right - left) + rise_px + fall_px);
            record.flags = flags;
            int place = found;
            if (found == max_peaks) {
                // No room: the faintest goes (the last of equals), the others move up.
                lost = 1;
                place = 0;
                for (int k = 1; k < found; ++k)
                    if (records[k].amplitude <= records[place].amplitude) place = k;
                if (record.amplitude > records[place].amplitude) {
                    if (writes)
                        for (int k = place; k + 1 < found; ++k) records[k] = records[k + 1];
                    place = found - 1;
                } else {
                    place = -1;
                }
                synchronise();
            } else {
                ++found;
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


@wp.func_native(_CONSTANTS + _PEAK_STRUCT + _BACKGROUND + _SEARCH + _PEAKS)
def _find_peaks_of_line(
    line_address: wp.uint64,
    pixels: int,
    lane: int,
    dark_variance: wp.float64,
    photon_variance: wp.float64,
    offset: wp.float64,
    full_scale: int,
    detection_sigma: wp.float64,
    fraction_units: int,
    min_width_px: int,
    max_peaks: int,
    record_address: wp.uint64,
) -> None: ...


@wp.kernel
def find_peaks(
    lines_address: wp.uint64,
    pixels: int,
    lanes: int,
    dark_variance: wp.array(dtype=wp.float64),
    photon_variance: wp.array(dtype=wp.float64),
    offset: wp.array(dtype=wp.float64),
    full_scale: wp.array(dtype=int),
    detection_sigma: wp.float64,
    fraction_units: int,
    min_width_px: int,
    max_peaks: int,
    records_address: wp.uint64,
    record_bytes: int,
):
    """Find the peaks of one line; launch with ``lines * lanes`` threads, blocks of whole warps.

    ``lines_address`` is that of uint16 pixels, shape (L, P), in the device's memory;
    ``records_address`` that of L records of ``line_record(max_peaks)``.
    """
    thread = wp.tid()
    line = thread // lanes
    sensor = line % dark_variance.shape[0]
    _find_peaks_of_line(
        lines_address + wp.uint64(line) * wp.uint64(pixels) * wp.uint64(2),
        pixels,
        thread % lanes,
        dark_variance[sensor],
        photon_variance[sensor],
        offset[sensor],
        full_scale[sensor],
        detection_sigma,
        fraction_units,
        min_width_px,
        max_peaks,
        records_address + wp.uint64(line) * wp.uint64(record_bytes),
    )
