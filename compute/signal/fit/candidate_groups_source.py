"""The native source of a line's groups: candidates that are fitted together, and their windows."""

from typing import Final

GROUPS: Final = """
    auto start_width = [&](const Candidate& c) -> double {
        if (!plan.width_is_fitted) return plan.width_px;
        double w = (double)c.width / plan.width_unit;
        if (w < plan.min_start) w = plan.min_start;
        if (w > plan.max_start) w = plan.max_start;
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
    // Candidate g then also has the number of the candidate that group g begins with.
    auto mark_groups = [&]() -> int {
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
            if (end - begin <= plan.max_joint_peaks && last - first < max_window) {
                begin = end;
                continue;
            }
            int widest = begin + 1;
            for (int k = begin + 2; k < end; ++k)
                if (candidates[k].position - candidates[k - 1].position
                    > candidates[widest].position - candidates[widest - 1].position) widest = k;
            candidates[widest].flags |= starts_group | after_cut;
        }
        int groups = 0;
        for (int k = 0; k < found; ++k)
            if (candidates[k].flags & starts_group) candidates[groups++].flags |= k << begin_bits;
        return groups;
    };
    auto begin_of_group = [&](int group) -> int { return candidates[group].flags >> begin_bits; };
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
