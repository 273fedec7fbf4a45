// Associates the peaks of one frame with tracks: first peaks without rivals, then contested ones,
// as compute.tracking.association.
#pragma once

#include "compute/native/platform.h"
#include "compute/tracking/native/definitions.gen.h"
#include "compute/tracking/native/filtering.h"
#include "compute/tracking/native/joint_events.h"

namespace lumiline::tracking {

template <int S, int TERMS>
struct Association {
    static constexpr int max_tracks = 256, max_modes = 8;

    AssociationJob& job;
    TrackStates<S, TERMS> tracks;
    JointEvents events;
    const double log_gain;

    LUMILINE_FN explicit Association(AssociationJob& from)
        : job(from), tracks(from), events(from), log_gain(log(events.peak_gain)) {}

    LUMILINE_FN double position(int s, int k) { return job.position[s * tracks.K + k]; }

    LUMILINE_FN double noise_of(int s, int k) { return job.noise[s * tracks.K + k]; }

    // Finds the peaks of one sensor that leave no choice: -1 where there is none.
    LUMILINE_NOINLINE void find_unambiguous(int s, int* chosen) {
        int last[max_tracks], gated[max_tracks];
        bool unambiguous[max_tracks], sought[max_tracks];
        for (int t = 0; t < tracks.T; ++t) {
            const double at = tracks.expected_of(t)[s], v = tracks.expected_variance_of(t)[s];
            sought[t] = tracks.visible[t * S + s] && tracks.contested[t * S + s]
                        && v <= job.max_prediction_sigma_px * job.max_prediction_sigma_px;
            gated[t] = 0;
            last[t] = -1;
            if (!sought[t]) continue;
            for (int k = 0; k < tracks.K; ++k) {
                if (!job.usable[s * tracks.K + k] || tracks.assigned[s * tracks.K + k]) continue;
                const double off = position(s, k) - at;
                if (off * off <= events.gate_squared * (v + noise_of(s, k))) {
                    ++gated[t];
                    if (last[t] < 0) last[t] = k;
                }
            }
        }
        for (int t = 0; t < tracks.T; ++t) {
            unambiguous[t] = gated[t] == 1;
            for (int u = 0; unambiguous[t] && u < tracks.T; ++u) {
                if (u == t || !sought[u]) continue;
                const double off = position(s, last[t]) - tracks.expected_of(u)[s];
                unambiguous[t] = !(
                    off * off <= events.gate_squared
                                     * (tracks.expected_variance_of(u)[s] + noise_of(s, last[t])));
            }
        }
        for (int t = 0; t < tracks.T; ++t) {
            bool beside = false;
            for (int u = 0; !beside && sought[t] && u < tracks.T; ++u) {
                if (u == t || !sought[u] || (unambiguous[t] && unambiguous[u])) continue;
                const double off = tracks.expected_of(t)[s] - tracks.expected_of(u)[s];
                beside = (off < 0.0 ? -off : off)
                         <= neighbour_reach
                                * (events.resolution + sqrt(tracks.expected_variance_of(t)[s])
                                   + sqrt(tracks.expected_variance_of(u)[s]));
            }
            const bool decided = unambiguous[t] && !beside;
            chosen[t * S + s] = decided ? last[t] : -1;
            tracks.contested[t * S + s] = sought[t] && !decided && (gated[t] > 0 || beside);
        }
    }

