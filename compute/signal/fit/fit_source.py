"""The native source of the fit: from a line's candidates to its fitted peaks, in C++ for both.

One source serves the CPU and CUDA, and both round alike: no fused multiply-adds, no library
functions but the exact ones, sums in the order of the pixels. So both take the same decisions.
The parts: what all share and a line's groups (here), one peak alone in float32
(``fit_single_source``), any number of peaks and its choice in float64 (``fit_joint_source``).

On the CPU one thread takes a line. On CUDA a warp takes a few, and each lane one group.

A *candidate* is a peak of the search, a *group* the candidates that are fitted together. The
arguments are those of ``compute.signal.fit.fit_kernel``.
"""

from typing import Final

from compute.signal.centroid_settings import LEVEL_UNIT
from compute.signal.fit.candidate_groups_source import GROUPS
from compute.signal.fit.fit_settings import (
    CONVERGENCE_THRESHOLD_SIGMA,
    MAX_ITERATIONS,
    MAX_WINDOW_PX,
)
from compute.signal.fit.joint_fit_source import FIT_JOINTLY
from compute.signal.fit.single_peak_fit_source import FIT_ALONE
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakFlag

_CONSTANTS: Final = f"""
    const int joint_peaks = {MAX_JOINT_PEAKS}, max_window = {MAX_WINDOW_PX};
    const int max_iterations = {MAX_ITERATIONS};
    const double converged2 = {CONVERGENCE_THRESHOLD_SIGMA**2!r};
    const int level_unit = {LEVEL_UNIT};
    const int saturated = {PeakFlag.SATURATED:d}, clipped = {PeakFlag.CLIPPED:d};
    const int merged = {PeakFlag.MERGED:d}, truncated = {PeakFlag.TRUNCATED:d};
    const int joint = {PeakFlag.JOINT:d}, poor_fit = {PeakFlag.POOR_FIT:d};
    const int unfitted = {PeakFlag.UNFITTED:d};
    const int starts_group = 1 << 16, after_cut = 1 << 17, begin_bits = 18;
"""

_TYPES: Final = """
    struct Candidate { double position; float sigma, amplitude, width; int flags; };
    struct Fitted {
        double position;
        float sigma, amplitude, width;
        int flags;
        float chi2, covariance[3];
    };
    struct Plan {
        double width_px, log_width, prior, reach, shape_error2;
        double min_start, max_start, min_log, max_log, width_unit, margin;
        double first, inverse_step, first_node, node_step, narrow4;
        int max_joint_peaks, sloped, width_is_fitted, has_prior, sensors, nodes, pieces, limits;
        int further_peaks;
    };
    const Plan& plan = *(const Plan*)plan_address;
    // By degrees of freedom: the chi-square of less chance than the rate of false splits.
    const double* chi2_limits = (const double*)(plan_address + sizeof(Plan));
    // Cubics of the shape, by sensor, node and place; in float64, then in float32.
    struct Piece { double c0, c1, c2, c3; };
    struct alignas(16) Piece_f { float c0, c1, c2, c3; };
    const int sensor_pieces = plan.nodes * plan.pieces;
    const Piece* all_pieces = (const Piece*)(chi2_limits + plan.limits);
    const Piece_f* all_pieces_f = (const Piece_f*)(all_pieces + plan.sensors * sensor_pieces);
    union Word { unsigned bits; float value; };
    const Word quiet_nan = {0x7fc00000u};
    const float nan_f = quiet_nan.value;
"""

# What is known of the line that the fits are in. Its record: how many peaks, then these, then how
# many candidates, the background, and the candidates.
_OF_LINE: Final = """
    const unsigned short* v = nullptr;
    double dark_variance = 0.0, photon_variance = 0.0, offset = 0.0, line_background = 0.0;
    int full_scale = 0, found = 0;
    const Piece* pieces = nullptr;
    const Piece_f* pieces_f = nullptr;
    int* count = nullptr;
    Fitted* records = nullptr;
    Candidate* candidates = nullptr;
    auto take_line = [&](int line) {
        const int sensor = line % sensors;
        v = (const unsigned short*)lines_address + (long long)line * pixels;
        dark_variance = ((const double*)dark_variance_address)[sensor];
        photon_variance = ((const double*)photon_variance_address)[sensor];
        offset = ((const double*)offset_address)[sensor];
        full_scale = ((const int*)full_scale_address)[sensor];
        pieces = all_pieces + (sensor % plan.sensors) * sensor_pieces;
        pieces_f = all_pieces_f + (sensor % plan.sensors) * sensor_pieces;
        count = (int*)((char*)records_address + (long long)line * record_bytes);
        records = (Fitted*)(count + 2);
        const int* header = (const int*)(records + max_peaks);
        candidates = (Candidate*)(header + 2);
        found = header[0];
        line_background = (double)header[1] / level_unit;
    };
"""

