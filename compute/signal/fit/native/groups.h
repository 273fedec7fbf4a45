// A scan's groups: candidates that are fitted together, and their windows.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/fit_scan.h"
#include "compute/signal/native/centroid.h"

namespace lumiline::signal {

// The width that a fit of a candidate begins with [px].
LUMILINE_FN double start_width(const FitScan& scan, const PeakRecord& c) {
    if (!scan.plan.width_is_fitted) return scan.plan.width_px;
    double w = (double)c.width_px / scan.plan.width_unit;
    if (w < scan.plan.min_start) w = scan.plan.min_start;
    if (w > scan.plan.max_start) w = scan.plan.max_start;
    return w;
}

LUMILINE_FN int half_window(const FitScan& scan, const PeakRecord& c) {
    const int h = (int)ceil(scan.plan.reach * start_width(scan, c)) + 1;
    return h < max_window / 2 - 1 ? h : max_window / 2 - 1;
}

LUMILINE_FN int pixel_of(const PeakRecord& c) { return (int)floor(c.position_px + 0.5); }

LUMILINE_FN int end_of_group(const FitScan& scan, int begin) {
    int end = begin + 1;
    while (end < scan.candidate_count && !(scan.candidates[end].flags & flag_starts_group)) ++end;
    return end;
}

// First and last pixel of candidates, not yet cut at neighbours and at the line's ends.
LUMILINE_FN void span_of(const FitScan& scan, int begin, int end, int* first, int* last) {
    for (int k = begin; k < end; ++k) {
        const int c = pixel_of(scan.candidates[k]), h = half_window(scan, scan.candidates[k]);
        if (k == begin || c - h < *first) *first = c - h;
        if (k == begin || c + h > *last) *last = c + h;
    }
}

// Mark where groups start: first where windows do not touch, then cut what is too much.
// Candidate g then also has the number of the candidate that group g begins with.
LUMILINE_FN int mark_groups(const FitScan& scan) {
    for (int k = 0; k < scan.candidate_count; ++k) {
        PeakRecord& c = scan.candidates[k];
        c.flags &= flag_starts_group - 1;
        if (k == 0) {
            c.flags |= flag_starts_group;
            continue;
        }
        const PeakRecord& before = scan.candidates[k - 1];
        if (pixel_of(before) + half_window(scan, before) < pixel_of(c) - half_window(scan, c))
            c.flags |= flag_starts_group;
    }
    for (int begin = 0; begin < scan.candidate_count;) {
        const int end = end_of_group(scan, begin);
        int first = 0, last = 0;
        span_of(scan, begin, end, &first, &last);
        if (end - begin <= scan.plan.max_joint_peaks && last - first < max_window) {
            begin = end;
            continue;
        }
        int widest = begin + 1;
        for (int k = begin + 2; k < end; ++k)
            if (scan.candidates[k].position_px - scan.candidates[k - 1].position_px
                > scan.candidates[widest].position_px - scan.candidates[widest - 1].position_px)
                widest = k;
        scan.candidates[widest].flags |= flag_starts_group | flag_after_cut;
    }
    int groups = 0;
    for (int k = 0; k < scan.candidate_count; ++k)
        if (scan.candidates[k].flags & flag_starts_group)
            scan.candidates[groups++].flags |= k << begin_bits;
    return groups;
}

LUMILINE_FN int begin_of_group(const FitScan& scan, int group) {
    return scan.candidates[group].flags >> begin_bits;
}

// The pixels of a group's fit, cut midway to its neighbours and at the scan's ends.
LUMILINE_FN void window_of(const FitScan& scan, int begin, int end, int* first, int* last) {
    span_of(scan, begin, end, first, last);
    if (begin > 0) {
        const double sum =
            scan.candidates[begin - 1].position_px + scan.candidates[begin].position_px;
        const int from = (int)floor(0.5 * sum) + 1;
        if (*first < from) *first = from;
    }
    if (end < scan.candidate_count) {
        const double sum = scan.candidates[end - 1].position_px + scan.candidates[end].position_px;
        const int to = (int)floor(0.5 * sum);
        if (*last > to) *last = to;
    }
    if (*first < 0) *first = 0;
    if (*last > scan.pixels - 1) *last = scan.pixels - 1;
}

// More of the line, as far as midway to the neighbouring groups' windows.
LUMILINE_FN void grown_window_of(const FitScan& scan, int begin, int end, int first, int last,
                                 int* wide_first, int* wide_last) {
    int by = (max_window - (last - first + 1)) / 2, other_first = 0, other_last = 0;
    int most = 0;
    for (int k = begin; k < end; ++k)
        if (half_window(scan, scan.candidates[k]) > most)
            most = half_window(scan, scan.candidates[k]);
    if (most < by) by = most;
    *wide_first = first - by > 0 ? first - by : 0;
    *wide_last = last + by < scan.pixels - 1 ? last + by : scan.pixels - 1;
    if (begin > 0) {
        int other = begin - 1;
        while (!(scan.candidates[other].flags & flag_starts_group)) --other;
        window_of(scan, other, begin, &other_first, &other_last);
        const int from = (other_last + first) / 2 + 1;
        if (*wide_first < from) *wide_first = from;
    }
    if (end < scan.candidate_count) {
        window_of(scan, end, end_of_group(scan, end), &other_first, &other_last);
        const int to = (last + other_first) / 2;
        if (*wide_last > to) *wide_last = to;
    }
}

// Pixels beside a window: their number, sums of counts and of places.
struct Half {
    int used = 0, places = 0;
    double counts = 0.0;