    // Updates a track by the chosen readings; returns whether there were any.
    LUMILINE_NOINLINE bool update_unambiguous(int t, int* chosen, bool first) {
        int used[S], peak[S], n = 0;
        double noise[S], off[S], result[S];
        for (int s = 0; s < S; ++s)
            if (chosen[t * S + s] >= 0) {
                used[n] = s;
                peak[n] = chosen[t * S + s];
                noise[n] = noise_of(s, peak[n]);
                off[n] = position(s, peak[n]) - tracks.expected_of(t)[s];
                ++n;
            }
        if (n == 0) return false;
        for (int iteration = 0; iteration < max_iterations; ++iteration) {
            tracks.leave_one_out_residuals(t, used, n, noise, off, result);
            int worst = 0;
            for (int i = 0; i < n; ++i) {
                if (result[i] < 0.0) result[i] = -result[i];
                if (result[i] > result[worst]) worst = i;
            }
            if (!(result[worst] > job.gate_sigma && n > 2)) break;
            --n;
            for (int i = worst; i < n; ++i) {
                used[i] = used[i + 1];
                peak[i] = peak[i + 1];
                noise[i] = noise[i + 1];
                off[i] = off[i + 1];
                result[i] = result[i + 1];
            }
        }
        for (int i = 0; i < n; ++i)
            if (result[i] > suspect_sigma) noise[i] += events.resolution * events.resolution / 12.0;
        double mean[max_modes * 9], covariance[max_modes * 81], with_bias[max_modes * 9 * S],
            log_likely[max_modes], squared[max_modes];
        for (int iteration = 0; iteration < (first ? max_iterations : 1); ++iteration) {
            double moved[3] = {0.0, 0.0, 0.0};
            for (int k = 0; k < tracks.M; ++k) {
                double *m = mean + 9 * k, *p = covariance + 81 * k, *q = with_bias + 9 * S * k;
                for (int i = 0; i < 9; ++i) m[i] = tracks.mean_of(t, k)[i];
                for (int i = 0; i < 81; ++i) p[i] = tracks.covariance_of(t, k)[i];
                for (int i = 0; i < 9 * S; ++i) q[i] = tracks.with_bias_of(t, k)[i];
                for (int i = 0; i < n; ++i) {
                    const double* g = tracks.jacobian_of(t) + 3 * used[i];
                    double at = tracks.expanded_reading_of(t)[used[i]];
                    for (int axis = 0; axis < 3; ++axis)
                        at += g[axis] * (m[axis] - tracks.expansion_point_of(t)[axis]);
                    off[i] = position(used[i], peak[i]) - at;
                }
                log_likely[k] = tracks.joint_update(m, p, q, t, used, n, noise, off, squared[k]);
                for (int i = 0; i < 3; ++i)
                    moved[i] += job.mode_probability[t * tracks.M + k] * m[i];
            }
            bool far = false;
            for (int i = 0; i < 3; ++i) {
                const double step = moved[i] - tracks.expansion_point_of(t)[i];
                far = far || !(step < relinearisation_mm && -step < relinearisation_mm);
            }
            if (!far || iteration + 1 == (first ? max_iterations : 1)) break;
            for (int i = 0; i < 3; ++i) tracks.expansion_point_of(t)[i] = moved[i];
            tracks.predict(t);
        }
        double top = log_likely[0], likelihood = 0.0, sum = 0.0;
        for (int k = 0; k < tracks.M; ++k) {
            for (int i = 0; i < 9; ++i) tracks.mean_of(t, k)[i] = mean[9 * k + i];
            for (int i = 0; i < 81; ++i) tracks.covariance_of(t, k)[i] = covariance[81 * k + i];
            for (int i = 0; i < 9 * S; ++i) tracks.with_bias_of(t, k)[i] = with_bias[9 * S * k + i];
            top = larger(top, log_likely[k]);
        }
        for (int k = 0; k < tracks.M; ++k)
            likelihood += job.mode_probability[t * tracks.M + k] * exp(log_likely[k] - top);
        job.evidence[t] += top + log(likelihood) + n * log_gain;
        for (int k = 0; k < tracks.M; ++k) {
            double& probability = job.mode_probability[t * tracks.M + k];
            probability =
                larger(probability * exp(log_likely[k] - top) / likelihood, min_mode_probability);
            sum += probability;
        }
        for (int k = 0; k < tracks.M; ++k) {
            job.mode_probability[t * tracks.M + k] /= sum;
            job.nis[t] += job.mode_probability[t * tracks.M + k] * squared[k];
        }
        for (int i = 0; i < n; ++i) {
            job.choice[t * S + used[i]] = peak[i];
            job.choice_probability[t * S + used[i]] = 1.0;
            tracks.assigned[used[i] * tracks.K + peak[i]] = 1;
        }
        return true;
    }

