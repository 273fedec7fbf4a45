"""Native source for CUDA: a warp takes a few lines, then their bright groups, then their peaks.

Lines that a warp takes together are a batch; it may take several, one after another.
"""

from typing import Final

LINES_PER_BATCH: Final = 3
BLOCK_THREADS: Final = 64
BLOCK_PIXELS: Final = 2048
"""Pixels of a line that are brought to shared memory together."""
STAGED_PIXELS: Final = LINES_PER_BATCH * BLOCK_PIXELS
LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 8)
_CHUNKS: Final = 31 + 256
_TOPS: Final = 31 + 128

# 8 pixels are a chunk: 16 bytes. The warp's lines are brought to shared memory, each filled up to
# whole chunks with dark pixels; of lines that are too long, one block after another. Queues, in
# the order of lines and pixels: the entry of a chunk or a top is its number and, in the high bits,
# its line's.
_QUEUES: Final = f"""
    const int warps = {BLOCK_THREADS} / 32, chunk_room = {_CHUNKS}, top_room = {_TOPS};
    __shared__ uint4 all_staged[warps][{STAGED_PIXELS} / 8];
    __shared__ unsigned short all_chunks[warps][chunk_room];
    __shared__ unsigned all_tops[warps][top_room];
    __shared__ Line all_lines[warps][{LINES_PER_BATCH}];
    __shared__ int all_limits[warps][{LINES_PER_BATCH}];
    __shared__ int all_found[warps][{LINES_PER_BATCH}];
    __shared__ int all_lost[warps][{LINES_PER_BATCH}];
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const unsigned every = 0xffffffffu, before = (1u << lane) - 1u;
    const int slot_shift = 13, batch_lines = {LINES_PER_BATCH};
    unsigned short* chunk_queue = all_chunks[warp];
    unsigned* top_queue = all_tops[warp];
    Line* line_at = all_lines[warp];
    int* limits = all_limits[warp];
    int* found = all_found[warp];
    int* lost = all_lost[warp];
    const int end_line = lesser(lines, (number + 1) * lines_per_warp);
    int first_line = number * lines_per_warp, slots = 0;
    const unsigned short* first_v =
        (const unsigned short*)lines_address + (long long)first_line * pixels;
    const int chunks = (pixels + 7) / 8;
    // 16-byte copies, where every line begins on a boundary.
    const bool whole = ((lines_address | (unsigned long long)(pixels * 2)) & 15ull) == 0;
    const bool short_lines = chunks <= {STAGED_PIXELS} / 8 / {LINES_PER_BATCH};
    const int stride = short_lines ? chunks * 8 : pixels;
    uint4* staged = all_staged[warp];
    const unsigned short* seen_v = short_lines ? (const unsigned short*)staged : first_v;
    int chunk_first = 0, chunk_end = 0, top_first = 0, top_end = 0;
    // Brings chunks of one line, or of all where they lie without a gap.
    auto stage = [&](uint4* to, const unsigned short* from, int count) {{
        if (whole) {{
            #pragma unroll 8
            for (int i = lane; i < count; i += 32) {{
#if __CUDA_ARCH__ >= 800
                asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::
                    "r"((unsigned)__cvta_generic_to_shared(to + i)), "l"((const uint4*)from + i));
#else
                to[i] = ((const uint4*)from)[i];
#endif
            }}
            return;
        }}
        const int first = (int)(from - first_v) % pixels;
        for (int p = lane; p < count * 8; p += 32)
            ((unsigned short*)to)[p] = first + p < pixels ? from[p] : 0;
    }};
    auto end_of_stage = [&]() {{
#if __CUDA_ARCH__ >= 800
        asm volatile("cp.async.commit_group;" ::: "memory");
#endif
    }};
    // Waits for all that was staged, or for all but the last.
    auto await_stage = [&](bool but_last) {{
#if __CUDA_ARCH__ >= 800
        if (but_last) asm volatile("cp.async.wait_group 1;" ::: "memory");
        else asm volatile("cp.async.wait_group 0;" ::: "memory");
#endif
        __syncwarp();
    }};
    // The lines of a batch, where they are looked at after the search for bright chunks.
    auto stage_batch = [&]() {{
        if (!short_lines) return;
        if (whole) stage(staged, first_v, slots * chunks);
        else
            for (int slot = 0; slot < slots; ++slot)
                stage(staged + slot * chunks, first_v + slot * pixels, chunks);
        end_of_stage();
        await_stage(false);
    }};
    auto load_chunk = [&](const unsigned short* v, int chunk) -> uint4 {{
        if (whole || short_lines) return ((const uint4*)v)[chunk];
        unsigned value[8];
        #pragma unroll
        for (int i = 0; i < 8; ++i) {{
            const int p = chunk * 8 + i;
            value[i] = p < pixels ? v[p] : 0u;
        }}
        return make_uint4(value[0] | value[1] << 16, value[2] | value[3] << 16,
            value[4] | value[5] << 16, value[6] | value[7] << 16);
    }};
"""