# The logarithm and the exponential of our own: a library's differ in the last digit by device.
_MATHS: Final = """
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

# Fits the group that starts with candidate `begin` into `out`; returns the number of peaks.
_FIT_GROUP: Final = """
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

# Peaks come in the order of their positions. Where there is no room, the faintest goes (the last of
# equals), the others move up. Those before it keep their covariances with those behind it.
_PLACE: Final = """
    auto forget = [&](int place) {
        for (int back = 1; back < joint_peaks && back <= place; ++back) {
            float* covariance = records[place - back].covariance;
            for (int k = back - 1; k < 2; ++k) covariance[k] = covariance[k + 1];
            covariance[2] = 0.0f;
        }
    };
    auto place_peak = [&](const Fitted& peak) {
        if (count[0] == max_peaks) {
            count[1] = truncated;
            int faintest = 0;
            for (int k = 1; k < max_peaks; ++k)
                if (records[k].amplitude <= records[faintest].amplitude) faintest = k;
            if (records[faintest].amplitude >= peak.amplitude) {
                forget(max_peaks);
                return;
            }
            forget(faintest);
            count[0] -= 1;
            for (int k = faintest; k < count[0]; ++k) records[k] = records[k + 1];
        }
        records[count[0]++] = peak;
    };
    auto finish_line = [&](int from, int step) {
        const Fitted none = {
            (double)nan_f, nan_f, nan_f, nan_f, 0, nan_f, {0.0f, 0.0f, 0.0f}};
        for (int k = from; k < max_peaks; k += step) {
            if (k >= count[0]) records[k] = none;
            else records[k].flags |= count[1];
        }
    };
"""

_CPU: Final = """
    if (number >= lines) return;
    take_line(number);
    count[0] = count[1] = 0;
    const int groups = mark_groups();
    for (int group = 0; group < groups; ++group) {
        Fitted fitted[joint_peaks];
        const int size = fit_group(begin_of_group(group), fitted);
        for (int k = 0; k < size; ++k) place_peak(fitted[k]);
    }
    finish_line(0, 1);
"""

# Each lane marks the groups of one of the warp's lines; then each takes one group, in their order.
_CUDA: Final = """
    const int lane = threadIdx.x % 32;
    const unsigned every = 0xffffffffu, before = (1u << lane) - 1u;
    const int first_line = number * lines_per_warp;
    if (first_line >= lines) return;
    const int slots = lines - first_line < lines_per_warp ? lines - first_line : lines_per_warp;
    // The candidates were written by other lanes.
    __syncwarp();
    int groups = 0;
    if (lane < slots) {
        take_line(first_line + lane);
        count[0] = count[1] = 0;
        groups = mark_groups();
    }
    __syncwarp();
    // Groups of this line and those before it.
    int up_to = groups;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(every, up_to, step);
        if (lane >= step) up_to += other;
    }
    const int all_groups = __shfl_sync(every, up_to, 31);
    for (int start = 0; start < all_groups; start += 32) {
        const int group = start + lane;
        const bool active = group < all_groups;
        int slot = 0, earlier = 0;
        for (int k = 0; k < slots; ++k) {
            const int end = __shfl_sync(every, up_to, k);
            if (group >= end) { slot = k + 1; earlier = end; }
        }
        Fitted fitted[joint_peaks];
        int size = 0;
        if (active) {
            take_line(first_line + slot);
            size = fit_group(begin_of_group(group - earlier), fitted);
        }
        __syncwarp();
        // Lanes of the same line; idle ones are of none.
        const unsigned same = __match_any_sync(every, active ? slot : -1);
        int at = active ? count[0] : 0, total = at;
        #pragma unroll
        for (int k = 0; k < joint_peaks; ++k) {
            const unsigned have = __ballot_sync(every, size > k) & same;
            at += __popc(have & before);
            total += __popc(have);
        }
        if (__all_sync(every, !active || total <= max_peaks)) {
            for (int k = 0; k < size; ++k) records[at + k] = fitted[k];
            if (active && (same & before) == 0u) count[0] = total;
        } else {
            for (int turn = 0; turn < 32; ++turn) {
                if (turn == lane)
                    for (int k = 0; k < size; ++k) place_peak(fitted[k]);
                __syncwarp();
            }
        }
        __syncwarp();
    }
    for (int slot = 0; slot < slots; ++slot) {
        take_line(first_line + slot);
        finish_line(lane, 32);
    }
"""

FIT_PEAKS: Final = (
    _CONSTANTS
    + _TYPES
    + _OF_LINE
    + _MATHS
    + GROUPS
    + FIT_ALONE
    + FIT_JOINTLY
    + _FIT_GROUP
    + _PLACE
    + "#if defined(__CUDA_ARCH__)\n"
    + _CUDA
    + "#else\n"
    + _CPU
    + "#endif\n"
)