    // Takes one sensor's contested peaks; returns false where there is not room enough.
    LUMILINE_NOINLINE bool update_contested(int s) {
        int rows[max_tracks], by_begin[max_tracks], n = 0;
        double at[max_tracks], v[max_tracks], begin[max_tracks], widest = 0.0;
        for (int t = 0; t < tracks.T; ++t)
            if (tracks.contested[t * S + s]) {
                tracks.mix_modes(t);
                tracks.predict_measurement(t, s);
                rows[n] = t;
                at[n] = tracks.expected_of(t)[s];
                v[n] = tracks.expected_variance_of(t)[s];
                begin[n] = at[n] - job.gate_sigma * sqrt(v[n]);
                int where = n++;
                for (; where > 0 && begin[by_begin[where - 1]] > begin[n - 1]; --where)
                    by_begin[where] = by_begin[where - 1];
                by_begin[where] = n - 1;
            }
        int peaks[max_tracks], m = 0;
        for (int k = 0; k < tracks.K; ++k)
            if (job.usable[s * tracks.K + k] && !tracks.assigned[s * tracks.K + k]) {
                if (m == max_tracks) return false;
                peaks[m++] = k;
                widest = larger(widest, sqrt(noise_of(s, k)));
            }
        const double margin = job.gate_sigma * widest,
                     between = neighbour_reach * events.resolution;
        for (int from = 0; from < n;) {
            double end = -infinity(), low = infinity(), high = -infinity();
            int to = from;
            while (to < n) {
                const int i = by_begin[to];
                const double half_width = at[i] - begin[i];
                if (to > from && begin[i] - margin > end + 2.0 * between) break;
                end = larger(end, at[i] + half_width + margin);
                low = smaller(low, begin[i]);
                high = larger(high, at[i] + half_width);
                ++to;
            }
            if (to - from > max_cluster_tracks) return false;
            int members[max_cluster_tracks], size = to - from, count = 0,
                                             cluster_peaks[max_cluster_tracks];
            for (int i = 0; i < size; ++i) {
                int where = i;
                for (; where > 0 && members[where - 1] > by_begin[from + i]; --where)
                    members[where] = members[where - 1];
                members[where] = by_begin[from + i];
            }
            double a[max_cluster_tracks], va[max_cluster_tracks], z[max_cluster_tracks],
                vz[max_cluster_tracks];
            for (int i = 0; i < size; ++i) {
                a[i] = at[members[i]];
                va[i] = v[members[i]];
            }
            for (int i = 0; i < m; ++i) {
                const double here = position(s, peaks[i]);
                if (here < low - margin - between || here > high + margin + between) continue;
                if (count == max_cluster_tracks) return false;
                cluster_peaks[count] = peaks[i];
                z[count] = here;
                vz[count++] = noise_of(s, peaks[i]);
            }
            from = to;
            double pruned_weight = 0.0;
            const int ways = events.evaluate(size, a, va, count, z, vz, pruned_weight);
            if (ways < 0) return false;
            for (int i = 0; i < size; ++i) {
                const int t = rows[members[i]];
                double weight[max_options], difference[max_options], noise[max_options];
                int which[max_options], claims = 0;
                bool shared[max_options];
                for (int o = 0; o < ways; ++o) {
                    const Option& way = events.options[o];
                    if ((way.one != i && way.two != i) || events.option_probability[o] == 0.0)
                        continue;
                    weight[claims] = events.option_probability[o];
                    which[claims] = way.peak;
                    shared[claims] = way.two >= 0;
                    if (way.two < 0) {
                        difference[claims] = z[way.peak] - a[i];
                        noise[claims] = vz[way.peak];
                    } else {
                        const int j = way.one == i ? way.two : way.one;
                        noise[claims] =
                            4.0 * (vz[way.peak] + merged_variance(a[i], va[i], a[j], va[j]))
                            + va[j];
                        difference[claims] = 2.0 * z[way.peak] - a[j] - a[i];
                    }
                    ++claims;
                }
                if (pruned_weight > max_pruned_fraction) job.hypotheses_pruned[t] = 1;
                tracks.pda_update(t, s, claims, weight, difference, noise);
                for (int c = 0; c < claims; ++c) {
                    if (weight[c] <= min_reported_probability) continue;
                    const int k = cluster_peaks[which[c]];
                    job.choice[t * S + s] = k;
                    job.choice_probability[t * S + s] = weight[c];
                    job.merged[t * S + s] = shared[c];
                    tracks.assigned[s * tracks.K + k] = 1;
                    const double total = va[i] + noise[c];
                    const double off = difference[c] * difference[c] / total;
                    job.nis[t] += off;
                    job.evidence[t] += weight[c] * (-0.5 * (off + log(two_pi * total)) + log_gain);
                }
            }
        }
        return true;
    }

