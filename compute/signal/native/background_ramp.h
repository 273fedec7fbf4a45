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

// The median of the slopes between the dark groups of a scan's four quarters, of which a quarter
// may be covered by light [1 / ramp_unit counts per pixel].
LUMILINE_FN int median_ramp(const Search& search, const int* dark, int part, int group_step) {
    long long slopes[6];
    int place[4], count = 0;
    for (int q = 0; q < 4; ++q)
        place[q] = search.start_of_group(q * part, group_step)
                   + search.start_of_group(q * part + part - 1, group_step);
    for (int a = 0; a < 4; ++a)
        for (int b = a + 1; b < 4; ++b) {
            const long long rise = (long long)(dark[b] - dark[a]) * (2 * ramp_unit / group_pixels);
            const long long slope = rise / (place[b] - place[a]);
            int k = count++;
            for (; k > 0 && slopes[k - 1] > slope; --k) slopes[k] = slopes[k - 1];
            slopes[k] = slope;
        }
    return (int)((slopes[2] + slopes[3]) / 2);
}

// A group's key without what the background's slope adds to its sum.
LUMILINE_FN int key_beside(const Search& search, int ramp, int key, int group, int group_step) {
    const int start = search.start_of_group(group, group_step);
    const int rise = (group_pixels / 2)
                     * (ramp_at(ramp, search.pixels, start)
                        + ramp_at(ramp, search.pixels, start + group_pixels - 1));
    return larger(key - rise * sample_groups, group);
}

// The background with a slope, if that explains what the groups differ by, or else the one without.
LUMILINE_FN SlopedBackground better_of(SlopedBackground level, SlopedBackground sloped) {
    const bool explains = sloped.quartile / sample_groups - sloped.sixteenth / sample_groups
                          < level.quartile / sample_groups - level.sixteenth / sample_groups;
    return sloped.ramp != 0 && explains ? sloped : level;
}

#if !defined(__CUDA_ARCH__)
// The background's slope by all groups of a scan. Search and ranks come and go by value: what is
// given by reference has to lie in memory, also for the scans without a slope.
LUMILINE_NOINLINE SlopedBackground estimate_ramp(Search search, int sensor, const unsigned short* v,
                                                 SlopedBackground level) {
    const int groups = search.groups(), group_step = search.group_step(), part = groups / 4;
    int keys[sample_groups], dark[4];
    for (int g = 0; g < groups; ++g) {
        keys[g] = search.group_key(v, g, group_step);
        if (search.corrections != nullptr) keys[g] = search.shifted_key(sensor, keys[g], g);
    }
    for (int q = 0; q < 4; ++q) {
        int key = 0;
        keys_of_ranks(keys + q * part, part, (part - 1) / 4, (part - 1) / 4, &key, &key);
        dark[q] = key / sample_groups;
    }
    const int ramp = median_ramp(search, dark, part, group_step);
    for (int g = 0; g < groups; ++g) keys[g] = key_beside(search, ramp, keys[g], g, group_step);
    SlopedBackground sloped = {ramp, 0, 0};
    keys_of_ranks(keys, groups, Search::rank_of_quartile(groups), Search::rank_of_sixteenth(groups),
                  &sloped.quartile, &sloped.sixteenth);
    return better_of(level, sloped);
}
#else
// The key of a rank among those of the lanes from `first` to `end`.
LUMILINE_FN int key_of_rank(int key, int first, int end, int rank) {
    const int lane = threadIdx.x % 32;
    int below = 0;
    for (int j = first; j < end; ++j) below += __shfl_sync(0xffffffffu, key, j) < key;
    const bool found = lane >= first && lane < end && below == rank;
    return __shfl_sync(0xffffffffu, key, __ffs(__ballot_sync(0xffffffffu, found)) - 1);
}

// The same by a warp, whose lanes have a group's key each.
LUMILINE_FN SlopedBackground estimate_ramp(const Search& search, int key, SlopedBackground level) {
    const int groups = search.groups(), group_step = search.group_step(), part = groups / 4;
    int dark[4];
    for (int q = 0; q < 4; ++q)
        dark[q] = key_of_rank(key, q * part, q * part + part, (part - 1) / 4) / sample_groups;
    const int ramp = median_ramp(search, dark, part, group_step), lane = threadIdx.x % 32;
    const int beside = key_beside(search, ramp, key, lane, group_step);
    return better_of(
        level,
        SlopedBackground{ramp, key_of_rank(beside, 0, groups, Search::rank_of_quartile(groups)),
                         key_of_rank(beside, 0, groups, Search::rank_of_sixteenth(groups))});
}
#endif

}  // namespace lumiline::signal
