"""Native source: peaks without rivals, then contested ones; as ``compute.tracking.association``."""

from typing import Final

from compute.reconstruction.native.algebra import ALGEBRA
from compute.reconstruction.native.correction_table import TABLE
from compute.reconstruction.native.projection import CAMERAS
from compute.tracking.association import (
    ASSOCIATION_PROBABILITY_THRESHOLD,
    LOST_SIGMA_FACTOR,
    MAX_ITERATIONS,
    PRUNED_WEIGHT_THRESHOLD,
    RELINEARISATION_STEP_MM,
    SUSPECT_RESIDUAL_SIGMA,
)
from compute.tracking.imm_states import MIN_MODE_PROBABILITY
from compute.tracking.joint_events import (
    MIN_MERGE_PROBABILITY,
    NEGLIGIBLE_WEIGHT_RATIO,
    SHARE_FRACTION_VARIANCE,
    SHARED_PEAK_REACH,
)
from compute.tracking.native.joint_events import HYPOTHESES
from compute.tracking.native.kernel_arguments import JOB_SOURCE
from compute.tracking.native.measurement_update import FILTERING

_CONSTANTS: Final = f"""
    const double share_spread = {SHARE_FRACTION_VARIANCE!r}, negligible = {NEGLIGIBLE_WEIGHT_RATIO!r};
    const double min_merged = {MIN_MERGE_PROBABILITY!r}, doubted = {SUSPECT_RESIDUAL_SIGMA!r};
    const double relinearised = {RELINEARISATION_STEP_MM!r}, given_up_limit = {PRUNED_WEIGHT_THRESHOLD!r};
    const double lost = {LOST_SIGMA_FACTOR!r}, seen = {ASSOCIATION_PROBABILITY_THRESHOLD!r}, reach_of = {SHARED_PEAK_REACH!r};
    const double min_probability = {MIN_MODE_PROBABILITY!r};
    const int max_turns = {MAX_ITERATIONS};
"""

_DECISIVE: Final = """
    const double log_gain = log(gain_of_peak);
    const int max_all = 256;
    auto position = [&](int s, int k) -> double { return job.position[s * K + k]; };
    auto noise_of = [&](int s, int k) -> double { return job.noise[s * K + k]; };
    // Finds the peaks of one sensor that leave no choice: -1 where there is none.
    auto find_decisive = [&](int s, int* found) APART {
        int last[max_all], gated[max_all];
        bool own[max_all], sought[max_all];
        for (int t = 0; t < T; ++t) {
            const double at = present(t)[s], v = expected_variance(t)[s];
            sought[t] = visible[t * S + s] && contested[t * S + s]
                && v <= job.max_prediction_sigma_px * job.max_prediction_sigma_px;
            gated[t] = 0;
            last[t] = -1;
            if (!sought[t]) continue;
            for (int k = 0; k < K; ++k) {
                if (!job.usable[s * K + k] || taken[s * K + k]) continue;
                const double off = position(s, k) - at;
                if (off * off <= gate_squared * (v + noise_of(s, k))) {
                    ++gated[t];
                    if (last[t] < 0) last[t] = k;
                }
            }
        }
        for (int t = 0; t < T; ++t) {
            own[t] = gated[t] == 1;
            for (int u = 0; own[t] && u < T; ++u) {
                if (u == t || !sought[u]) continue;
                const double off = position(s, last[t]) - present(u)[s];
                own[t] = !(off * off
                           <= gate_squared * (expected_variance(u)[s] + noise_of(s, last[t])));
            }
        }
        for (int t = 0; t < T; ++t) {
            bool beside = false;
            for (int u = 0; !beside && sought[t] && u < T; ++u) {
                if (u == t || !sought[u] || (own[t] && own[u])) continue;
                const double off = present(t)[s] - present(u)[s];
                beside = (off < 0.0 ? -off : off)
                    <= reach_of * (merge + sqrt(expected_variance(t)[s])
                                   + sqrt(expected_variance(u)[s]));
            }
            const bool decided = own[t] && !beside;
            found[t * S + s] = decided ? last[t] : -1;
            contested[t * S + s] = sought[t] && !decided && (gated[t] > 0 || beside);
        }
    };
    // Updates a track by the readings found; returns whether there were any.
    auto take = [&](int t, int* found, bool first) APART -> bool {
        int used[S], peak[S], n = 0;
        double noise[S], off[S], result[S];
        for (int s = 0; s < S; ++s)
            if (found[t * S + s] >= 0) {
                used[n] = s;
                peak[n] = found[t * S + s];
                noise[n] = noise_of(s, peak[n]);
                off[n] = position(s, peak[n]) - present(t)[s];
                ++n;
            }
        if (n == 0) return false;
        for (int turn = 0; turn < max_turns; ++turn) {
            left_out(t, used, n, noise, off, result);
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
            if (result[i] > doubted) noise[i] += merge * merge / 12.0;
        double mean[8 * 9], covariance[8 * 81], with_bias[8 * 9 * S], log_likely[8], squared[8];
        for (int turn = 0; turn < (first ? max_turns : 1); ++turn) {
            double moved[3] = {0.0, 0.0, 0.0};
            for (int k = 0; k < M; ++k) {
                double *m = mean + 9 * k, *p = covariance + 81 * k, *q = with_bias + 9 * S * k;
                for (int i = 0; i < 9; ++i) m[i] = mean_of(t, k)[i];
                for (int i = 0; i < 81; ++i) p[i] = covariance_of(t, k)[i];
                for (int i = 0; i < 9 * S; ++i) q[i] = with_bias_of(t, k)[i];
                for (int i = 0; i < n; ++i) {
                    const double* g = slope(t) + 3 * used[i];
                    double at = reading(t)[used[i]];
                    for (int axis = 0; axis < 3; ++axis) at += g[axis] * (m[axis] - place(t)[axis]);
                    off[i] = position(used[i], peak[i]) - at;
                }
                log_likely[k] = joint(m, p, q, t, used, n, noise, off, squared[k]);
                for (int i = 0; i < 3; ++i) moved[i] += job.probability[t * M + k] * m[i];
            }
            bool far = false;
            for (int i = 0; i < 3; ++i) {
                const double step = moved[i] - place(t)[i];
                far = far || !(step < relinearised && -step < relinearised);
            }
            if (!far || turn + 1 == (first ? max_turns : 1)) break;
            for (int i = 0; i < 3; ++i) place(t)[i] = moved[i];
            predict(t);
        }
        double top = log_likely[0], share = 0.0, sum = 0.0;
        for (int k = 0; k < M; ++k) {
            for (int i = 0; i < 9; ++i) mean_of(t, k)[i] = mean[9 * k + i];
            for (int i = 0; i < 81; ++i) covariance_of(t, k)[i] = covariance[81 * k + i];
            for (int i = 0; i < 9 * S; ++i) with_bias_of(t, k)[i] = with_bias[9 * S * k + i];
            top = larger(top, log_likely[k]);
        }
        for (int k = 0; k < M; ++k) share += job.probability[t * M + k] * exp(log_likely[k] - top);
        job.evidence[t] += top + log(share) + n * log_gain;
        for (int k = 0; k < M; ++k) {
            double& chance = job.probability[t * M + k];
            chance = larger(chance * exp(log_likely[k] - top) / share, min_probability);
            sum += chance;
        }
        for (int k = 0; k < M; ++k) {
            job.probability[t * M + k] /= sum;
            job.nis[t] += job.probability[t * M + k] * squared[k];
        }
        for (int i = 0; i < n; ++i) {
            job.choice[t * S + used[i]] = peak[i];
            job.chance[t * S + used[i]] = 1.0;
            taken[used[i] * K + peak[i]] = 1;
        }
        return true;
    };
"""

