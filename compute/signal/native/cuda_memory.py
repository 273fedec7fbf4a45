"""Native source for CUDA: a warp's lines in shared memory, its queues, and the backgrounds."""

from typing import Final

from compute.signal.native.cuda_sizes import BLOCK_THREADS, LINES_PER_BATCH, STAGED_PIXELS

_CHUNKS: Final = 31 + 256
_TOPS: Final = 31 + 128

# 8 pixels are a chunk: 16 bytes. The warp's lines are brought to shared memory, each filled up to
# whole chunks with dark pixels; of lines that are too long, one block after another. Queues, in
# the order of lines and pixels: the entry of a chunk or a top is its number and, in the high bits,
# its line's.
QUEUES: Final = f"""
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
BEGIN: Final = f"""
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
