"""Native source: modes gone on to a later instant, as ``ImmState.predict``, and their whole."""

from typing import Final

MOTION: Final = """
    auto add = [](int count, double factor, const double* __restrict__ from,
                  double* __restrict__ to) __attribute__((noinline)) {
        for (int i = 0; i < count; ++i) to[i] += factor * from[i];
    };
    auto copy = [](int count, const double* __restrict__ from,
                   double* __restrict__ to) __attribute__((noinline)) {
        for (int i = 0; i < count; ++i) to[i] = from[i];
    };
    auto zero = [](int count, double* to) __attribute__((noinline)) {
        for (int i = 0; i < count; ++i) to[i] = 0.0;
    };
    auto probabilities = [&](auto* modes) { return modes + pose_size; };
    auto offsets_of = [&](auto* modes) { return modes + pose_size + K; };
    auto covariances_of = [&](auto* modes) { return modes + pose_size + K + K * D; };
    auto rotation_of = [](const double* w, double* r) __attribute__((noinline)) {
        const double x = w[0], y = w[1], z = w[2];
        const double square = x * x + y * y + z * z, angle = sqrt(square);
        double first = 1.0 - square / 6.0, second = 0.5 - square / 24.0;
        if (angle >= 1e-4) {
            const double half = sin(0.5 * angle) / angle;
            first = sin(angle) / angle;
            second = 2.0 * half * half;
        }
        const double diagonal = 1.0 - second * square;
        const double xy = second * x * y, xz = second * x * z, yz = second * y * z;
        r[0] = diagonal + second * x * x;
        r[1] = xy - first * z;
        r[2] = xz + first * y;
        r[3] = xy + first * z;
        r[4] = diagonal + second * y * y;
        r[5] = yz - first * x;
        r[6] = xz - first * y;
        r[7] = yz + first * x;
        r[8] = diagonal + second * z * z;
    };
    auto turn = [](const double* by, const double* from, double* to) {
        double kept[9];
        for (int i = 0; i < 9; ++i) kept[i] = from[i];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                to[3 * i + j] = by[3 * i] * kept[j] + by[3 * i + 1] * kept[3 + j]
                    + by[3 * i + 2] * kept[6 + j];
    };
    // A pose that is off by a step: turn, place, velocity, turn rate.
    auto moved = [&](const double* from, const double* off, double* to) {
        double by[9];
        rotation_of(off, by);
        turn(by, from, to);
        for (int i = 0; i < 9; ++i) to[9 + i] = from[9 + i] + off[3 + i];
    };
    // States after a time, of each of so many columns.
    auto advance = [&](int columns, double h, const double* turned, double* x) {
        const double half = 0.5 * h * h;
        for (int c = 0; c < columns; ++c) {
            const double a = x[c], b = x[columns + c], d = x[2 * columns + c];
            for (int i = 0; i < 3; ++i)
                x[i * columns + c] = turned[3 * i] * a + turned[3 * i + 1] * b
                    + turned[3 * i + 2] * d;
        }
        auto row = [&](int to, int from, double factor) {
            add(3 * columns, factor, x + from * columns, x + to * columns);
        };
        row(0, 9, h);
        row(0, 15, half);
        row(3, 6, h);
        row(3, 12, half);
        row(6, 12, h);
        row(9, 15, h);
    };
    double* scratch = step.scratch;
    auto room = [&](int count) -> double* {
        double* first = scratch;
        scratch += count;
        return first;
    };
    double* came = room(K * K);
    double* square = room(D * D);
    double* mean = room(D);
    auto predict = [&](const double* from, double* to) {
        const double h = step.time_s;
        if (h == 0.0) {
            copy(pose_size + K * (1 + D + D * W), from, to);
            return;
        }
        const double stay = K > 1 ? 1.0 - (K - 1) * step.change : 1.0;
        const double more = step.manoeuvre * step.manoeuvre;
        const double *probability = probabilities(from), *off = offsets_of(from), *spread = covariances_of(from);
        double *probability_to = probabilities(to), *off_to = offsets_of(to), *spread_to = covariances_of(to);
        for (int j = 0; j < K; ++j) {
            double sum = 0.0;
            for (int i = 0; i < K; ++i)
                sum += came[j * K + i] = probability[i] * (i == j ? stay : step.change);
            for (int i = 0; i < K; ++i) came[j * K + i] /= sum;
            probability_to[j] = sum;
        }
        for (int j = 0; j < K; ++j) {
            double *own = spread_to + j * D * W, *at = off_to + j * D, constant_velocity = 0.0;
            zero(D, at);
            zero(D * W, own);
            for (int i = 0; i < K; ++i) {
                add(D, came[j * K + i], off + i * D, at);
                add(D * W, came[j * K + i], spread + i * D * W, own);
                constant_velocity += came[j * K + i] * step.constant_velocity[i];
            }
            for (int i = 0; i < K; ++i) {
                double about[D];
                for (int r = 0; r < D; ++r) about[r] = off[i * D + r] - at[r];
                for (int r = 0; r < D; ++r) add(D, came[j * K + i] * about[r], about, own + r * W);
            }
            // Where an acceleration does not last there is none; one that begins to is anything.
            const double *lasts = step.states + j * D, *initial_covariance = step.initial_covariance + j * D * D;
            for (int r = 0; r < D; ++r) {
                at[r] *= lasts[r];
                for (int c = 0; c < D; ++c)
                    own[r * W + c] = own[r * W + c] * (lasts[r] * lasts[c])
                        + more * constant_velocity * initial_covariance[r * D + c];
                for (int c = D; c < W; ++c) own[r * W + c] *= lasts[r];
            }
        }
        double turned[9], step_of_turn[3], last[D];
        copy(D, off_to + (K - 1) * D, last);
        moved(from, last, to);
        for (int i = 0; i < 3; ++i) step_of_turn[i] = h * to[15 + i];
        rotation_of(step_of_turn, turned);
        turn(turned, to, to);
        for (int i = 0; i < 3; ++i) to[9 + i] += h * to[12 + i];
        for (int j = 0; j < K; ++j) {
            double *own = spread_to + j * D * W, *at = off_to + j * D;
            for (int r = 0; r < D; ++r) at[r] -= last[r];
            advance(1, h, turned, at);
            advance(W, h, turned, own);
            for (int r = 0; r < D; ++r) copy(D, own + r * W, square + r * D);
            // The columns as well, as the rows of what is symmetric but for the turn of the rows.
            for (int r = 0; r < D; ++r)
                for (int c = 0; c < r; ++c) {
                    const double kept = square[r * D + c];
                    square[r * D + c] = square[c * D + r];
                    square[c * D + r] = kept;
                }
            advance(D, h, turned, square);
            double power = more;
            for (int term = 0; term < 5; ++term) {
                power *= h;
                add(D * D, power, step.terms + (term * K + j) * D * D, square);
            }
            // Symmetric to the bit: what rounding leaves would grow.
            for (int r = 0; r < D; ++r)
                for (int c = 0; c <= r; ++c)
                    own[r * W + c] = own[c * W + r] =
                        0.5 * square[r * D + c] + 0.5 * square[c * D + r];
        }
    };
    // The state of all modes together: a pose, its covariance and that with the common errors.
    double* joint = room(D * W);
    auto join = [&](const double* modes, int rows) {
        const double *probability = probabilities(modes), *off = offsets_of(modes), *spread = covariances_of(modes);
        zero(D, mean);
        zero(rows * W, joint);
        for (int i = 0; i < K; ++i) {
            add(D, probability[i], off + i * D, mean);
            add(rows * W, probability[i], spread + i * D * W, joint);
        }
        for (int i = 0; i < K; ++i) {
            double about[D];
            for (int r = 0; r < rows; ++r) about[r] = off[i * D + r] - mean[r];
            for (int r = 0; r < rows; ++r) add(rows, probability[i] * about[r], about, joint + r * W);
        }
    };
    auto together = [&](const double* modes, double* whole) {
        join(modes, 12);
        moved(modes, mean, whole);
        for (int r = 0; r < 12; ++r) {
            copy(12, joint + r * W, whole + pose_size + 12 * r);
            copy(E, joint + r * W + D, whole + pose_size + 144 + E * r);
        }
    };
    // That at a later instant, as ``ImmState.ahead``.
    auto ahead = [&](const double* from, double* whole) {
        const double h = step.time_s, stay = K > 1 ? 1.0 - (K - 1) * step.change : 1.0;
        double turned[9], step_of_turn[3], later[18];
        join(from, D);
        for (int i = 0; i < 3; ++i) step_of_turn[i] = h * from[15 + i];
        rotation_of(step_of_turn, turned);
        advance(1, h, turned, mean);
        advance(W, h, turned, joint);
        for (int r = 0; r < D; ++r)
            for (int c = 0; c < D; ++c) square[c * D + r] = joint[r * W + c];
        advance(D, h, turned, square);
        for (int j = 0; j < K; ++j) {
            double power = 0.0;
            for (int i = 0; i < K; ++i) power += probabilities(from)[i] * (i == j ? stay : step.change);
            for (int term = 0; term < 5; ++term) {
                power *= h;
                add(D * D, power, step.terms + (term * K + j) * D * D, square);
            }
        }
        copy(18, from, later);
        turn(turned, from, later);
        for (int i = 0; i < 3; ++i) later[9 + i] += h * from[12 + i];
        moved(later, mean, whole);
        for (int r = 0; r < 12; ++r) {
            for (int c = 0; c < 12; ++c) whole[pose_size + 12 * r + c] = square[c * D + r];
            copy(E, joint + r * W + D, whole + pose_size + 144 + E * r);
        }
    };
"""