_CONTESTED: Final = """
    // Takes one sensor's contested peaks; returns false where there is not room enough.
    auto take_sensor = [&](int s) APART -> bool {
        int rows[max_all], by_begin[max_all], n = 0;
        double at[max_all], v[max_all], begin[max_all], widest = 0.0;
        for (int t = 0; t < T; ++t)
            if (contested[t * S + s]) {
                mix(t);
                look(t, s);
                rows[n] = t;
                at[n] = present(t)[s];
                v[n] = expected_variance(t)[s];
                begin[n] = at[n] - job.gate_sigma * sqrt(v[n]);
                int where = n++;
                for (; where > 0 && begin[by_begin[where - 1]] > begin[n - 1]; --where)
                    by_begin[where] = by_begin[where - 1];
                by_begin[where] = n - 1;
            }
        int peaks[max_all], m = 0;
        for (int k = 0; k < K; ++k)
            if (job.usable[s * K + k] && !taken[s * K + k]) {
                if (m == max_all) return false;
                peaks[m++] = k;
                widest = larger(widest, sqrt(noise_of(s, k)));
            }
        const double margin = job.gate_sigma * widest, between = reach_of * merge;
        for (int from = 0; from < n;) {
            double end = -infinity, low = infinity, high = -infinity;
            int to = from;
            while (to < n) {
                const int i = by_begin[to];
                const double half = at[i] - begin[i];
                if (to > from && begin[i] - margin > end + 2.0 * between) break;
                end = larger(end, at[i] + half + margin);
                low = smaller(low, begin[i]);
                high = larger(high, at[i] + half);
                ++to;
            }
            if (to - from > max_tracks) return false;
            int members[max_tracks], size = to - from, count = 0, own[max_tracks];
            for (int i = 0; i < size; ++i) {
                int where = i;
                for (; where > 0 && members[where - 1] > by_begin[from + i]; --where)
                    members[where] = members[where - 1];
                members[where] = by_begin[from + i];
            }
            double a[max_tracks], va[max_tracks], z[max_tracks], vz[max_tracks];
            for (int i = 0; i < size; ++i) {
                a[i] = at[members[i]];
                va[i] = v[members[i]];
            }
            for (int i = 0; i < m; ++i) {
                const double here = position(s, peaks[i]);
                if (here < low - margin - between || here > high + margin + between) continue;
                if (count == max_tracks) return false;
                own[count] = peaks[i];
                z[count] = here;
                vz[count++] = noise_of(s, peaks[i]);
            }
            from = to;
            double given_up = 0.0;
            const int ways = claim(size, a, va, count, z, vz, given_up);
            if (ways < 0) return false;
            for (int i = 0; i < size; ++i) {
                const int t = rows[members[i]];
                double weight[max_options], difference[max_options], noise[max_options];
                int which[max_options], claims = 0;
                bool shared[max_options];
                for (int o = 0; o < ways; ++o) {
                    const Option& way = options[o];
                    if ((way.one != i && way.two != i) || option_chance[o] == 0.0) continue;
                    weight[claims] = option_chance[o];
                    which[claims] = way.peak;
                    shared[claims] = way.two >= 0;
                    if (way.two < 0) {
                        difference[claims] = z[way.peak] - a[i];
                        noise[claims] = vz[way.peak];
                    } else {
                        const int j = way.one == i ? way.two : way.one;
                        noise[claims] = 4.0
                            * (vz[way.peak] + share_variance(a[i], va[i], a[j], va[j])) + va[j];
                        difference[claims] = 2.0 * z[way.peak] - a[j] - a[i];
                    }
                    ++claims;
                }
                if (given_up > given_up_limit) job.doubtful[t] = 1;
                soft(t, s, claims, weight, difference, noise);
                for (int c = 0; c < claims; ++c) {
                    if (weight[c] <= seen) continue;
                    const int k = own[which[c]];
                    job.choice[t * S + s] = k;
                    job.chance[t * S + s] = weight[c];
                    job.merged[t * S + s] = shared[c];
                    taken[s * K + k] = 1;
                    const double total = va[i] + noise[c];
                    const double off = difference[c] * difference[c] / total;
                    job.nis[t] += off;
                    job.evidence[t] += weight[c]
                        * (-0.5 * (off + log(two_pi * total)) + log_gain);
                }
            }
        }
        return true;
    };
"""

