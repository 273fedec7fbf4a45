// The fit: from a scan's candidates to its fitted peaks, on the CPU and on CUDA.
//
// Both round alike: no fused multiply-adds, no library functions but the exact ones, sums in the
// order of the pixels. So both take the same decisions. On the CPU one thread takes a scan. On CUDA
// a warp takes a few, and each lane one group. A candidate is a peak of the search, a group the
// candidates that are fitted together.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/fit/native/fit_scan.h"
#include "compute/signal/fit/native/groups.h"
#include "compute/signal/fit/native/joint_fit.h"
#include "compute/signal/fit/native/single_fit.h"
#include "compute/signal/native/find_peaks.h"

namespace lumiline::signal {

// Fits the group that starts with candidate `begin` into `out`; returns the number of peaks.
// Kernels for scans with and without a calibration are apart: one of both is slower.
template <bool corrected>
LUMILINE_FN int fit_group(FitScan& scan, int begin, FittedPeak* out) {
    const int end = end_of_group(scan, begin);
    int first = 0, last = 0;
    window_of(scan, begin, end, &first, &last);
    scan.level = scan.background_counts;
    scan.slope = 0.0;
    if (scan.plan.surrounded) take_surroundings(scan, begin, end, first, last);
    int written = 0;
    if (end - begin == 1)
        written = fit_single<corrected>(scan, scan.candidates[begin], first, last, out);
    if (written == 0) written = fit_jointly(scan, begin, end, first, last, out);
    if (written == 0) {
        for (int k = begin; k < end; ++k) {
            const PeakRecord& c = scan.candidates[k];
            const int flags = (c.flags & (flag_starts_group - 1)) | flag_unfitted;
            out[written++] = FittedPeak{c.position_px, c.sigma_px,  c.amplitude,       c.width_px,
                                        flags,         quiet_nan(), {0.0f, 0.0f, 0.0f}};
        }
    }
    // Behind a cut there is light of neighbours that was not fitted with this.
    if (scan.candidates[begin].flags & flag_after_cut) out[0].flags |= flag_merged;
    if (end < scan.candidate_count && (scan.candidates[end].flags & flag_after_cut))
        out[written - 1].flags |= flag_merged;
    if (scan.candidates[begin].flags & flag_truncated)
        for (int k = 0; k < written; ++k) out[k].flags |= flag_truncated;
    return written;
}

// Peaks come in the order of their positions. Where there is no room, the faintest goes (the last
// of equals), the others move up. Those before it keep their covariances with those behind it.
LUMILINE_FN void drop_covariances(FitScan& scan, int index) {
    for (int back = 1; back < joint_peaks && back <= index; ++back) {
        float* covariance = scan.records[index - back].covariance_px2;
        for (int k = back - 1; k < 2; ++k) covariance[k] = covariance[k + 1];
        covariance[2] = 0.0f;
    }
}

LUMILINE_FN void place_peak(FitScan& scan, const FittedPeak& peak) {
    if (scan.count[0] == scan.max_peaks) {
        scan.count[1] = flag_truncated;
        int faintest = 0;
        for (int k = 1; k < scan.max_peaks; ++k)
            if (scan.records[k].amplitude <= scan.records[faintest].amplitude) faintest = k;
        if (scan.records[faintest].amplitude >= peak.amplitude) {
            drop_covariances(scan, scan.max_peaks);
            return;
        }
        drop_covariances(scan, faintest);
        scan.count[0] -= 1;
        for (int k = faintest; k < scan.count[0]; ++k) scan.records[k] = scan.records[k + 1];
    }
    scan.records[scan.count[0]++] = peak;
}

LUMILINE_FN void finish_scan(FitScan& scan, int from, int step) {
    const FittedPeak none = {(double)quiet_nan(), quiet_nan(),       quiet_nan(), quiet_nan(), 0,
                             quiet_nan(),         {0.0f, 0.0f, 0.0f}};
    for (int k = from; k < scan.max_peaks; k += step) {
        if (k >= scan.count[0])
            scan.records[k] = none;
        else
            scan.records[k].flags |= scan.count[1];
    }
}

#if !defined(__CUDA_ARCH__)
// Fits the peaks of scan `number`.
template <bool corrected>
LUMILINE_FN void fit_candidates(FitScan& scan, int number) {
    if (number >= scan.search.scans) return;
    scan.take_scan(number);
    scan.count[0] = scan.count[1] = 0;
    const int groups = mark_groups(scan);
    for (int group = 0; group < groups; ++group) {
        FittedPeak fitted[joint_peaks];
        const int size = fit_group<corrected>(scan, begin_of_group(scan, group), fitted);
        for (int k = 0; k < size; ++k) place_peak(scan, fitted[k]);
    }
    finish_scan(scan, 0, 1);
}
#else
// Warp `number` fits the peaks of its scans: each lane marks the groups of one; then each takes one
// group, in their order.
template <bool corrected>
LUMILINE_FN void fit_candidates(FitScan& scan, int number) {
    const int scans = scan.search.scans, scans_per_warp = scan.search.scans_per_warp;
    const int lane = threadIdx.x % 32;
    const unsigned every = 0xffffffffu, before = (1u << lane) - 1u;
    const int first_scan = number * scans_per_warp;
    if (first_scan >= scans) return;
    const int slots = smaller(scans - first_scan, scans_per_warp);
    // The candidates were written by other lanes.
    __syncwarp();
    int groups = 0;
    if (lane < slots) {
        scan.take_scan(first_scan + lane);
        scan.count[0] = scan.count[1] = 0;
        groups = mark_groups(scan);
    }
    __syncwarp();
    // Groups of this scan and those before it.
    int up_to = groups;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(every, up_to, step);
        if (lane >= step) up_to += other;
    }
    const int all_groups = __shfl_sync(every, up_to, 31);
    for (int start = 0; start < all_groups; start += 32) {
        const int group = start + lane;
        const bool active = group < all_groups;
        int slot = 0, earlier = 0;
        for (int k = 0; k < slots; ++k) {
            const int end = __shfl_sync(every, up_to, k);
            if (group >= end) {
                slot = k + 1;
                earlier = end;
            }
        }
        FittedPeak fitted[joint_peaks];
        int size = 0;
        if (active) {
            scan.take_scan(first_scan + slot);
            size = fit_group<corrected>(scan, begin_of_group(scan, group - earlier), fitted);
        }
        __syncwarp();
        // Lanes of the same scan; idle ones are of none.
        const unsigned same = __match_any_sync(every, active ? slot : -1);
        int at = active ? scan.count[0] : 0, total = at;
#pragma unroll
        for (int k = 0; k < joint_peaks; ++k) {
            const unsigned have = __ballot_sync(every, size > k) & same;
            at += __popc(have & before);
            total += __popc(have);
        }
        if (__all_sync(every, !active || total <= scan.max_peaks)) {
            for (int k = 0; k < size; ++k) scan.records[at + k] = fitted[k];
            if (active && (same & before) == 0u) scan.count[0] = total;
        } else {
            for (int owner = 0; owner < 32; ++owner) {
                if (owner == lane)
                    for (int k = 0; k < size; ++k) place_peak(scan, fitted[k]);
                __syncwarp();
            }
        }
        __syncwarp();
    }
    for (int slot = 0; slot < slots; ++slot) {
        scan.take_scan(first_scan + slot);
        finish_scan(scan, lane, 32);
    }
}
#endif

// Finds the candidates of scan `number` (on CUDA, of the scans of warp `number`) and fits them;
// `candidates_offset` is where in a scan's record they begin.
template <bool corrected>
LUMILINE_FN void fit_peaks(const Search& search, unsigned long long plan_address,
                           int candidates_offset, int number) {
    Search candidates = search;
    candidates.records_address += candidates_offset;
    find_peaks<candidate_scans_per_batch, Length::any, corrected>(candidates, number);
    FitScan scan(search, plan_address);
    fit_candidates<corrected>(scan, number);
}

}  // namespace lumiline::signal
