"""Native source for CUDA: a warp takes a few lines, then their bright groups, then their peaks."""

from typing import Final

MAX_LINES_PER_WARP: Final = 4
BLOCK_THREADS: Final = 128
LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 5)
_CHUNKS: Final = 31 + 256
_TOPS: Final = 31 + 128

# Queues in shared memory, in the order of lines and pixels. 8 pixels are a chunk: 16 bytes.
# A chunk's entry is its number and, in the high bits, its line.
_QUEUES: Final = f"""
    const int warps = {BLOCK_THREADS} / 32, chunk_room = {_CHUNKS}, top_room = {_TOPS};
    struct Top {{ unsigned short slot, top, left, right; }};
    __shared__ unsigned short all_chunks[warps][chunk_room];
    __shared__ Top all_tops[warps][top_room];
    __shared__ int all_backgrounds[warps][{MAX_LINES_PER_WARP}];
    __shared__ int all_limits[warps][{MAX_LINES_PER_WARP}];
    __shared__ int all_found[warps][{MAX_LINES_PER_WARP}];
    __shared__ int all_lost[warps][{MAX_LINES_PER_WARP}];
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const unsigned every = 0xffffffffu, before = (1u << lane) - 1u;
    const int slot_shift = 14;
    unsigned short* chunk_queue = all_chunks[warp];
    Top* top_queue = all_tops[warp];
    int* backgrounds = all_backgrounds[warp];
    int* limits = all_limits[warp];
    int* found = all_found[warp];
    int* lost = all_lost[warp];
    const int first_line = number * lines_per_warp;
    if (first_line >= lines) return;
    const int slots = lesser(lines_per_warp, lines - first_line);
    // 16-byte loads, where every line begins on a boundary.
    const bool whole = ((lines_address | (unsigned long long)(pixels * 2)) & 15ull) == 0;
    int chunk_first = 0, chunk_end = 0, top_first = 0, top_end = 0;
    auto load_chunk = [&](const unsigned short* v, int chunk) -> uint4 {{
        if (whole) return *(const uint4*)(v + chunk * 8);
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

# Each lane one peak: its centre of gravity, then its place among its line's records.
_MEASURE_TOPS: Final = """
    auto measure_tops = [&]() {
        const bool active = top_first + lane < top_end;
        Top entry = {0, 0, 0, 0};
        Record record;
        record.amplitude = 0.0f;
        if (active) {
            entry = top_queue[top_first + lane];
            const Line line = line_of(first_line + entry.slot, backgrounds[entry.slot]);
            record = measure(line, Run{entry.top, entry.left, entry.right});
        }
        top_first = lesser(top_first + 32, top_end);
        // Lanes of the same line; idle ones are of none.
        const unsigned same = __match_any_sync(every, active ? (int)entry.slot : -1);
        const int at = found[entry.slot], rank = __popc(same & before);
        Record* records = (Record*)(record_of(first_line + entry.slot) + 8);
        const bool room = !active || at + __popc(same) <= max_peaks;
        __syncwarp();
        if (__all_sync(every, room)) {
            if (active) {
                records[at + rank] = record;
                if (rank == 0) found[entry.slot] = at + __popc(same);
            }
        } else {
            // One after another, in order.
            for (int turn = 0; turn < 32; ++turn) {
                if (active && turn == lane) {
                    int place = found[entry.slot];
                    if (place < max_peaks) {
                        ++found[entry.slot];
                    } else {
                        lost[entry.slot] = truncated;
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

# Each lane one chunk: which of its pixels are maxima of peaks.
_SEARCH_CHUNKS: Final = """
    auto search_chunks = [&]() {
        const bool active = chunk_first + lane < chunk_end;
        unsigned peaks = 0u;
        Top entry = {0, 0, 0, 0};
        int start = 0;
        Line line;
        if (active) {
            const int code = chunk_queue[chunk_first + lane];
            start = (code & ((1 << slot_shift) - 1)) * 8;
            entry.slot = (unsigned short)(code >> slot_shift);
            line = line_of(first_line + entry.slot, backgrounds[entry.slot]);
            const int limit = limits[entry.slot];
            const uint4 words = load_chunk(line.v, start / 8);
            const unsigned pair[4] = {words.x, words.y, words.z, words.w};
            int left = start > 0 ? line.v[start - 1] : -1;
            #pragma unroll
            for (int i = 0; i < 8; ++i) {
                const int value = pair[i / 2] >> i % 2 * 16 & 0xffff;
                int right;
                if (i < 7) right = pair[(i + 1) / 2] >> (i + 1) % 2 * 16 & 0xffff;
                else right = start + 8 < pixels ? (int)line.v[start + 8] : -1;
                if (value >= limit && value > left && value >= right) peaks |= 1u << i;
                left = value;
            }
        }
        chunk_first = lesser(chunk_first + 32, chunk_end);
        // Four at most: two maxima are not neighbours. Each lane its next one, until none has any;
        // kept in registers until the places of all are known.
        Top tops[4];
        int own = 0;
        #pragma unroll
        for (int k = 0; k < 4; ++k) {
            if (peaks == 0u) continue;
            Run run;
            const int top = start + __ffs(peaks) - 1;
            peaks &= peaks - 1u;
            if (!is_peak(line, top, run)) continue;
            entry.top = (unsigned short)top;
            entry.left = (unsigned short)run.left;
            entry.right = (unsigned short)run.right;
            #pragma unroll
            for (int j = 0; j < 4; ++j)
                if (j == own) tops[j] = entry;
            ++own;
        }
        int at = top_end;
        #pragma unroll
        for (int k = 1; k <= 4; ++k) {
            const unsigned have = __ballot_sync(every, own >= k);
            at += __popc(have & before);
            top_end += __popc(have);
        }
        #pragma unroll
        for (int k = 0; k < 4; ++k)
            if (k < own) top_queue[at + k] = tops[k];
        __syncwarp();
    };
"""

# All lanes read 2048 pixels, 16 bytes each at a time, eight loads in flight.
_SCAN: Final = """
    Level level = {0, 0};
    const int chunks = (pixels + 7) / 8;
    auto scan = [&](int slot, int first) {
        const Line line = line_of(first_line + slot, 0);
        uint4 words[8];
        #pragma unroll
        for (int i = 0; i < 8; ++i) {
            const int chunk = first + i * 32 + lane;
            words[i] = make_uint4(0u, 0u, 0u, 0u);
            if (chunk < chunks) words[i] = load_chunk(line.v, chunk);
        }
        if (first == 0) {
            int key = lane < groups ? group_key(line.v, lane) : no_key;
            int quartile = 0, sixteenth = 0;
            for (int rank = 0; rank <= rank_quartile; ++rank) {
                quartile = least(key);
                if (rank == rank_sixteenth) sixteenth = quartile;
                if (key == quartile) key = no_key;
            }
            level = level_of(line, quartile, sixteenth);
            if (lane == 0) {
                backgrounds[slot] = level.background;
                limits[slot] = level.limit;
                found[slot] = 0;
                lost[slot] = 0;
            }
        }
        if (level.limit > 65535) return;
        // A pair of pixels is bright when the greater of it and the limit less one is not that.
        const unsigned below = (unsigned)(level.limit - 1) * 0x10001u;
        #pragma unroll
        for (int i = 0; i < 8; ++i) {
            const unsigned most = __vmaxu2(__vmaxu2(words[i].x, words[i].y),
                __vmaxu2(words[i].z, words[i].w));
            const bool bright = __vmaxu2(most, below) != below;
            const unsigned have = __ballot_sync(every, bright);
            if (bright)
                chunk_queue[chunk_end + __popc(have & before)] =
                    (unsigned short)(slot << slot_shift | (first + i * 32 + lane));
            chunk_end += __popc(have);
        }
        __syncwarp();
    };
"""

# A step runs when all lanes have work, or when no step before it has any left. What a queue holds
# then moves to its beginning.
_LOOP: Final = """
    int slot = 0, first_chunk = 0;
    for (;;) {
        const bool scanned = slot == slots;
        const int chunks_left = chunk_end - chunk_first, tops_left = top_end - top_first;
        if (tops_left >= 32 || (scanned && chunks_left == 0 && tops_left > 0)) {
            measure_tops();
        } else if (chunks_left >= 32 || (scanned && chunks_left > 0)) {
            Top entry = {0, 0, 0, 0};
            if (lane < tops_left) entry = top_queue[top_first + lane];
            __syncwarp();
            if (lane < tops_left) top_queue[lane] = entry;
            top_first = 0;
            top_end = tops_left;
            search_chunks();
        } else if (!scanned) {
            unsigned short code = 0;
            if (lane < chunks_left) code = chunk_queue[chunk_first + lane];
            __syncwarp();
            if (lane < chunks_left) chunk_queue[lane] = code;
            chunk_first = 0;
            chunk_end = chunks_left;
            scan(slot, first_chunk);
            first_chunk += 256;
            if (first_chunk >= chunks) { first_chunk = 0; ++slot; }
        } else {
            break;
        }
    }
    for (slot = 0; slot < slots; ++slot) {
        char* record = record_of(first_line + slot);
        Record* records = (Record*)(record + 8);
        const int count = found[slot];
        if (lane == 0) *(int*)record = count;
        const Record none = no_record();
        for (int k = count + lane; k < max_peaks; k += 32) records[k] = none;
        if (lost[slot] != 0)
            for (int k = lane; k < count; k += 32) records[k].flags |= lost[slot];
    }
"""

_LEAST: Final = """
    auto least = [&](int key) -> int {
#if __CUDA_ARCH__ >= 800
        return __reduce_min_sync(every, key);
#else
        for (int step = 16; step > 0; step /= 2)
            key = lesser(key, __shfl_xor_sync(every, key, step));
        return key;
#endif
    };
"""

CUDA_WARP: Final = _QUEUES + _LEAST + _MEASURE_TOPS + _SEARCH_CHUNKS + _SCAN + _LOOP