# First the backgrounds of all lines. A group of the sample is a chunk; its lane keeps the key. One
# lane a line works out what follows from it.
_BEGIN: Final = f"""
    auto least = [&](int key) -> int {{
#if __CUDA_ARCH__ >= 800
        return __reduce_min_sync(every, key);
#else
        for (int step = 16; step > 0; step /= 2)
            key = lesser(key, __shfl_xor_sync(every, key, step));
        return key;
#endif
    }};
    auto sum_of = [&](uint4 words) -> int {{
        const unsigned low = 0xffffu;
        return (words.x & low) + (words.x >> 16) + (words.y & low) + (words.y >> 16)
            + (words.z & low) + (words.z >> 16) + (words.w & low) + (words.w >> 16);
    }};
    auto begin = [&]() {{
        int keys[{LINES_PER_BATCH}];
        const int group_chunk = lane * group_step / group_pixels;
        #pragma unroll
        for (int slot = 0; slot < {LINES_PER_BATCH}; ++slot) {{
            keys[slot] = no_key;
            if (slot < slots && lane < groups)
                keys[slot] =
                    sum_of(load_chunk(seen_v + slot * stride, group_chunk))
                    * sample_groups + lane;
        }}
        // By repeated minima; those of the lines in turn, since each waits for the one before.
        int quartile = 0, sixteenth = 0;
        auto take_least = [&](int rank, int at_quartile, int at_sixteenth) {{
            #pragma unroll
            for (int slot = 0; slot < {LINES_PER_BATCH}; ++slot) {{
                const int key = least(keys[slot]);
                if (rank == at_quartile && lane == slot) quartile = key;
                if (rank == at_sixteenth && lane == slot) sixteenth = key;
                if (keys[slot] == key) keys[slot] = no_key;
            }}
        }};
        if (groups == sample_groups) {{
            const int quarter = (sample_groups - 1) / 4, part = (sample_groups - 1) / 16;
            #pragma unroll
            for (int rank = 0; rank <= quarter; ++rank) take_least(rank, quarter, part);
        }} else {{
            for (int rank = 0; rank <= rank_quartile; ++rank)
                take_least(rank, rank_quartile, rank_sixteenth);
        }}
        if (lane < slots) {{
            Line line = line_of(first_line + lane, (first_line + lane) % sensors);
            const Level level = level_of(line, quartile, sixteenth);
            line.v = seen_v + lane * stride;
            line.background = level.background;
            line_at[lane] = line;
            limits[lane] = level.limit;
            found[lane] = 0;
            lost[lane] = 0;
        }}
        __syncwarp();
    }};
"""

