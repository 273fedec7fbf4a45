// Joint association events of a cluster of tracks and peaks, and their marginal probabilities:
// compute.tracking.joint_events.
#pragma once

#include "compute/native/platform.h"
#include "compute/tracking/native/definitions.gen.h"

namespace lumiline::tracking {

constexpr double two_pi = 6.283185307179586, log_two = 0.6931471805599453;

typedef unsigned long long Bits;

// One way to read one track, or two (two >= 0) whose stripes have merged, from a peak.
struct Option {
    int one, two, peak;
    double weight;
};

// What is assigned so far: option[t] is the option of track t, -1: none; only where t is the
// option's first track.
struct PartialEvent {
    double weight;
    Bits assigned_peaks, read_tracks, merged_peaks;
    short option[max_cluster_tracks];
};

static_assert(sizeof(PartialEvent) == partial_event_bytes, "PartialEvent as in Python");

// A normal density by the squared distance in sigmas.
LUMILINE_FN double normal_density(double off, double total) {
    return exp(-0.5 * off) / sqrt(two_pi * total);
}

// The probability that two peaks this far apart are found as one.
LUMILINE_FN double merge_probability(double apart, double variance, double resolution) {
    const double widening = 1.0 + 2.0 * log_two * variance / (resolution * resolution);
    return exp(-log_two * apart * apart / (resolution * resolution * widening)) / sqrt(widening);
}

// The variance of where a merged peak lies between its two tracks.
LUMILINE_FN double merged_variance(double a, double va, double b, double vb) {
    return merged_variance_factor * ((a - b) * (a - b) + va + vb);
}

// The joint events of one cluster, in memory that the job has for them.
struct JointEvents {
    const AssociationJob& job;
    const double detection_probability = job.detection_probability,
                 missed = 1.0 - job.detection_probability;
    const double peak_gain = job.detection_probability / job.clutter_density_per_px,
                 resolution = job.resolution_px;
    const double gate_squared = job.gate_sigma * job.gate_sigma;
    PartialEvent* const partials = (PartialEvent*)job.partials;
    PartialEvent* const grown = partials + job.max_hypotheses;
    int* const order = job.order;
    Option options[max_options];
    double option_probability[max_options];
    double pair_probability[max_cluster_tracks][max_cluster_tracks];
    int first_option[max_cluster_tracks + 1];

    LUMILINE_FN explicit JointEvents(const AssociationJob& from) : job(from) {}

    // Moves the `most` heaviest to the front, in order: a heap of indices.
    LUMILINE_NOINLINE void keep_heaviest(PartialEvent* all, int count, int most) {
        for (int i = 0; i < count; ++i) order[i] = i;
        auto lighter = [&](int a, int b) -> bool {
            return all[a].weight < all[b].weight || (all[a].weight == all[b].weight && a > b);
        };
        auto sink = [&](int at, int end) {
            for (;;) {
                int child = 2 * at + 1;
                if (child >= end) return;
                if (child + 1 < end && lighter(order[child], order[child + 1])) ++child;
                if (!lighter(order[at], order[child])) return;
                const int moved = order[at];
                order[at] = order[child];
                order[child] = moved;
                at = child;
            }
        };
        for (int i = count / 2 - 1; i >= 0; --i) sink(i, count);
        int end = count;
        for (int i = 0; i < most; ++i) {
            const int top = order[0];
            partials[i] = all[top];
            order[0] = order[--end];
            sink(0, end);
        }
    }

