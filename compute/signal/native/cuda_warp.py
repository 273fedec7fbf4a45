"""Native source for CUDA: a warp takes a few lines, then their bright groups, then their peaks.

Lines that a warp takes together are a batch; it may take several, one after another.
"""

from typing import Final

from compute.signal.native.cuda_memory import BEGIN, QUEUES
from compute.signal.native.cuda_search import SCAN, SEARCH_CHUNKS

# Each lane one maximum: whether it is a peak's, the peak's centre of gravity, and its place among
# its line's records.
_MEASURE_TOPS: Final = """
    auto measure_tops = [&]() {
        bool good = top_first + lane < top_end;
        int slot = 0;
        Record record;
        record.amplitude = 0.0f;
        if (good) {
            const unsigned entry = top_queue[top_first + lane];
            slot = entry >> 16;
            Line line = line_at[slot];
            // Said again here: so the compiler knows the memory that it is in.
            line.v = seen_v + slot * stride;
            Run run;
            good = is_peak(line.v, line.background, entry & 0xffffu, run);
            if (good) record = measure(line, run);
        }
        top_first = lesser(top_first + 32, top_end);
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

# A step runs when all lanes have work, or when no step before it has any left. What a queue holds
# then moves to its beginning.
_LOOP: Final = """
    for (; first_line < end_line; first_line += batch_lines) {
        slots = lesser(batch_lines, end_line - first_line);
        stage_batch();
        begin();
        int scan_slot = 0, scan_chunk = 0;
        for (;;) {
            const bool scanned = scan_slot == slots;
            const int chunks_left = chunk_end - chunk_first, tops_left = top_end - top_first;
            if (tops_left >= 32 || (scanned && chunks_left == 0 && tops_left > 0)) {
                measure_tops();
            } else if (chunks_left >= 32 || (scanned && chunks_left > 0)) {
                unsigned entry = 0u;
                if (lane < tops_left) entry = top_queue[top_first + lane];
                __syncwarp();
                if (lane < tops_left) top_queue[lane] = entry;
                top_first = 0;
                top_end = tops_left;
                search_chunks();
            } else if (!scanned) {
                unsigned short entry = 0;
                if (lane < chunks_left) entry = chunk_queue[chunk_first + lane];
                __syncwarp();
                if (lane < chunks_left) chunk_queue[lane] = entry;
                chunk_first = 0;
                chunk_end = chunks_left;
                scan(scan_slot, scan_chunk);
                scan_chunk += 256;
                if (scan_chunk >= chunks) { scan_chunk = 0; ++scan_slot; }
            } else {
                break;
            }
        }
        for (int slot = 0; slot < slots; ++slot) {
            char* record = record_of(first_line + slot);
            Record* records = (Record*)(record + 8);
            const int count = found[slot];
            if (lane == 0) *(int2*)record = make_int2(count, line_at[slot].background);
            for (int k = count + lane; k < max_peaks; k += 32) records[k] = no_record();
            if (lost[slot] != 0)
                for (int k = lane; k < count; k += 32) records[k].flags |= lost[slot];
        }
        __syncwarp();
        first_v += (long long)batch_lines * pixels;
        if (!short_lines) seen_v = first_v;
    }
"""

CUDA_WARP: Final = QUEUES + BEGIN + SCAN + SEARCH_CHUNKS + _MEASURE_TOPS + _LOOP
