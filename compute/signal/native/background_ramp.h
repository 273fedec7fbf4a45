// The slope of a scan's background. Few scans have one: only they come here.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

namespace lumiline::signal {

// A background's slope, and the keys of its ranks beside it.
struct SlopedBackground {
    int ramp, quartile, sixteenth;
};

// Whether the darkest groups lie to one side, by the sum of their places 2 g - (groups - 1): beyond
// 3.2 standard deviations of a random choice, or as far as can be.
LUMILINE_FN bool is_sloped(int groups, int rank_of_quartile, int contrast) {
    const int dark = rank_of_quartile + 1, bright = groups - dark, farthest = dark * bright;
    return contrast * contrast >= smaller(10 * farthest * (groups + 1) / 3, farthest * farthest);
}

// The number of keys below each, and the keys of two ranks.
LUMILINE_FN void keys_of_ranks(const int* keys, int count, int first, int second, int* first_key,
                               int* second_key) {
    for (int g = 0; g < count; ++g) {
        int rank = 0;
        for (int j = 0; j < count; ++j) rank += keys[j] < keys[g];
        if (rank == first) *first_key = keys[g];
        if (rank == second) *second_key = keys[g];
    }
}

// A straight line through the dark groups of the scan's four quarters: the median of the slopes
// between two of them [1 / ramp_unit counts per pixel]; a quarter of them may be covered by light.
// The keys of the background's ranks become those beside the line; 0, and they stay, where the line
// does not explain what the groups differ by.
// Search and ranks come and go by value: what is given by reference has to lie in memory, also for
// the scans without a slope.
LUMILINE_NOINLINE SlopedBackground estimate_ramp(Search search, int sensor, const unsigned short* v,
                                                 SlopedBackground level) {
    const int groups = search.groups(), group_step = search.group_step(), part = groups / 4;
    int keys[sample_groups], dark[4], place[4];
    for (int g = 0; g < groups; ++g) {
        keys[g] = search.group_key(v, g, group_step);
        if (search.corrections != nullptr) keys[g] = search.shifted_key(sensor, keys[g], g);
    }
    for (int q = 0; q < 4; ++q) {
        int key = 0;
        keys_of_ranks(keys + q * part, part, (part - 1) / 4, (part - 1) / 4, &key, &key);
        dark[q] = key / sample_groups;
        place[q] = search.start_of_group(q * part, group_step)
                   + search.start_of_group(q * part + part - 1, group_step);
    }
    long long slopes[6];
    int count = 0;
    for (int a = 0; a < 4; ++a)
        for (int b = a + 1; b < 4; ++b) {
            const long long rise = (long long)(dark[b] - dark[a]) * (2 * ramp_unit / group_pixels);
            const long long slope = rise / (place[b] - place[a]);
            int k = count++;
            for (; k > 0 && slopes[k - 1] > slope; --k) slopes[k] = slopes[k - 1];
            slopes[k] = slope;
        }
    const int ramp = (int)((slopes[2] + slopes[3]) / 2);
    for (int g = 0; g < groups; ++g) {
        const int start = search.start_of_group(g, group_step);
        const int rise = (group_pixels / 2)
                         * (ramp_at(ramp, search.pixels, start)
                            + ramp_at(ramp, search.pixels, start + group_pixels - 1));
        keys[g] = larger(keys[g] - rise * sample_groups, g);
    }
    SlopedBackground beside = {ramp, 0, 0};
    keys_of_ranks(keys, groups, Search::rank_of_quartile(groups), Search::rank_of_sixteenth(groups),
                  &beside.quartile, &beside.sixteenth);
    if (ramp == 0
        || beside.quartile / sample_groups - beside.sixteenth / sample_groups
               >= level.quartile / sample_groups - level.sixteenth / sample_groups)
        return level;
    return beside;
}

}  // namespace lumiline::signal
