"""The native source of the fit: from a line's candidates to its fitted peaks, in C++ for both.

One source serves the CPU and CUDA, and both round alike: no fused multiply-adds, no library
functions but the exact ones, sums in the order of the pixels. So both take the same decisions.
The parts: what all share and a line's groups (here), one peak alone in float32
(``fit_single_source``), any number of peaks and its choice in float64 (``fit_joint_source``).

A *candidate* is a peak of the search, a *group* the candidates that are fitted together. The
names that come from outside: ``line_address``, ``pixels``, ``sensor``, ``dark_variance``,
``photon_variance``, ``offset``, ``full_scale``, ``max_peaks``, ``plan_address`` (what
``compute.signal.fit.fit_plan`` packs), ``candidates_address`` and ``record_address``.
"""

from typing import Final

from compute.signal.centroid_source import FIND_PEAKS_OF_LINE
from compute.signal.fit.fit_joint_source import FIT_JOINTLY
from compute.signal.fit.fit_single_source import FIT_ALONE
from compute.signal.fit.settings import CONVERGED_SIGMA, MAX_ITERATIONS, MAX_WINDOW_PX
from compute.signal.peaks import JOINT_PEAKS, PeakFlag
from compute.signal.settings import LEVEL_UNIT

FIND_CANDIDATES: Final = (
    FIND_PEAKS_OF_LINE
    + """
    // The fits start from the line's background.
    if (writes) count[1] = background;
"""
)

_CONSTANTS = f"""
    const int joint_peaks = {JOINT_PEAKS}, max_window = {MAX_WINDOW_PX};
    const int max_iterations = {MAX_ITERATIONS};
    const double converged2 = {CONVERGED_SIGMA**2!r};
    const int level_unit = {LEVEL_UNIT};
    const int saturated = {PeakFlag.SATURATED:d}, clipped = {PeakFlag.CLIPPED:d};
    const int merged = {PeakFlag.MERGED:d}, truncated = {PeakFlag.TRUNCATED:d};
    const int joint = {PeakFlag.JOINT:d}, poor_fit = {PeakFlag.POOR_FIT:d};
    const int unfitted = {PeakFlag.UNFITTED:d};
    const int starts_group = 1 << 16, after_cut = 1 << 17;
"""

_TYPES = """
    struct Candidate { double position; float sigma, amplitude, width; int flags; };
    struct Fitted {
        double position;
        float sigma, amplitude, width;
        int flags;
        float chi2, covariance[3];
    };
    struct Plan {
        double width_px, log_width, prior, reach, shape_error2;
        double least_start, most_start, least_log, most_log, width_unit, margin;
        double first, inverse_step, first_node, node_step;
        int max_joint, sloped, width_is_fitted, has_prior, sensors, nodes, places, limits;
    };
    const unsigned short* v = (const unsigned short*)line_address;
    const Plan& plan = *(const Plan*)plan_address;
    // By degrees of freedom: the chi-square of less chance than the rate of false splits.
    const double* chi2_limits = (const double*)(plan_address + sizeof(Plan));
    // Pairs (edge, slope times step), by sensor, node and place; in float64, then in float32.
    const int row_knots = 2 * plan.places, sensor_knots = plan.nodes * row_knots;
    const double* all_knots = chi2_limits + plan.limits;
    const double* knots = all_knots + (sensor % plan.sensors) * sensor_knots;
    const float* knots_f = (const float*)(all_knots + plan.sensors * sensor_knots)
        + (sensor % plan.sensors) * sensor_knots;
    union Word { unsigned bits; float value; };
    const Word quiet_nan = {0x7fc00000u};
    const float nan_f = quiet_nan.value;
"""

