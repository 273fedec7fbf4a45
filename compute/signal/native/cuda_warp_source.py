"""Native source for CUDA: a warp takes a few lines, then their bright chunks, then their peaks.

Lines that a warp takes together are a batch; it may take several, one after another.
"""

from typing import Final

from compute.signal.native.cuda_memory_source import BEGIN
from compute.signal.native.cuda_search_source import SCAN, SEARCH

# Each lane one maximum: whether it is a peak's, the peak's centre of gravity, and its place among
# its line's records.
_MEASURE_TOPS: Final = """
    auto measure_tops = [&](auto where, int count) {
        bool good = lane < count;
        int slot = 0;
        Record record;
        record.amplitude = 0.0f;
        if (good) {
            const unsigned entry = top_queue[lane];
            slot = entry >> 16;
            Line line = line_at[slot];
            line.v = pixels_of(where, slot);
            Run run;
            good = is_peak(where, line.v, line.background, entry & 0xffffu, run);
            if (good) record = measure(line, run);
        }
        // Lanes of the same line; those without a peak are of none.
        const unsigned same = __match_any_sync(every, good ? slot : -1);
        const int at = found[slot], rank = __popc(same & before);
        Record* records = (Record*)(record_of(first_line + slot) + 8);
        const bool room = !good || at + __popc(same) <= max_peaks;
        __syncwarp();
        if (__all_sync(every, room)) {
            if (good) {
                records[at + rank] = record;
                if (rank == 0) found[slot] = at + __popc(same);
            }
        } else {
            // One after another, in order.
            #pragma unroll 1
            for (int turn = 0; turn < 32; ++turn) {
                if (good && turn == lane) {
                    int place = found[slot];
                    if (place < max_peaks) {
                        ++found[slot];
                    } else {
                        lost[slot] = truncated;
                        place = place_among(records, record.amplitude);
                    }
                    if (place >= 0) records[place] = record;
                }
                __syncwarp();
            }
        }
        __syncwarp();
    };
"""

# Entries wait in a queue until every lane has one, or all are to be taken; those for which it has
# no room wait as bits of their lanes. A lane's word has a bit for each of 32 chunks, from chunk
# `first` of line `slot` on.
_TAKE: Final = """
    int runs_waiting = 0, tops_waiting = 0;
    // Where a lane's entries go: behind those of the lanes before. Adds the number of all.
    auto place_of = [&](int own, int& waiting) -> int {
        int place = own;
        #pragma unroll
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(every, place, step);
            if (lane >= step) place += other;
        }
        const int start = waiting + place - own;
        waiting += __shfl_sync(every, place, 31);
        return start;
    };
    auto take = [&](auto where, unsigned word, int slot, int first, bool all) {
        // A run of bright chunks begins an entry, and every fourth chunk in it a further one.
        const unsigned fifth = word & word << 1 & word << 2 & word << 3 & word << 4;
        unsigned starts = word & ~(word << 1);
        for (unsigned more = starts << 4 & fifth; more != 0u; more = more << 4 & fifth)
            starts |= more;
        int run_place = place_of(__popc(starts), runs_waiting);
        auto queue_runs = [&]() {
            #pragma unroll 1
            for (; starts != 0u && run_place < 32; ++run_place, starts &= starts - 1u) {
                const int at = __ffs(starts) - 1;
                // The chunks that follow in it: at most three, and none that begins another.
                const unsigned next = word >> at >> 1 & ~(starts >> at >> 1) & 7u;
                const int follow = next == 7u ? 3 : next % 4u == 3u ? 2 : next & 1;
                run_queue[run_place] = slot << 16 | follow << 13 | (first + at);
            }
            __syncwarp();
        };
        unsigned tops = 0u, top_entry = 0u;
        int top_place = 0;
        #pragma unroll 1
        for (;;) {
            const bool last_tops = all && runs_waiting == 0;
            if (tops_waiting >= 32 || (last_tops && tops_waiting > 0)) {
                measure_tops(where, lesser(32, tops_waiting));
                tops_waiting = tops_waiting > 32 ? tops_waiting - 32 : 0;
                top_place -= 32;
            } else if (runs_waiting >= 32 || (all && runs_waiting > 0)) {
                queue_runs();
                tops = 0u;
                if (lane < runs_waiting) {
                    top_entry = run_queue[lane];
                    tops = search(where, top_entry);
                    top_entry = top_entry & 0x30000u | (top_entry & 0x1fffu) * 8;
                }
                runs_waiting = runs_waiting > 32 ? runs_waiting - 32 : 0;
                run_place -= 32;
                top_place = place_of(__popc(tops), tops_waiting);
            } else {
                break;
            }
            #pragma unroll 1
            for (; tops != 0u && top_place < 32; ++top_place, tops &= tops - 1u)
                top_queue[top_place] = top_entry + __ffs(tops) - 1;
            __syncwarp();
        }
        if (!all) queue_runs();
    };
"""