# Each lane looks at 8 neighbouring chunks; a block is 2048 pixels. A pair of pixels is bright when
# the greater of it and the limit less one is not that. Lanes begin with different ones of their
# chunks, so that no two meet at a bank of the memory.
_SCAN: Final = """
    int half = 0;
    auto stage_block = [&](int slot, int first) {
        stage(staged + half * 256, first_v + slot * pixels + first * 8,
            lesser(256, chunks - first));
        end_of_stage();
    };
    auto scan = [&](int slot, int first) {
        const uint4* block = (const uint4*)seen_v + slot * chunks + first;
        if (!short_lines) {
            // The next block comes while this one is looked at.
            block = staged + half * 256;
            const bool last_of_line = first + 256 >= chunks;
            const int next_slot = last_of_line ? slot + 1 : slot;
            __syncwarp();
            if (slot == 0 && first == 0) stage_block(0, 0);
            half = 1 - half;
            if (next_slot < slots) stage_block(next_slot, last_of_line ? 0 : first + 256);
            await_stage(next_slot < slots);
        }
        const int limit = limits[slot];
        if (limit > 65535) return;
        const unsigned below = (unsigned)(limit - 1) * 0x10001u;
        unsigned bright = 0u;
        const uint4* own = block + lane * 8;
        const int turn = lane % 8;
        auto look = [&](int i, bool there) {
            uint4 words = make_uint4(0u, 0u, 0u, 0u);
            if (there) words = own[i ^ turn];
            const unsigned most = __vmaxu2(__vmaxu2(words.x, words.y),
                __vmaxu2(__vmaxu2(words.z, words.w), below));
            if (most != below) bright |= 1u << i;
        };
        if (first + 256 <= chunks) {
            #pragma unroll
            for (int i = 0; i < 8; ++i) look(i, true);
        } else {
            #pragma unroll
            for (int i = 0; i < 8; ++i) look(i, first + lane * 8 + (i ^ turn) < chunks);
        }
        // Back into the order of chunks.
        if (turn & 1) bright = (bright & 0x55u) << 1 | (bright & 0xaau) >> 1;
        if (turn & 2) bright = (bright & 0x33u) << 2 | (bright & 0xccu) >> 2;
        if (turn & 4) bright = (bright & 0x0fu) << 4 | (bright & 0xf0u) >> 4;
        const int own_count = __popc(bright);
        int place = own_count;
        #pragma unroll
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(every, place, step);
            if (lane >= step) place += other;
        }
        const int all_count = __shfl_sync(every, place, 31);
        place += chunk_end - own_count;
        const int entry = slot << slot_shift | (first + lane * 8);
        for (; bright != 0u; bright &= bright - 1u)
            chunk_queue[place++] = (unsigned short)(entry + __ffs(bright) - 1);
        chunk_end += all_count;
        __syncwarp();
    };
"""

# Each lane one chunk: which of its pixels are bright and a maximum among their neighbours.
_SEARCH_CHUNKS: Final = """
    auto search_chunks = [&]() {
        unsigned tops = 0u;
        int start = 0, slot = 0;
        if (chunk_first + lane < chunk_end) {
            const int entry = chunk_queue[chunk_first + lane];
            const int chunk = entry & ((1 << slot_shift) - 1);
            slot = entry >> slot_shift;
            start = chunk * 8;
            const int limit = limits[slot];
            const unsigned short* v = seen_v + slot * stride;
            const uint4 words = load_chunk(v, chunk);
            const unsigned pair[4] = {words.x, words.y, words.z, words.w};
            auto at = [&](int i) -> int { return pair[i / 2] >> i % 2 * 16 & 0xffff; };
            const int left = start > 0 ? v[start - 1] : 0;
            const int right = start + 8 < pixels ? v[start + 8] : 0;
            #pragma unroll
            for (int i = 0; i < 8; ++i)
                if (at(i) >= limit && at(i) > (i > 0 ? at(i - 1) : left)
                    && at(i) >= (i < 7 ? at(i + 1) : right)) tops |= 1u << i;
        }
        chunk_first = lesser(chunk_first + 32, chunk_end);
        // Four at most: two maxima are not neighbours.
        const int own = __popc(tops);
        int place = top_end;
        #pragma unroll
        for (int k = 1; k <= 4; ++k) {
            const unsigned have = __ballot_sync(every, own >= k);
            if (have == 0u) break;
            place += __popc(have & before);
            top_end += __popc(have);
        }
        for (; tops != 0u; tops &= tops - 1u, ++place)
            top_queue[place] = slot << 16 | (start + __ffs(tops) - 1);
        __syncwarp();
    };
"""

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

CUDA_WARP: Final = _QUEUES + _BEGIN + _SCAN + _SEARCH_CHUNKS + _MEASURE_TOPS + _LOOP
