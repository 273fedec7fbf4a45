// The search on the CPU: one thread takes a scan from its first pixel to its last.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/background_ramp.h"
#include "compute/signal/native/centroid.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

#if !defined(__CUDA_ARCH__)

namespace lumiline::signal {

// The record of a scan whose peaks come one after another.
struct ScanRecord {
    const Search& search;
    int* const head;
    PeakRecord* const records;
    int found = 0, lost = 0;

    LUMILINE_FN ScanRecord(const Search& from, int number)
        : search(from),
          head((int*)from.record_of(number)),
          records((PeakRecord*)(from.record_of(number) + 8)) {}

    LUMILINE_FN void add(const PeakRecord& record) {
        if (found < search.max_peaks) {
            records[found++] = record;
            return;
        }
        lost = flag_truncated;
        const int place = make_room(search, records, record.amplitude);
        if (place >= 0) records[place] = record;
    }

    LUMILINE_FN void finish(int background) {
        head[0] = found;
        head[1] = background;
        const PeakRecord none = empty_record();
        for (int k = 0; k < search.max_peaks; ++k) {
            if (k >= found)
                records[k] = none;
            else
                records[k].flags |= lost;
        }
    }
};

// Looks for bright pixels: `limit_of` gives the least bright count of the pixels from one to
// another.
template <class LimitOf>
struct BrightParts {
    struct Block {
        char pixels[256];
    };

    struct Piece {
        char pixels[64];
    };

    struct Part {
        char pixels[8];
    };

    const unsigned short* const v;
    const int pixels;
    const LimitOf limit_of;

    // Whether all of some pixels are dark, by their maximum, which the compiler vectorises.
    template <class Size>
    LUMILINE_FN bool are_dark(int p) const {
        unsigned short top = 0;
        for (int i = 0; i < (int)sizeof(Size); ++i) top = v[p + i] > top ? v[p + i] : top;
        return top < limit_of(p, p + (int)sizeof(Size) - 1);
    }

    LUMILINE_FN bool is_bright(int p) const { return p + 8 <= pixels && !are_dark<Part>(p); }

