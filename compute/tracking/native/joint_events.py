"""Native source: joint hypotheses of a cluster, as of ``compute.tracking.joint_events``."""

from typing import Final

HYPOTHESES: Final = """
    typedef unsigned long long Bits;
    struct Option { int one, two, peak; double weight; };
    // option[t]: which option the track t has; -1 none; only where t is the option's first track.
    struct Partial { double weight; Bits taken, read, doubled; short option[max_tracks]; };
    const double two_pi = 6.283185307179586, log_two = 0.6931471805599453;
    const double detection_probability = job.detection_probability, missed = 1.0 - job.detection_probability;
    const double gain_of_peak = job.detection_probability / job.clutter_density_per_px, merge = job.resolution_px;
    const double gate_squared = job.gate_sigma * job.gate_sigma;
    Partial* partials = (Partial*)job.partials;
    Partial* grown = partials + job.max_hypotheses;
    int* order = job.order;
    auto density = [&](double off, double total) -> double {
        return exp(-0.5 * off) / sqrt(two_pi * total);
    };
    auto merge_probability = [&](double apart, double variance) -> double {
        const double spread = 1.0 + 2.0 * log_two * variance / (merge * merge);
        return exp(-log_two * apart * apart / (merge * merge * spread)) / sqrt(spread);
    };
    auto share_variance = [&](double a, double va, double b, double vb) -> double {
        return share_spread * ((a - b) * (a - b) + va + vb);
    };
    // Moves the ``most`` heaviest to the front, in order: a heap of the places.
    auto heaviest_first = [&](Partial* all, int count, int most) APART {
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
                const int kept = order[at];
                order[at] = order[child];
                order[child] = kept;
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
    };
    // Of n tracks (at, va) and m peaks (z, vz): chances of options; returns their number, or -1.
    Option options[max_options];
    double option_chance[max_options];
    double pair_chance[max_tracks][max_tracks];
    int first_option[max_tracks + 1];
    auto claim = [&](int n, const double* at, const double* va, int m, const double* z,
                     const double* vz, double& given_up_share) APART -> int {
        if (n > max_tracks || m > max_tracks) return -1;
        for (int i = 0; i < n; ++i)
            for (int j = i + 1; j < n; ++j)
                pair_chance[i][j] = pair_chance[j][i] = merge_probability(at[i] - at[j], va[i] + va[j]);
        int count = 0;
        double factor[max_tracks + 1];
        for (int i = 0; i < n; ++i) {
            first_option[i] = count;
            double sum = missed;
            for (int k = 0; k < m; ++k) {
                const double total = va[i] + vz[k];
                const double off = (z[k] - at[i]) * (z[k] - at[i]) / total;
                if (off <= gate_squared) {
                    if (count == max_options) return -1;
                    options[count] = {i, -1, k, gain_of_peak * density(off, total)};
                    sum += options[count++].weight;
                }
                for (int j = i + 1; j < n; ++j) {
                    const double chance = pair_chance[i][j];
                    if (chance < min_merged) continue;
                    const double both = 0.25 * (va[i] + va[j])
                        + (vz[k] + share_variance(at[i], va[i], at[j], va[j]));
                    const double away = z[k] - 0.5 * (at[i] + at[j]);
                    const double far = away * away / both;
                    if (far <= gate_squared) {
                        if (count == max_options) return -1;
                        options[count] =
                            {i, j, k, detection_probability * gain_of_peak * chance * density(far, both)};
                        sum += options[count++].weight;
                    }
                }
            }
            factor[i] = larger(sum, 1.0);
        }
        first_option[n] = count;
        // One good hypothesis, to measure others by.
        double least = negligible;
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
            if (peak < 0 || best < missed) least *= missed;
            else {
                least *= best;
                greedy |= 1ull << peak;
            }
        }
        int here = 1;
        partials[0].weight = 1.0;
        partials[0].taken = partials[0].read = partials[0].doubled = 0;
        for (int i = 0; i < n; ++i) partials[0].option[i] = -1;
        double given_up = 0.0;
        for (int i = 0; i < n; ++i) {
            int more = 0;
            for (int p = 0; p < here; ++p) {
                if (more + 1 + first_option[i + 1] - first_option[i] > job.max_grown) return -1;
                const Partial& partial = partials[p];
                grown[more] = partial;
                if (partial.read >> i & 1) {
                    ++more;
                    continue;
                }
                grown[more++].weight = partial.weight * missed;
                for (int o = first_option[i]; o < first_option[i + 1]; ++o) {
                    const Option& option = options[o];
                    if (partial.taken >> option.peak & 1) continue;
                    if (option.two >= 0 && partial.read >> option.two & 1) continue;
                    double weight = partial.weight * option.weight;
                    if (option.two < 0)
                        for (int t = 0; t < i; ++t) {
                            const int earlier = partial.option[t];
                            if (earlier >= 0 && options[earlier].two < 0)
                                weight *= 1.0 - pair_chance[t][i];
                        }
                    Partial& next = grown[more++];
                    next = partial;
                    next.weight = weight;
                    next.taken |= 1ull << option.peak;
                    next.read |= 1ull << i;
                    if (option.two >= 0) {
                        next.read |= 1ull << option.two;
                        next.doubled |= 1ull << option.peak;
                    }
                    next.option[i] = (short)o;
                }
            }
            double ahead = 1.0, all = 0.0, kept = 0.0;
            for (int t = i + 1; t < n; ++t) ahead *= factor[t];
            int left = 0;
            for (int p = 0; p < more; ++p) {
                all += grown[p].weight;
                if (grown[p].weight * ahead >= least) {
                    if (left != p) grown[left] = grown[p];
                    ++left;
                }
            }
            if (left > job.max_hypotheses) {
                heaviest_first(grown, left, (int)job.max_hypotheses);
                left = (int)job.max_hypotheses;
            } else {
                for (int p = 0; p < left; ++p) partials[p] = grown[p];
            }
            here = left;
            for (int p = 0; p < here; ++p) kept += partials[p].weight;
            if (here < more) given_up += larger(all - kept, 0.0) * ahead;
        }
        // Of the same tracks at the same peaks only the likeliest.
        int single = 0;
        for (int p = 0; p < here; ++p) {
            int same = 0;
            while (same < single
                   && !(partials[same].read == partials[p].read
                        && partials[same].taken == partials[p].taken
                        && partials[same].doubled == partials[p].doubled))
                ++same;
            if (same == single) {
                if (single != p) partials[single] = partials[p];
                ++single;
            } else if (partials[p].weight > partials[same].weight) partials[same] = partials[p];
        }
        double total = 0.0;
        for (int p = 0; p < single; ++p) total += partials[p].weight;
        for (int o = 0; o < count; ++o) option_chance[o] = 0.0;
        for (int p = 0; p < single; ++p)
            for (int i = 0; i < n; ++i)
                if (partials[p].option[i] >= 0)
                    option_chance[partials[p].option[i]] += partials[p].weight / total;
        given_up_share = given_up / total;
        return count;
    };
"""