    // Takes all peaks without rivals.
    LUMILINE_NOINLINE void decide(bool first) {
        int* chosen = job.order;
        for (int t = 0; t < tracks.T; ++t)
            for (int s = 0; s < S; ++s) tracks.predict_measurement(t, s);
        for (int s = 0; s < S; ++s) find_unambiguous(s, chosen);
        for (int t = 0; t < tracks.T; ++t)
            if (update_unambiguous(t, chosen, first)) tracks.mix_modes(t);
    }

    // The number of tracks that this sensor's peaks leave undecided.
    LUMILINE_FN int count_contested(int s) {
        int count = 0;
        for (int t = 0; t < tracks.T; ++t) count += tracks.contested[t * S + s];
        return count;
    }

    LUMILINE_FN void solve() {
        for (int t = 0; t < tracks.T; ++t) {
            tracks.mix_modes(t);
            for (int i = 0; i < 3; ++i) tracks.expansion_point_of(t)[i] = tracks.position_of(t)[i];
            tracks.predict(t);
            bool narrow = true;
            for (int s = 0; s < S; ++s) {
                tracks.predict_measurement(t, s);
                narrow = narrow
                         && !(tracks.visible[t * S + s]
                              && tracks.expected_variance_of(t)[s]
                                     > lost_sigma_factor * job.max_prediction_sigma_px
                                           * (lost_sigma_factor * job.max_prediction_sigma_px));
                job.choice[t * S + s] = -1;
            }
            for (int s = 0; s < S; ++s) tracks.contested[t * S + s] = narrow;
        }
        for (int i = 0; i < S * tracks.K; ++i) tracks.assigned[i] = 0;
        if (tracks.T > max_tracks || tracks.M > max_modes) {
            job.failed = 1;
            return;
        }
        decide(true);
        bool any = false;
        for (int s = 0; s < S; ++s) any = any || count_contested(s) > 0;
        if (any) decide(false);
        int contenders[S];
        for (int s = 0; s < S; ++s) contenders[s] = count_contested(s);
        for (int iteration = 0; iteration < S; ++iteration) {
            int next = -1;
            for (int s = 0; s < S; ++s)
                if (contenders[s] > 0 && (next < 0 || contenders[s] < contenders[next])) next = s;
            if (next < 0) break;
            contenders[next] = 0;
            if (!update_contested(next)) {
                job.failed = 1;
                return;
            }
        }
        for (int t = 0; t < tracks.T; ++t) {
            job.in_view[t] = 0;
            for (int s = 0; s < S; ++s) job.in_view[t] += tracks.visible[t * S + s];
        }
    }
};

// Associates the frame of an AssociationJob; CPU only.
template <int S, int TERMS>
LUMILINE_FN void associate_frame(unsigned long long job_address) {
    Association<S, TERMS> association(*(AssociationJob*)job_address);
    association.solve();
}

}  // namespace lumiline::tracking
