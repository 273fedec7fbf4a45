// The search on the CPU: one thread takes a scan from its first pixel to its last.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/background_ramp.h"
#include "compute/signal/native/centroid.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

#if !defined(__CUDA_ARCH__)

namespace lumiline::signal {

// Finds the peaks in pixels at the limit or above it.
template <class Pixels>
LUMILINE_FN void collect_peaks(const Search& search, const Scan& scan, Pixels& v, int limit,
                               int number) {
    const unsigned short* raw = scan.v;
    // Whether a block has no pixel at the limit; its maximum is what the compiler vectorises.
    auto is_dark = [&](int p, auto size) -> bool {
        unsigned short top = 0;
        for (int i = 0; i < (int)sizeof size; ++i) top = raw[p + i] > top ? raw[p + i] : top;
        return top < raw_limit_of(v, limit, p, p + (int)sizeof size - 1);
    };

    // The next pixel at the limit or above it; search.pixels when there is none.
    auto next_bright = [&](int from) -> int {
        struct Block {
            char pixels[256];
        };
        struct Piece {
            char pixels[64];
        };
        struct Part {
            char pixels[8];
        };
        for (int p = from;;) {
            for (; p + 256 <= search.pixels; p += 256) {
                // The next line's: what a CPU fetches ahead by itself ends with the page.
                for (int i = 0; i < 256; i += 32) __builtin_prefetch(raw + p + search.pixels + i);
                if (!is_dark(p, Block{})) break;
            }
            while (p + 64 <= search.pixels && is_dark(p, Piece{})) p += 64;
            while (p + 8 <= search.pixels && is_dark(p, Part{})) p += 8;
            const int end = smaller(p + 8, search.pixels);
            fetch(v, p);
            while (p < end && v[p] < limit) ++p;
            if (p < end || p >= search.pixels) return p;
        }
    };

    int* head = (int*)search.record_of(number);
    PeakRecord* records = (PeakRecord*)(search.record_of(number) + 8);
    int found = 0, lost = 0;
    for (int p = next_bright(0); p < search.pixels; p = next_bright(p)) {
        // Up to the next maximum: what is on the way down has a higher neighbour.
        while (p + 1 < search.pixels && v[p + 1] > v[p]) ++p;
        Run run;
        if (is_bright(search, scan, v, limit, p)
            && is_peak(search, Bare{}, v, scan.background, p, run)) {
            const PeakRecord record = measure(search, scan, v, run);
            if (found < search.max_peaks) {
                records[found++] = record;
            } else {
                lost = flag_truncated;
                const int place = make_room(search, records, record.amplitude);
                if (place >= 0) records[place] = record;
            }
            p = run.right;
        }
        ++p;
        while (p < search.pixels && v[p] <= v[p - 1]) ++p;
    }
    head[0] = found;
    head[1] = scan.background;
    const PeakRecord none = empty_record();
    for (int k = 0; k < search.max_peaks; ++k) {
        if (k >= found)
            records[k] = none;
        else
            records[k].flags |= lost;
    }
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
    if (scan.sensor != nullptr)
        for (int g = 0; g < groups; ++g) keys[g] = Search::shifted_key(scan, keys[g], g);
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
    if (is_sloped(groups, rank_of_quartile, contrast))
        scan.ramp = estimate_ramp(search, scan, v, &quartile, &sixteenth);
    const Level level = search.level_of(scan, quartile, sixteenth);
    scan.background = level.background;
    if (scan.is_adjusted()) {
        BufferedPixels adjusted(scan.adjusted(v, search.pixels));
        collect_peaks(search, scan, adjusted, level.limit, number);
    } else {
        collect_peaks(search, scan, v, level.limit, number);
    }
}

}  // namespace lumiline::signal

#endif