    // Probabilities of the options of n tracks (at, va) and m peaks (z, vz); returns the number of
    // options, or -1 where there is not room enough.
    LUMILINE_NOINLINE int evaluate(int n, const double* at, const double* va, int m,
                                   const double* z, const double* vz, double& pruned_fraction) {
        if (n > max_cluster_tracks || m > max_cluster_tracks) return -1;
        for (int i = 0; i < n; ++i)
            for (int j = i + 1; j < n; ++j)
                pair_probability[i][j] = pair_probability[j][i] =
                    merge_probability(at[i] - at[j], va[i] + va[j], resolution);
        int count = 0;
        double factor[max_cluster_tracks + 1];
        for (int i = 0; i < n; ++i) {
            first_option[i] = count;
            double sum = missed;
            for (int k = 0; k < m; ++k) {
                const double total = va[i] + vz[k];
                const double off = (z[k] - at[i]) * (z[k] - at[i]) / total;
                if (off <= gate_squared) {
                    if (count == max_options) return -1;
                    options[count] = {i, -1, k, peak_gain * normal_density(off, total)};
                    sum += options[count++].weight;
                }
                for (int j = i + 1; j < n; ++j) {
                    const double probability = pair_probability[i][j];
                    if (probability < min_merge_probability) continue;
                    const double both = 0.25 * (va[i] + va[j])
                                        + (vz[k] + merged_variance(at[i], va[i], at[j], va[j]));
                    const double away = z[k] - 0.5 * (at[i] + at[j]);
                    const double far = away * away / both;
                    if (far <= gate_squared) {
                        if (count == max_options) return -1;
                        options[count] = {i, j, k,
                                          detection_probability * peak_gain * probability
                                              * normal_density(far, both)};
                        sum += options[count++].weight;
                    }
                }
            }
            factor[i] = larger(sum, 1.0);
        }
        first_option[n] = count;
        // One good event, to compare others with.
        double least = min_relative_weight;
        Bits greedy = 0;
        for (int i = 0; i < n; ++i) {
            double best = -1.0;
            int peak = -1;
            for (int o = first_option[i]; o < first_option[i + 1]; ++o)
                if (options[o].two < 0 && !(greedy >> options[o].peak & 1)
                    && options[o].weight > best) {
                    best = options[o].weight;
                    peak = options[o].peak;
                }
            if (peak < 0 || best < missed)
                least *= missed;
            else {
                least *= best;
                greedy |= 1ull << peak;
            }
        }
        int here = 1;
        partials[0].weight = 1.0;
        partials[0].assigned_peaks = partials[0].read_tracks = partials[0].merged_peaks = 0;
        for (int i = 0; i < n; ++i) partials[0].option[i] = -1;
        double pruned_weight = 0.0;
        for (int i = 0; i < n; ++i) {
            int more = 0;
            for (int p = 0; p < here; ++p) {
                if (more + 1 + first_option[i + 1] - first_option[i] > job.max_grown) return -1;
                const PartialEvent& partial = partials[p];
                grown[more] = partial;
                if (partial.read_tracks >> i & 1) {
                    ++more;
                    continue;
                }
                grown[more++].weight = partial.weight * missed;
                for (int o = first_option[i]; o < first_option[i + 1]; ++o) {
                    const Option& option = options[o];
                    if (partial.assigned_peaks >> option.peak & 1) continue;
                    if (option.two >= 0 && partial.read_tracks >> option.two & 1) continue;
                    double weight = partial.weight * option.weight;
                    if (option.two < 0)
                        for (int t = 0; t < i; ++t) {
                            const int earlier = partial.option[t];
                            if (earlier >= 0 && options[earlier].two < 0)
                                weight *= 1.0 - pair_probability[t][i];
                        }
                    PartialEvent& next = grown[more++];
                    next = partial;
                    next.weight = weight;
                    next.assigned_peaks |= 1ull << option.peak;
                    next.read_tracks |= 1ull << i;
                    if (option.two >= 0) {
                        next.read_tracks |= 1ull << option.two;
                        next.merged_peaks |= 1ull << option.peak;
                    }
                    next.option[i] = (short)o;
                }
            }
            double ahead = 1.0, all = 0.0, kept_weight = 0.0;
            for (int t = i + 1; t < n; ++t) ahead *= factor[t];
            int kept = 0;
            for (int p = 0; p < more; ++p) {
                all += grown[p].weight;
                if (grown[p].weight * ahead >= least) {
                    if (kept != p) grown[kept] = grown[p];
                    ++kept;
                }
            }
            if (kept > job.max_hypotheses) {
                keep_heaviest(grown, kept, (int)job.max_hypotheses);
                kept = (int)job.max_hypotheses;
            } else {
                for (int p = 0; p < kept; ++p) partials[p] = grown[p];
            }
            here = kept;
            for (int p = 0; p < here; ++p) kept_weight += partials[p].weight;
            if (here < more) pruned_weight += larger(all - kept_weight, 0.0) * ahead;
        }
        // Only the most probable of the events that give the same peaks to the same tracks.
        int single = 0;
        for (int p = 0; p < here; ++p) {
            int same = 0;
            while (same < single
                   && !(partials[same].read_tracks == partials[p].read_tracks
                        && partials[same].assigned_peaks == partials[p].assigned_peaks
                        && partials[same].merged_peaks == partials[p].merged_peaks))
                ++same;
            if (same == single) {
                if (single != p) partials[single] = partials[p];
                ++single;
            } else if (partials[p].weight > partials[same].weight)
                partials[same] = partials[p];
        }
        double total = 0.0;
        for (int p = 0; p < single; ++p) total += partials[p].weight;
        for (int o = 0; o < count; ++o) option_probability[o] = 0.0;
        for (int p = 0; p < single; ++p)
            for (int i = 0; i < n; ++i)
                if (partials[p].option[i] >= 0)
                    option_probability[partials[p].option[i]] += partials[p].weight / total;
        pruned_fraction = pruned_weight / total;
        return count;
    }
};

}  // namespace lumiline::tracking
