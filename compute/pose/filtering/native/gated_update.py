"""Native source: readings within the gates are taken by all modes, as ``ImmState.update``."""

from typing import Final

# Covariance of a reading with the states and the common errors of a mode, (W,), and with
# another reading.
CROSSED: Final = """
    auto cross = [&](const double* spread, int s, double* __restrict__ crossed) {
        const double* common = by_common + s * E;
        zero(W, crossed);
        for (int r = 0; r < 6; ++r) add(W, slopes[s][r], spread + r * W, crossed);
        if (E == 0) return;
        for (int i = 0; i < D; ++i) {
            const double* row = spread + i * W + D;
            double parts[4] = {0.0, 0.0, 0.0, 0.0};
            int e = 0;
            for (; e + 4 <= E; e += 4)
                for (int k = 0; k < 4; ++k) parts[k] += common[e + k] * row[e + k];
            for (; e < E; ++e) parts[0] += common[e] * row[e];
            crossed[i] += (parts[0] + parts[1]) + (parts[2] + parts[3]);
        }
        add(E, 1.0, common, crossed + D);
    };
    auto meet = [&](const double* crossed, int t) -> double {
        const double* common = by_common + t * E;
        double sum = 0.0;
        for (int r = 0; r < 6; ++r) sum += crossed[r] * slopes[t][r];
        for (int e = 0; e < E; ++e) sum += crossed[D + e] * common[e];
        return sum;
    };
"""

# As PoseState.figures.
FIGURES: Final = """
    auto figures = [&](const double* pose, double* to) {
        const double *r = pose, *spread = pose + pose_size;
        double origin[3], tip[3];
        for (int i = 0; i < 3; ++i) {
            const double *middle = step.middle, *end = step.tip;
            origin[i] = r[3 * i] * middle[0] + r[3 * i + 1] * middle[1] + r[3 * i + 2] * middle[2];
            tip[i] = r[3 * i] * end[0] + r[3 * i + 1] * end[1] + r[3 * i + 2] * end[2];
        }
        // Covariance of (turn, shift) at an arm from the centroid, of the last so many rows.
        auto at = [&](const double* a, double sign, int first, double* into) {
            const double x = sign * a[0], y = sign * a[1], z = sign * a[2];
            const double swept[3][3] = {{0.0, -z, y}, {z, 0.0, -x}, {-y, x, 0.0}};
            double half[6][6];
            for (int i = 0; i < 6; ++i)
                for (int j = 0; j < 6; ++j) {
                    half[i][j] = spread[12 * i + j];
                    for (int k = 0; i > 2 && k < 3; ++k)
                        half[i][j] += swept[i - 3][k] * spread[12 * k + j];
                }
            for (int i = first; i < 6; ++i)
                for (int j = first; j < 6; ++j) {
                    double sum = half[i][j];
                    for (int k = 0; j > 2 && k < 3; ++k) sum += half[i][k] * swept[j - 3][k];
                    into[(i - first) * (6 - first) + j - first] = sum;
                }
        };
        copy(9, r, to);
        copy(3, pose + 15, to + 9);
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, k = (i + 2) % 3;
            to[12 + i] = pose[9 + i] - origin[i];
            to[51 + i] = pose[9 + i] + tip[i];
            to[63 + i] = pose[12 + i] - (pose[15 + j] * origin[k] - pose[15 + k] * origin[j]);
        }
        at(origin, 1.0, 0, to + 15);
        at(tip, -1.0, 3, to + 54);
    };
"""

