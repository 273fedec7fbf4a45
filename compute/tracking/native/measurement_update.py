"""Native source: predicted readings, and the filter's joint and soft updates."""

from typing import Final

FILTERING: Final = """
    const int T = (int)job.tracks, M = (int)job.models, K = (int)job.room;
    // Of each track: the mixture's place (3), its covariance (9), that with the biases (3 S); where
    // it was linearised (3), readings (S) and slopes (3 S) there; present readings and variances.
    const int stride = 15 + 9 * S;
    auto whole = [&](int t) -> double* { return job.numbers + (long long)t * stride; };
    auto spread_of = [&](int t) -> double* { return whole(t) + 3; };
    auto biased = [&](int t) -> double* { return whole(t) + 12; };
    auto place = [&](int t) -> double* { return whole(t) + 12 + 3 * S; };
    auto reading = [&](int t) -> double* { return whole(t) + 15 + 3 * S; };
    auto slope = [&](int t) -> double* { return whole(t) + 15 + 4 * S; };
    auto present = [&](int t) -> double* { return whole(t) + 15 + 7 * S; };
    auto expected_variance = [&](int t) -> double* { return whole(t) + 15 + 8 * S; };
    unsigned char* visible = job.marks;
    unsigned char* contested = job.marks + T * S;
    unsigned char* taken = job.marks + 2 * T * S;
    auto mean_of = [&](int t, int k) -> double* { return job.mean + (t * M + k) * 9; };
    auto covariance_of = [&](int t, int k) -> double* { return job.covariance + (t * M + k) * 81; };
    auto with_bias_of = [&](int t, int k) -> double* {
        return job.with_bias + (t * M + k) * 9 * S;
    };
    auto bias_of = [&](int t) -> const double* { return job.bias + t * S * S; };
    auto mix = [&](int t) APART {
        double *w = whole(t), *c = spread_of(t), *b = biased(t);
        for (int i = 0; i < 12 + 3 * S; ++i) w[i] = 0.0;
        for (int k = 0; k < M; ++k)
            for (int i = 0; i < 3; ++i) w[i] += job.probability[t * M + k] * mean_of(t, k)[i];
        for (int k = 0; k < M; ++k) {
            const double chance = job.probability[t * M + k];
            const double *m = mean_of(t, k), *p = covariance_of(t, k), *q = with_bias_of(t, k);
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    c[3 * i + j] += chance * (p[9 * i + j] + (m[i] - w[i]) * (m[j] - w[j]));
            for (int i = 0; i < 3 * S; ++i) b[i] += chance * q[i];
        }
    };
    auto predict = [&](int t) APART {
        const double* x = place(t);
        Lanes p[V], g[3][V], value[V], by[3][V];
        project(x, p, g);
        if (job.degree != 0) correction(x, value, by);
        for (int s = 0; s < S; ++s) {
            const int v = s / 4, lane = s % 4;
            double r = p[v][lane], scale = 1.0;
            if (cubic[s] != 0.0) {
                const double to = r;
                for (int turn = 0; turn < 8; ++turn) {
                    const double off = r - principal_point[s];
                    const double missing = r + cubic[s] * off * off * off - to;
                    r -= missing / (1.0 + 3.0 * cubic[s] * off * off);
                }
                const double off = r - principal_point[s];
                scale = 1.0 / (1.0 + 3.0 * cubic[s] * off * off);
            }
            for (int i = 0; i < 3; ++i) slope(t)[3 * s + i] = scale * g[i][v][lane];
            if (job.degree != 0) {
                r -= value[v][lane];
                for (int i = 0; i < 3; ++i) slope(t)[3 * s + i] -= by[i][v][lane];
            }
            reading(t)[s] = r;
            visible[t * S + s] = r >= job.first[s] && r <= job.last[s];
        }
    };
    auto look = [&](int t, int s) APART {
        const double *g = slope(t) + 3 * s, *c = spread_of(t), *b = biased(t);
        double at = reading(t)[s], v = bias_of(t)[s * S + s];
        for (int i = 0; i < 3; ++i) {
            at += g[i] * (whole(t)[i] - place(t)[i]);
            v += 2.0 * g[i] * b[i * S + s];
            for (int j = 0; j < 3; ++j) v += g[i] * c[3 * i + j] * g[j];
        }
        present(t)[s] = at;
        expected_variance(t)[s] = larger(v, 0.0);
    };
    // Cholesky in place of the lower triangle (n rows of S); returns the log of the determinant.
    auto cholesky = [&](double* a, int n) APART -> double {
        double product = 0.0;
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j <= i; ++j) {
                double rest = a[i * S + j];
                for (int k = 0; k < j; ++k) rest -= a[i * S + k] * a[j * S + k];
                a[i * S + j] = i == j ? sqrt(rest) : rest / a[j * S + j];
            }
            product += 2.0 * log(a[i * S + i]);
        }
        return product;
    };
    // The covariance of n predicted and noisy readings, by a state's place (rows of 9 or 3).
    auto innovation = [&](int t, const double* p, int row, const double* q, const int* used, int n,
                          const double* noise, double* total) APART {
        for (int a = 0; a < n; ++a)
            for (int b = 0; b <= a; ++b) {
                const int s = used[a], r = used[b];
                const double *g = slope(t) + 3 * s, *h = slope(t) + 3 * r;
                double sum = bias_of(t)[s * S + r] + (a == b ? noise[a] : 0.0);
                for (int i = 0; i < 3; ++i) {
                    sum += g[i] * q[i * S + r] + h[i] * q[i * S + s];
                    for (int j = 0; j < 3; ++j) sum += g[i] * p[row * i + j] * h[j];
                }
                total[a * S + b] = sum;
            }
    };
    // Residuals of readings in what all others and the prediction leave, over their deviations.
    auto left_out = [&](int t, const int* used, int n, const double* noise, const double* off,
                        double* result) APART {
        double a[S * S], inverse[S * S];
        innovation(t, spread_of(t), 3, biased(t), used, n, noise, a);
        cholesky(a, n);
        for (int c = 0; c < n; ++c)
            for (int i = c; i < n; ++i) {
                double rest = i == c ? 1.0 : 0.0;
                for (int k = c; k < i; ++k) rest -= a[i * S + k] * inverse[k * S + c];
                inverse[i * S + c] = rest / a[i * S + i];
            }
        double half[S];
        for (int i = 0; i < n; ++i) {
            half[i] = 0.0;
            for (int k = 0; k <= i; ++k) half[i] += inverse[i * S + k] * off[k];
        }
        for (int i = 0; i < n; ++i) {
            double weighted = 0.0, own = 0.0;
            for (int k = i; k < n; ++k) {
                weighted += inverse[k * S + i] * half[k];
                own += inverse[k * S + i] * inverse[k * S + i];
            }
            result[i] = weighted / sqrt(own);
        }
    };
    // One model's state after n readings; returns the log likelihood, and the squared innovation.
    auto joint = [&](double* mean, double* p, double* q, int t, const int* used, int n,
                     const double* noise, const double* off, double& squared) APART -> double {
        double a[S * S], across[S * 9], half[S];
        innovation(t, p, 9, q, used, n, noise, a);
        const double product = cholesky(a, n);
        // L^-1 of the innovations and of the covariance of readings with the state, row by row.
        double towards[S * S];
        squared = 0.0;
        for (int c = 0; c < n; ++c) {
            const double* g = slope(t) + 3 * used[c];
            for (int i = 0; i < 9; ++i)
                across[9 * c + i] = g[0] * p[9 * i] + g[1] * p[9 * i + 1] + g[2] * p[9 * i + 2]
                    + q[i * S + used[c]];
            for (int r = 0; r < S; ++r)
                towards[c * S + r] = g[0] * q[r] + g[1] * q[S + r] + g[2] * q[2 * S + r]
                    + bias_of(t)[used[c] * S + r];
            half[c] = off[c];
            for (int k = 0; k < c; ++k) {
                const double l = a[c * S + k];
                half[c] -= l * half[k];
                for (int i = 0; i < 9; ++i) across[9 * c + i] -= l * across[9 * k + i];
                for (int r = 0; r < S; ++r) towards[c * S + r] -= l * towards[k * S + r];
            }
            const double one = 1.0 / a[c * S + c];
            half[c] *= one;
            for (int i = 0; i < 9; ++i) across[9 * c + i] *= one;
            for (int r = 0; r < S; ++r) towards[c * S + r] *= one;
            squared += half[c] * half[c];
        }
        for (int c = 0; c < n; ++c) {
            const double* u = across + 9 * c;
            for (int i = 0; i < 9; ++i) {
                mean[i] += u[i] * half[c];
                for (int j = 0; j < 9; ++j) p[9 * i + j] -= u[i] * u[j];
                for (int r = 0; r < S; ++r) q[i * S + r] -= u[i] * towards[c * S + r];
            }
        }
        return -0.5 * (squared + product + n * log(two_pi));
    };
    // A track's states after one sensor's reading, which is one of ``count`` or none.
    auto soft = [&](int t, int s, int count, const double* weight, const double* difference,
                    const double* noise) APART {
        const double* g = slope(t) + 3 * s;
        double nothing = 1.0, sums[8], total_chance = 0.0;
        for (int c = 0; c < count; ++c) nothing -= weight[c];
        nothing = larger(nothing, 0.0);
        for (int k = 0; k < M; ++k) {
            double *p = covariance_of(t, k), *q = with_bias_of(t, k), *m = mean_of(t, k);
            double across[9], towards[S], own = bias_of(t)[s * S + s], apart = 0.0;
            for (int i = 0; i < 9; ++i)
                across[i] = p[9 * i] * g[0] + p[9 * i + 1] * g[1] + p[9 * i + 2] * g[2]
                    + q[i * S + s];
            for (int i = 0; i < 3; ++i) {
                own += (across[i] + q[i * S + s]) * g[i];
                apart += (m[i] - whole(t)[i]) * g[i];
            }
            for (int r = 0; r < S; ++r)
                towards[r] = g[0] * q[r] + g[1] * q[S + r] + g[2] * q[2 * S + r]
                    + bias_of(t)[s * S + r];
            double sum = nothing, shift = 0.0, known = 0.0, spread = 0.0;
            for (int turn = 0; turn < 2; ++turn)
                for (int c = 0; c < count; ++c) {
                    const double v = own + noise[c], w = expected_variance(t)[s] + noise[c];
                    const double d = difference[c] - apart, e = difference[c];
                    const double gap = -0.5 * (d * d / v + log(v)) + 0.5 * (e * e / w + log(w));
                    const double likely = weight[c] * exp(smaller(gap, 50.0));
                    if (turn == 0) {
                        sum += likely;
                        continue;
                    }
                    const double chance = likely / larger(sum, 1e-300), by = d / v;
                    shift += chance * by;
                    known += chance / v;
                    spread += chance * by * by;
                }
            spread -= shift * shift;
            for (int i = 0; i < 9; ++i) {
                m[i] += shift * across[i];
                const double by = (known - spread) * across[i];
                for (int j = 0; j < 9; ++j) p[9 * i + j] -= by * across[j];
                for (int r = 0; r < S; ++r) q[i * S + r] -= known * across[i] * towards[r];
            }
            sums[k] = job.probability[t * M + k] * larger(sum, 1e-12);
            total_chance += sums[k];
        }
        for (int k = 0; k < M; ++k) job.probability[t * M + k] = sums[k] / total_chance;
    };
"""