    // The first of eight pixels, from `from` on, of which one is bright. At the scan's end they may
    // be fewer, and dark.
    LUMILINE_FN int next(int from) const {
        int p = from;
        for (; p + 256 <= pixels; p += 256) {
            // The next line's: what a CPU fetches ahead by itself ends with the page.
            for (int i = 0; i < 256; i += 32) __builtin_prefetch(v + p + pixels + i);
            if (!are_dark<Block>(p)) break;
        }
        while (p + 64 <= pixels && are_dark<Piece>(p)) p += 64;
        while (p + 8 <= pixels && are_dark<Part>(p)) p += 8;
        return p;
    }
};

template <class LimitOf>
LUMILINE_FN BrightParts<LimitOf> bright_parts(const unsigned short* v, int pixels,
                                              LimitOf limit_of) {
    return BrightParts<LimitOf>{v, pixels, limit_of};
}

// Finds the peaks in pixels that are taken as they are.
LUMILINE_FN void collect_peaks(const Search& search, const Scan& scan, int limit, int number) {
    const unsigned short* v = scan.v;
    const auto parts = bright_parts(v, search.pixels, [=](int, int) { return limit; });
    auto next_bright = [&](int from) -> int {
        int p = parts.next(from);
        while (p < search.pixels && v[p] < limit) ++p;
        return p;
    };
    ScanRecord record(search, number);
    for (int p = next_bright(0); p < search.pixels; p = next_bright(p)) {
        // Up to the next maximum: what is on the way down has a higher neighbour.
        while (p + 1 < search.pixels && v[p + 1] > v[p]) ++p;
        Run run;
        if (is_peak(search, Bare{}, v, scan.background, p, run)) {
            record.add(measure(search, scan, v, run, v[p]));
            p = run.right;
        }
        ++p;
        while (p < search.pixels && v[p] <= v[p - 1]) ++p;
    }
    record.finish(scan.background);
}

// Whether a maximum of adjusted pixels is a peak's, and the peak.
template <class Pixels>
LUMILINE_FN bool measure_adjusted(const Search& search, const Scan& scan, const AdjustedPixels& all,
                                  const Pixels& v, int top, Run& run, PeakRecord& record) {
    if (!is_peak(search, Bare{}, v, scan.background, top, run)) return false;
    record = measure(search, scan, v, run, all.raw_count(top));
    return true;
}

// As collect_peaks, of pixels that are corrected, or whose background has a slope. A copy of their
// own: what is given by reference has to lie in memory, also for the other scans.
LUMILINE_NOINLINE void collect_adjusted_peaks(Search search, Scan scan, int limit, int number) {
    const AdjustedPixels all = search.adjusted(scan, scan.v);
    const int pixels = search.pixels;
    const auto parts = bright_parts(scan.v, pixels, [&](int first, int last) {
        return raw_limit_of(search, scan, limit, first, last);
    });
    AdjustedWindow window;
    ScanRecord record(search, number);
    for (int part = parts.next(0); part < pixels; part = parts.next(part)) {
        do {
            const int end = smaller(part + 8, pixels);
            if (window.lacks(all, end + 16)) window.fill(all, part);
            for (int top = part; top < end; ++top) {
                const int value = window[top];
                if (value < limit || value <= window[top - 1] || value < window[top + 1]
                    || !is_bright(search, scan, limit, top, value, scan.v[top]))
                    continue;
                Run run = {};
                run.left = run.right = top;
                PeakRecord found;
                bool good = measure_adjusted(search, scan, all, window, top, run, found);
                if (window.cuts(all, run.left, run.right))
                    good = measure_adjusted(search, scan, all, all, top, run, found);
                if (good) record.add(found);
            }
            part = end;
        } while (parts.is_bright(part));
    }
    record.finish(scan.background);
}

// Finds the peaks of scan `number`.
LUMILINE_FN void find_peaks_on_cpu(const Search& search, int number) {
    if (number >= search.scans) return;
    Scan scan = search.scan_of(number, number % search.sensors);
    const unsigned short* v = scan.v;
    const int groups = search.groups(), group_step = search.group_step();
    int keys[sample_groups];
    for (int g = 0; g < sample_groups; ++g)
        keys[g] = g < groups ? search.group_key(v, g, group_step) : no_key;
    if (search.corrections != nullptr)
        for (int g = 0; g < groups; ++g) keys[g] = search.shifted_key(scan.sensor, keys[g], g);
    // All ranks side by side, which the compiler vectorises.
    int ranks[sample_groups] = {0};
    for (int j = 0; j < sample_groups; ++j)
        for (int g = 0; g < sample_groups; ++g) ranks[g] += keys[j] < keys[g];
    const int rank_of_quartile = search.rank_of_quartile(groups);
    const int rank_of_sixteenth = search.rank_of_sixteenth(groups);
    int quartile = 0, sixteenth = 0;
    for (int g = 0; g < sample_groups; ++g) {
        quartile += ranks[g] == rank_of_quartile ? keys[g] : 0;
        sixteenth += ranks[g] == rank_of_sixteenth ? keys[g] : 0;
    }
    int contrast = 0;
    for (int g = 0; g < sample_groups; ++g)
        contrast += ranks[g] <= rank_of_quartile ? 2 * g - (groups - 1) : 0;
    SlopedBackground found = {0, quartile, sixteenth};
    if (is_sloped(groups, rank_of_quartile, contrast))
        found = estimate_ramp(search, scan.sensor, v, found);
    scan.ramp = found.ramp;
    const Level level = search.level_of(scan, found.quartile, found.sixteenth);
    scan.background = level.background;
    if (scan.ramp != 0 || search.corrections != nullptr)
        collect_adjusted_peaks(search, scan, level.limit, number);
    else
        collect_peaks(search, scan, level.limit, number);
}

}  // namespace lumiline::signal

#endif