TAKING: Final = """
    double* result = step.result;
    double* peak_of = result + head;
    double* whole = peak_of + S;
    double* whitened = whole + pose_size + 144 + 12 * E;
    double* all_crossed = room(S * W);
    double* solved = room(K * S * (1 + W));
    double* nis = room(K);
    double* log_probability = room(K);
    const int P = (int)step.peaks;
    int count = 0, sensor[S];
    auto end = [&](int how, const double* modes) {
        result[0] = how;
        result[1] = count;
        if (how != taken) return;
        together(modes, whole);
        figures(whole, step.reported_pose);
    };
    if (step.lit < 0) {
        ahead(step.before, whole);
        figures(whole, step.reported_pose);
        return;
    }
    predict(step.before, step.predicted);
    const double* predicted = step.predicted;
    double least = infinity, gain = 0.0;
    for (int i = 0; i < S * P; ++i)
        if (step.usable[i]) least = smaller(least, step.variance[i]);
    for (int s = 0; s < S; ++s) peak_of[s] = -1.0;
    result[2] = result[3] = 0.0;
    if (!(least < infinity)) {
        end(taken, predicted);
        return;
    }
    expect(predicted);
    // The gates are the widest mode's.
    const double* widest = covariances_of(predicted) + (K - 1) * D * W;
    bool known = true;
    for (int s = 0; s < S; ++s)
        for (int axis = 3; axis < 6; ++axis) {
            const double slope = slopes[s][axis] < 0.0 ? -slopes[s][axis] : slopes[s][axis];
            known = known && slope == slope;
            gain = larger(gain, slope);
        }
    const double turned = 0.5 * step.radius * (widest[0] + widest[W + 1] + widest[2 * W + 2]);
    const double shifted = (widest[3 * W + 3] + widest[4 * W + 4] + widest[5 * W + 5]) * gain
        / step.focal;
    if (known && (turned + shifted) * gain > bent_share * sqrt(least) && !bend(predicted, widest)) {
        end(curved, predicted);
        return;
    }
    double reading[S], noise[S];
    for (int s = 0; s < S; ++s) {
        double* crossed = all_crossed + s * W;
        cross(widest, s, crossed);
        const double own = meet(crossed, s) + curvature[s][s];
        int fitting = 0;
        for (int i = s * P; i < (s + 1) * P; ++i) {
            const double off = step.position[i] - value[s];
            if (!step.usable[i] || !(off * off <= step.gate * (own + step.variance[i]))) continue;
            fitting += 1;
            reading[s] = off;
            noise[s] = step.variance[i];
            peak_of[s] = i - s * P;
        }
        if (fitting > 1) {
            end(contested, predicted);
            return;
        }
        if (fitting) sensor[count++] = s;
    }
    if (count == 0) {
        end(taken, predicted);
        return;
    }
    double* after = step.after;
    const int row = 1 + W;
    double highest = -infinity;
    // The widest first: it says whether the readings fit.
    for (int k = K - 1; k >= 0; --k) {
        const double *off = offsets_of(predicted) + k * D, *spread = covariances_of(predicted) + k * D * W;
        double* own = solved + k * S * row;
        double root[S][S], inverse[S], log_size = 0.0;
        nis[k] = 0.0;
        for (int i = 0; i < count; ++i) {
            const int s = sensor[i];
            double* right = own + i * row;
            if (k == K - 1) copy(W, all_crossed + s * W, right + 1);
            else cross(spread, s, right + 1);
            right[0] = reading[s];
            for (int r = 0; r < 6; ++r) right[0] -= slopes[s][r] * off[r];
            for (int j = 0; j <= i; ++j) {
                const int t = sensor[j];
                root[i][j] = meet(right + 1, t) + curvature[s][t];
            }
            root[i][i] += noise[s];
        }
        for (int i = 0; i < count; ++i) {
            for (int j = 0; j <= i; ++j) {
                double rest = root[i][j];
                for (int t = 0; t < j; ++t) rest -= root[i][t] * root[j][t];
                if (j < i) root[i][j] = rest * inverse[j];
                else root[i][i] = rest;
            }
            if (!(root[i][i] > 0.0)) {
                end(misfit, predicted);
                return;
            }
            log_size += 0.5 * log(root[i][i]);
            inverse[i] = 1.0 / sqrt(root[i][i]);
            double* right = own + i * row;
            for (int j = 0; j < i; ++j) add(row, -root[i][j], own + j * row, right);
            for (int c = 0; c < row; ++c) right[c] *= inverse[i];
            nis[k] += right[0] * right[0];
        }
        if (k == K - 1 && !(nis[k] <= step.limits[count])) {
            end(misfit, predicted);
            return;
        }
        log_probability[k] = log(probabilities(predicted)[k]) - 0.5 * nis[k] - log_size;
        highest = larger(highest, log_probability[k]);
        double *off_after = offsets_of(after) + k * D, *spread_after = covariances_of(after) + k * D * W;
        copy(D, off, off_after);
        copy(D * W, spread, spread_after);
        for (int i = 0; i < count; ++i) {
            const double* right = own + i * row;
            for (int r = 0; r < D; ++r) {
                off_after[r] += right[1 + r] * right[0];
                add(W, -right[1 + r], right + 1, spread_after + r * W);
            }
        }
    }
    double sum = 0.0;
    int likeliest = 0;
    for (int k = 0; k < K; ++k) {
        sum += probabilities(after)[k] = exp(log_probability[k] - highest);
        likeliest = log_probability[k] > log_probability[likeliest] ? k : likeliest;
    }
    result[3] = nis[K - 1];
    for (int k = 0; k < K; ++k) {
        probabilities(after)[k] /= sum;
        result[2] += probabilities(after)[k] * nis[k];
    }
    double last[D];
    copy(D, offsets_of(after) + (K - 1) * D, last);
    moved(predicted, last, after);
    for (int k = 0; k < K; ++k) add(D, -1.0, last, offsets_of(after) + k * D);
    for (int i = 0; i < count; ++i) {
        const double* right = solved + (likeliest * S + i) * row;
        whitened[i * (1 + E)] = right[0];
        copy(E, right + 1 + D, whitened + i * (1 + E) + 1);
    }
    end(taken, after);
"""