# The logarithm and the exponential of our own: a library's differ in the last digit by device.
_MATHS = """
    auto log_of = [](double value) -> double {
        union { double value; unsigned long long bits; } word = {value};
        int power = (int)(word.bits >> 52) - 1023;
        word.bits = (word.bits & 0x000fffffffffffffull) | 0x3ff0000000000000ull;
        double m = word.value;
        if (m > 1.4142135623730951) { m *= 0.5; power += 1; }
        const double s = (m - 1.0) / (m + 1.0), s2 = s * s;
        double sum = 1.0 / 19.0;
        for (int k = 17; k > 0; k -= 2) sum = sum * s2 + 1.0 / k;
        return 2.0 * s * sum + power * 0.6931471805599453;
    };
    // Of a small number: to 1e-16 within 0.3; more by squaring.
    auto exp_of = [](double value) -> double {
        int halvings = 0;
        while (value > 0.3 || value < -0.3) { value *= 0.5; ++halvings; }
        double sum = 1.0;
        for (int k = 12; k > 0; --k) sum = 1.0 + sum * value / k;
        for (; halvings > 0; --halvings) sum *= sum;
        return sum;
    };
"""

_GROUPS = """
    const int* header = (const int*)candidates_address;
    Candidate* candidates = (Candidate*)(candidates_address + 8);
    const int found = header[0];
    const double line_background = (double)(header[1]) / level_unit;
    auto start_width = [&](const Candidate& c) -> double {
        if (!plan.width_is_fitted) return plan.width_px;
        double w = (double)c.width / plan.width_unit;
        if (w < plan.least_start) w = plan.least_start;
        if (w > plan.most_start) w = plan.most_start;
        return w;
    };
    auto half_window = [&](const Candidate& c) -> int {
        const int h = (int)ceil(plan.reach * start_width(c)) + 1;
        return h < max_window / 2 - 1 ? h : max_window / 2 - 1;
    };
    auto pixel_of = [&](const Candidate& c) -> int { return (int)floor(c.position + 0.5); };
    auto end_of_group = [&](int begin) -> int {
        int end = begin + 1;
        while (end < found && !(candidates[end].flags & starts_group)) ++end;
        return end;
    };
    // First and last pixel of candidates, not yet cut at neighbours and at the line's ends.
    auto span_of = [&](int begin, int end, int* first, int* last) {
        for (int k = begin; k < end; ++k) {
            const int c = pixel_of(candidates[k]), h = half_window(candidates[k]);
            if (k == begin || c - h < *first) *first = c - h;
            if (k == begin || c + h > *last) *last = c + h;
        }
    };
    // Mark where groups start: first where windows do not touch, then cut what is too much.
    auto mark_groups = [&]() {
        for (int k = 0; k < found; ++k) {
            Candidate& c = candidates[k];
            c.flags &= starts_group - 1;
            if (k == 0) { c.flags |= starts_group; continue; }
            const Candidate& before = candidates[k - 1];
            if (pixel_of(before) + half_window(before) < pixel_of(c) - half_window(c))
                c.flags |= starts_group;
        }
        for (int begin = 0; begin < found;) {
            const int end = end_of_group(begin);
            int first = 0, last = 0;
            span_of(begin, end, &first, &last);
            if (end - begin <= plan.max_joint && last - first < max_window) {
                begin = end;
                continue;
            }
            int widest = begin + 1;
            for (int k = begin + 2; k < end; ++k)
                if (candidates[k].position - candidates[k - 1].position
                    > candidates[widest].position - candidates[widest - 1].position) widest = k;
            candidates[widest].flags |= starts_group | after_cut;
        }
    };
    auto window_of = [&](int begin, int end, int* first, int* last) {
        span_of(begin, end, first, last);
        if (begin > 0) {
            const double sum = candidates[begin - 1].position + candidates[begin].position;
            const int from = (int)floor(0.5 * sum) + 1;
            if (*first < from) *first = from;
        }
        if (end < found) {
            const double sum = candidates[end - 1].position + candidates[end].position;
            const int to = (int)floor(0.5 * sum);
            if (*last > to) *last = to;
        }
        if (*first < 0) *first = 0;
        if (*last > pixels - 1) *last = pixels - 1;
    };
    // More of the line, as far as midway to the neighbouring groups' windows.
    auto grown_window_of = [&](
        int begin, int end, int first, int last, int* wide_first, int* wide_last) {
        int by = (max_window - (last - first + 1)) / 2, other_first = 0, other_last = 0;
        int most = 0;
        for (int k = begin; k < end; ++k)
            if (half_window(candidates[k]) > most) most = half_window(candidates[k]);
        if (most < by) by = most;
        *wide_first = first - by > 0 ? first - by : 0;
        *wide_last = last + by < pixels - 1 ? last + by : pixels - 1;
        if (begin > 0) {
            int other = begin - 1;
            while (!(candidates[other].flags & starts_group)) --other;
            window_of(other, begin, &other_first, &other_last);
            const int from = (other_last + first) / 2 + 1;
            if (*wide_first < from) *wide_first = from;
        }
        if (end < found) {
            window_of(end, end_of_group(end), &other_first, &other_last);
            const int to = (last + other_first) / 2;
            if (*wide_last > to) *wide_last = to;
        }
    };
"""