_FRAME: Final = """
    auto decide = [&](bool first) APART {
        int* found = order;
        for (int t = 0; t < T; ++t)
            for (int s = 0; s < S; ++s) look(t, s);
        for (int s = 0; s < S; ++s) find_decisive(s, found);
        for (int t = 0; t < T; ++t)
            if (take(t, found, first)) mix(t);
    };
    for (int t = 0; t < T; ++t) {
        mix(t);
        for (int i = 0; i < 3; ++i) place(t)[i] = whole(t)[i];
        predict(t);
        bool narrow = true;
        for (int s = 0; s < S; ++s) {
            look(t, s);
            narrow = narrow
                && !(visible[t * S + s]
                     && expected_variance(t)[s] > lost * job.max_prediction_sigma_px * (lost * job.max_prediction_sigma_px));
            job.choice[t * S + s] = -1;
        }
        for (int s = 0; s < S; ++s) contested[t * S + s] = narrow;
    }
    for (int i = 0; i < S * K; ++i) taken[i] = 0;
    if (T > max_all || M > 8) {
        job.failed = 1;
        return;
    }
    decide(true);
    auto open = [&](int s) -> int {
        int count = 0;
        for (int t = 0; t < T; ++t) count += contested[t * S + s];
        return count;
    };
    bool any = false;
    for (int s = 0; s < S; ++s) any = any || open(s) > 0;
    if (any) decide(false);
    int contenders[S];
    for (int s = 0; s < S; ++s) contenders[s] = open(s);
    for (int turn = 0; turn < S; ++turn) {
        int next = -1;
        for (int s = 0; s < S; ++s)
            if (contenders[s] > 0 && (next < 0 || contenders[s] < contenders[next])) next = s;
        if (next < 0) break;
        contenders[next] = 0;
        if (!take_sensor(next)) {
            job.failed = 1;
            return;
        }
    }
    for (int t = 0; t < T; ++t) {
        job.in_view[t] = 0;
        for (int s = 0; s < S; ++s) job.in_view[t] += visible[t * S + s];
    }
#undef APART
"""


def association_source(sensors: int, room: int) -> str:
    """Return the source for so many sensors, with room for so many terms of distortion."""
    return (
        f"    const int S = {sensors}, ROOM = {room};\n"
        + JOB_SOURCE
        + _CONSTANTS
        + ALGEBRA
        + CAMERAS
        + TABLE
        + HYPOTHESES
        + FILTERING
        + _DECISIVE
        + _CONTESTED
        + _FRAME
    )