_END: Final = """
    auto end = [&](int background) {
        const int count = lane < slots ? found[lane] : max_peaks;
        const int lacks = lane < slots ? lost[lane] : 0;
        if (lane < slots) *(int2*)record_of(first_line + lane) = make_int2(count, background);
        if (!__all_sync(every, count == max_peaks && lacks == 0)) {
            // Eight lanes a line.
            const int slot = lane / 8;
            const int filled = slot < slots ? found[slot] : max_peaks;
            const int flags = slot < slots ? lost[slot] : 0;
            Record* records = (Record*)(record_of(first_line + slot) + 8);
            #pragma unroll 1
            for (int k = filled + lane % 8; k < max_peaks; k += 8) records[k] = no_record();
            if (flags != 0)
                for (int k = lane % 8; k < filled; k += 8) records[k].flags |= flags;
        }
        __syncwarp();
    };
"""

# Lines that fit in shared memory together, or one block after another.
_LOOP: Final = """
    auto take_short_lines = [&]() -> int {
        const Padded where;
        const Line line = lane_line();
        await_lines();
        const int background = begin(where, line);
        #pragma unroll 1
        for (int slot = 0, block = 0, at = 0; slot < slots; at += 2) {
            const int first = block * block_chunks;
            scan(staged + slot * stride + first, chunks - first, limits[slot], at);
            if (++block == line_blocks) { block = 0; ++slot; }
        }
        __syncwarp();
        const int own_block = lane / 8;
        const int slot = line_blocks == 1 ? own_block : line_blocks == 2 ? own_block / 2 : 0;
        const int first = (lane - slot * line_blocks * 8) * 32;
        const bool there = slot < slots && first < chunks;
        take(where, there ? ((const unsigned*)words)[lane] : 0u, slot, first, true);
        return background;
    };
    auto take_long_lines = [&]() -> int {
        const Bare where;
        // All blocks but one that there is room for are on their way while one is looked at.
        int coming_slot = 0, coming_chunk = 0, coming = 0, at = 0;
        auto stage_next = [&]() {
            if (coming_slot < slots)
                stage(staged + coming * block_chunks, first_v + (long long)coming_slot * pixels,
                    coming_chunk * 8, lesser(block_chunks, chunks - coming_chunk));
            end_of_stage();
            coming = coming == batch_lines - 1 ? 0 : coming + 1;
            coming_chunk += block_chunks;
            if (coming_chunk >= chunks) { coming_chunk = 0; ++coming_slot; }
        };
        for (int k = 1; k < batch_lines; ++k) stage_next();
        const int background = begin(where, lane_line());
        for (int slot = 0; slot < slots; ++slot)
            for (int first = 0; first < chunks; first += block_chunks) {
                stage_next();
                await_stage(true);
                scan(staged + at * block_chunks, chunks - first, limits[slot], 0);
                __syncwarp();
                at = at == batch_lines - 1 ? 0 : at + 1;
                const bool last = slot + 1 == slots && first + block_chunks >= chunks;
                const unsigned word = lane < 8 ? ((const unsigned*)words)[lane] : 0u;
                if (last || __any_sync(every, word != 0u))
                    take(where, word, slot, first + lane * 32, last);
            }
        return background;
    };
    while (slots > 0) {
        end(in_shared ? take_short_lines() : take_long_lines());
        first_line += step_lines;
        first_v += (long long)step_lines * pixels;
        stage_batch();
    }
"""

CUDA_WARP: Final = BEGIN + SCAN + SEARCH + _MEASURE_TOPS + _TAKE + _END + _LOOP