# Fits the group that starts with candidate `begin` into `out`; returns the number of peaks.
_FIT_GROUP = """
    auto fit_group = [&](int begin, Fitted* out) -> int {
        const int end = end_of_group(begin);
        int first = 0, last = 0;
        window_of(begin, end, &first, &last);
        int written = 0;
        if (end - begin == 1) written = fit_alone(candidates[begin], first, last, out);
        if (written == 0) written = fit_jointly(begin, end, first, last, out);
        if (written == 0) {
            for (int k = begin; k < end; ++k) {
                const Candidate& c = candidates[k];
                const int flags = (c.flags & (starts_group - 1)) | unfitted;
                out[written++] = Fitted{
                    c.position, c.sigma, c.amplitude, c.width, flags, nan_f, {0.0f, 0.0f, 0.0f}};
            }
        }
        // Behind a cut there is light of neighbours that was not fitted with this.
        if (candidates[begin].flags & after_cut) out[0].flags |= merged;
        if (end < found && (candidates[end].flags & after_cut)) out[written - 1].flags |= merged;
        if (candidates[begin].flags & truncated)
            for (int k = 0; k < written; ++k) out[k].flags |= truncated;
        return written;
    };
"""

_LINE = """
    int* count = (int*)record_address;
    Fitted* records = (Fitted*)(record_address + 8);
    int placed = 0, lost = 0;
    // Peaks come in the order of their positions. No room: the faintest goes (the last of
    // equals), the others move up. Those before it keep covariances with those behind it.
    auto forget = [&](int place) {
        for (int back = 1; back < joint_peaks && back <= place; ++back) {
            float* covariance = records[place - back].covariance;
            for (int k = back - 1; k < 2; ++k) covariance[k] = covariance[k + 1];
            covariance[2] = 0.0f;
        }
    };
    mark_groups();
    for (int begin = 0; begin < found; begin = end_of_group(begin)) {
        Fitted fitted[joint_peaks];
        const int size = fit_group(begin, fitted);
        for (int k = 0; k < size; ++k) {
            if (placed == max_peaks) {
                lost = 1;
                int faintest = 0;
                for (int j = 1; j < placed; ++j)
                    if (records[j].amplitude <= records[faintest].amplitude) faintest = j;
                if (records[faintest].amplitude >= fitted[k].amplitude) {
                    forget(placed);
                    continue;
                }
                forget(faintest);
                --placed;
                for (int j = faintest; j < placed; ++j) records[j] = records[j + 1];
            }
            records[placed++] = fitted[k];
        }
    }
    count[0] = placed;
    count[1] = 0;
    const Fitted none = {
        (double)nan_f, nan_f, nan_f, nan_f, 0, nan_f, {0.0f, 0.0f, 0.0f}};
    for (int k = 0; k < max_peaks; ++k) {
        if (k >= placed) records[k] = none;
        else if (lost) records[k].flags |= truncated;
    }
"""

FIT_PEAKS_OF_LINE: Final = (
    _CONSTANTS + _TYPES + _MATHS + _GROUPS + FIT_ALONE + FIT_JOINTLY + _FIT_GROUP + _LINE
)