    LUMILINE_FN void take(const FitScan& scan, int from, int to, int origin) {
        if (scan.corrections != nullptr) {
            for (int i = from; i < to; ++i) {
                if (!scan.is_used(i)) continue;
                ++used;
                places += i - origin;
                counts += scan.count_at(i);
            }
            return;
        }
        int sum = 0;
        for (int i = from; i < to; ++i) {
            const int count = scan.v[i], counts_too = count < scan.full_scale;
            used += counts_too;
            places += counts_too ? i - origin : 0;
            sum += counts_too ? count : 0;
        }
        counts = (double)sum;
    }
};

// The inner and the outer half of one side. No division: on CUDA that is a subroutine.
struct Side {
    Half halves[2];

    LUMILINE_FN int used() const { return halves[0].used + halves[1].used; }

    LUMILINE_FN double counts() const { return halves[0].counts + halves[1].counts; }

    LUMILINE_FN double places() const { return (double)(halves[0].places + halves[1].places); }

    LUMILINE_FN void take(const FitScan& scan, int from, int to, int origin) {
        const int middle = (from + to) / 2;
        halves[0].take(scan, from, middle, origin);
        halves[1].take(scan, middle, to, origin);
    }

    // Whether both halves' means lie on a line of this slope, within their noise.
    LUMILINE_FN bool is_straight(double slope, double variance) const {
        const double before = halves[0].used, behind = halves[1].used;
        if (before == 0.0 || behind == 0.0) return false;
        // All times both numbers of pixels.
        const double rise = halves[1].counts * before - halves[0].counts * behind;
        const double run = halves[1].places * before - halves[0].places * behind;
        const double off = rise - slope * run;
        return off * off <= surrounding_limit2 * variance * (before + behind) * (before * behind);
    }
};

// Takes the background's level and slope from the pixels on both sides of a window, if they lie on
// a straight line; see FitSettings.
LUMILINE_FN void take_surroundings(FitScan& scan, int begin, int end, int first, int last) {
    int from = first - surrounding_pixels, to = last + 1 + surrounding_pixels;
    if (from < 0) from = 0;
    if (to > scan.pixels) to = scan.pixels;
    if (first - from < min_surrounding_pixels || to - last - 1 < min_surrounding_pixels) return;
    int other_first = 0, other_last = 0;
    if (begin > 0) {
        int other = begin - 1;
        while (!(scan.candidates[other].flags & flag_starts_group)) --other;
        window_of(scan, other, begin, &other_first, &other_last);
        if (from <= other_last) from = other_last + 1;
    }
    if (end < scan.candidate_count) {
        window_of(scan, end, end_of_group(scan, end), &other_first, &other_last);
        if (to > other_first) to = other_first;
    }
    if (first - from < min_surrounding_pixels || to - last - 1 < min_surrounding_pixels) return;
    Side left, right;
    left.take(scan, from, first, first);
    right.take(scan, last + 1, to, first);
    const double used_left = left.used(), used_right = right.used();
    if (used_left < min_surrounding_pixels || used_right < min_surrounding_pixels) return;
    const double of_left = left.counts() * used_right, of_right = right.counts() * used_left;
    const double run = right.places() * used_left - left.places() * used_right;
    const double slope = (of_right - of_left) * fast_inverse(run);
    const double level = 0.5 * (of_right + of_left) * fast_inverse(used_left * used_right);
    const double above = level > scan.offset ? level - scan.offset : 0.0;
    const double variance = scan.dark + scan.photon * above;
    if (!left.is_straight(slope, variance) || !right.is_straight(slope, variance)) return;
    scan.level = level;
    scan.slope = slope;
}

}  // namespace lumiline::signal
