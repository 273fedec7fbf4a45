"""Native source for the CPU: one thread takes a line from its first pixel to its last."""

from typing import Final

# The next pixel at the limit or above it, from `from` on; `pixels` when there is none. The block's
# maximum is what the compiler vectorises.
CPU_LINE: Final = """
    if (number >= lines) return;
    Line line = line_of(number, number % sensors);
    const unsigned short* v = line.v;
    int keys[sample_groups];
    for (int g = 0; g < sample_groups; ++g) keys[g] = g < groups ? group_key(v, g) : no_key;
    // All ranks side by side, which the compiler vectorises.
    int ranks[sample_groups] = {0};
    for (int j = 0; j < sample_groups; ++j)
        for (int g = 0; g < sample_groups; ++g) ranks[g] += keys[j] < keys[g];
    int quartile = 0, sixteenth = 0;
    for (int g = 0; g < sample_groups; ++g) {
        quartile += ranks[g] == rank_quartile ? keys[g] : 0;
        sixteenth += ranks[g] == rank_sixteenth ? keys[g] : 0;
    }
    const Level level = level_of(line, quartile, sixteenth);
    line.background = level.background;
    const int limit = level.limit;
    auto dark = [&](int p, auto size) -> bool {
        unsigned short top = 0;
        for (int i = 0; i < (int)sizeof size; ++i) top = v[p + i] > top ? v[p + i] : top;
        return top < limit;
    };
    auto search = [&](int from) -> int {
        int p = from;
        struct Block { char pixels[256]; };
        struct Piece { char pixels[64]; };
        struct Part { char pixels[8]; };
        for (; p + 256 <= pixels; p += 256) {
            // The next line's: what a CPU fetches ahead by itself ends with the page.
            for (int i = 0; i < 256; i += 32) __builtin_prefetch(v + p + pixels + i);
            if (!dark(p, Block{})) break;
        }
        while (p + 64 <= pixels && dark(p, Piece{})) p += 64;
        while (p + 8 <= pixels && dark(p, Part{})) p += 8;
        while (p < pixels && v[p] < limit) ++p;
        return p;
    };
    int* head = (int*)record_of(number);
    Record* records = (Record*)(record_of(number) + 8);
    int found = 0, lost = 0;
    for (int p = search(0); p < pixels; p = search(p)) {
        // Up to the next maximum: what is on the way down has a higher neighbour.
        while (p + 1 < pixels && v[p + 1] > v[p]) ++p;
        Run run;
        if (is_peak(Bare{}, v, line.background, p, run)) {
            const Record record = measure(line, run);
            if (found < max_peaks) {
                records[found++] = record;
            } else {
                lost = truncated;
                const int place = place_among(records, record.amplitude);
                if (place >= 0) records[place] = record;
            }
            p = run.right;
        }
        ++p;
        while (p < pixels && v[p] <= v[p - 1]) ++p;
    }
    head[0] = found;
    head[1] = line.background;
    const Record none = no_record();
    for (int k = 0; k < max_peaks; ++k) {
        if (k >= found) records[k] = none;
        else records[k].flags |= lost;
    }
"""
