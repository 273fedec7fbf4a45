"""Native source for CUDA: a warp's lines in shared memory, its queues, and the backgrounds."""

from typing import Final

from compute.signal.native.cuda_launch_sizes import BLOCK_PIXELS, BLOCK_THREADS

# 8 pixels are a chunk: 16 bytes. The warp's lines are brought to shared memory, each filled up to
# whole chunks with dark pixels, and a dark chunk before and behind each; of lines that are too
# long, one block after another. Two queues of what each lane is to take next, each line's entries
# in the order of its pixels: neighbouring bright chunks, and maxima.
CUDA_MEMORY: Final = f"""
    const int warps = {BLOCK_THREADS} / 32, block_chunks = {BLOCK_PIXELS} / 8;
    __shared__ uint4 all_staged[warps][batch_lines * (block_chunks + 1) + 1];
    __shared__ uint4 all_words[warps][batch_lines * 2];
    __shared__ unsigned all_runs[warps][32], all_tops[warps][32];
    __shared__ Line all_lines[warps][batch_lines];
    __shared__ int all_limits[warps][batch_lines];
    __shared__ int all_found[warps][batch_lines];
    __shared__ int all_lost[warps][batch_lines];
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const unsigned every = 0xffffffffu, before = (1u << lane) - 1u;
    uint4* words = all_words[warp];
    unsigned* run_queue = all_runs[warp];
    unsigned* top_queue = all_tops[warp];
    Line* line_at = all_lines[warp];
    int* limits = all_limits[warp];
    int* found = all_found[warp];
    int* lost = all_lost[warp];
    const int end_line = lesser(lines, (number + 1) * lines_per_warp);
    int first_line = number * lines_per_warp, slots = 0;
    const unsigned short* first_v =
        (const unsigned short*)lines_address + (long long)first_line * pixels;
    const int chunks = (pixels + 7) / 8, stride = chunks + 1;
    const int line_blocks = all_blocks ? 1 : (chunks + block_chunks - 1) / block_chunks;
    const bool in_shared = all_short || (!all_long && line_blocks <= batch_lines);
    // Without a division; of lines of three blocks or four there is one.
    const int step_lines =
        !in_shared || line_blocks == 1 ? batch_lines : line_blocks == 2 ? batch_lines / 2 : 1;
    uint4* staged = all_staged[warp] + 1;
    // 16-byte copies, where every line begins on a boundary.
    const bool whole = ((lines_address | (unsigned long long)(pixels * 2)) & 15ull) == 0;
#if __CUDA_ARCH__ >= 900
    __shared__ unsigned long long all_arrivals[warps];
    const unsigned arrival = (unsigned)__cvta_generic_to_shared(all_arrivals + warp);
    unsigned phase = 0;
    if (lane == 0) {{
        asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(arrival) : "memory");
        asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
    }}
#endif
    // Brings chunks of one line, from pixel `first` on.
    auto stage = [&](uint4* to, const unsigned short* v, int first, int count) {{
        if (whole) {{
            const uint4* from = (const uint4*)(v + first);
            #pragma unroll 4
            for (int i = lane; i < count; i += 32) {{
#if __CUDA_ARCH__ >= 800
                asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::
                    "r"((unsigned)__cvta_generic_to_shared(to + i)), "l"(from + i) : "memory");
#else
                to[i] = from[i];
#endif
            }}
        }} else {{
            for (int p = lane; p < count * 8; p += 32)
                ((unsigned short*)to)[p] = first + p < pixels ? v[first + p] : 0;
        }}
    }};
    auto end_of_stage = [&]() {{
#if __CUDA_ARCH__ >= 800
        asm volatile("cp.async.commit_group;" ::: "memory");
#endif
    }};
    // Waits for all that was staged, or for the first of as many blocks as there is room for.
    auto await_stage = [&](bool for_one) {{
#if __CUDA_ARCH__ >= 800
        if (for_one) asm volatile("cp.async.wait_group %0;" :: "n"(batch_lines - 1) : "memory");
        else asm volatile("cp.async.wait_group 0;" ::: "memory");
#endif
        __syncwarp();
    }};
    auto stage_lines = [&]() {{
        // Again for every batch: the long lines' blocks lie here too.
        if (lane <= slots) staged[lane * stride - 1] = make_uint4(0u, 0u, 0u, 0u);
#if __CUDA_ARCH__ >= 900
        // By the copy engine, which one lane a line asks.
        if (whole) {{
            if (lane == 0)
                asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::
                    "r"(arrival), "r"(slots * chunks * 16) : "memory");
            __syncwarp();
            if (lane < slots)
                asm volatile("cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes"
                    " [%0], [%1], %2, [%3];" ::
                    "r"((unsigned)__cvta_generic_to_shared(staged + lane * stride)),
                    "l"(first_v + lane * pixels), "r"(chunks * 16), "r"(arrival) : "memory");
            return;
        }}
#endif
        for (int slot = 0; slot < slots; ++slot)
            stage(staged + slot * stride, first_v + slot * pixels, 0, chunks);
        end_of_stage();
    }};
    auto await_lines = [&]() {{
#if __CUDA_ARCH__ >= 900
        if (whole) {{
            unsigned there;
            do {{
                asm volatile("{{ .reg .pred p;"
                    " mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2;"
                    " selp.u32 %0, 1, 0, p; }}" :
                    "=r"(there) : "r"(arrival), "r"(phase) : "memory");
            }} while (there == 0u);
            phase ^= 1u;
            return;
        }}
#endif
        await_stage(false);
    }};
    // As early as can be: the rest is worked out meanwhile.
    auto stage_batch = [&]() {{
        slots = lesser(step_lines, end_line - first_line);
        if (in_shared && slots > 0) stage_lines();
    }};
    __syncwarp();
    stage_batch();
    // Lines lie there, or are looked at where they are after the search for bright chunks.
    auto pixels_of = [&](auto where, int slot) -> const unsigned short* {{
        if constexpr (where) return (const unsigned short*)(staged + slot * stride);
        else return first_v + (long long)slot * pixels;
    }};
    auto load_chunk = [&](auto where, const unsigned short* v, int chunk) -> uint4 {{
        const bool at_once = where || whole;
        if (at_once) return ((const uint4*)v)[chunk];
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
BEGIN: Final = """
    auto min_of = [&](int key) -> int {
#if __CUDA_ARCH__ >= 800
        return __reduce_min_sync(every, key);
#else
        for (int step = 16; step > 0; step /= 2)
            key = lesser(key, __shfl_xor_sync(every, key, step));
        return key;
#endif
    };
    auto sum_of = [&](uint4 words) -> int {
#if __CUDA_ARCH__ >= 610
        const unsigned ones = 0x0101u;
        return __dp2a_lo(words.x, ones, __dp2a_lo(words.y, ones,
            __dp2a_lo(words.z, ones, __dp2a_lo(words.w, ones, 0u))));
#else
        const unsigned low = 0xffffu;
        return (words.x & low) + (words.x >> 16) + (words.y & low) + (words.y >> 16)
            + (words.z & low) + (words.z >> 16) + (words.w & low) + (words.w >> 16);
#endif
    };
    const int group_chunk = lane * group_step / group_pixels;
    auto lane_line = [&]() -> Line {
        const int line = lesser(first_line + lane, lines - 1);
        return line_of(line, sensors == 1 ? 0 : line % sensors);
    };
    auto begin = [&](auto where, Line line) -> int {
        int keys[batch_lines];
        #pragma unroll
        for (int slot = 0; slot < batch_lines; ++slot) {
            keys[slot] = no_key;
            if (slot < slots && lane < groups)
                keys[slot] = sum_of(load_chunk(where, pixels_of(where, slot), group_chunk))
                    * sample_groups + lane;
        }
        // By repeated minima; those of the lines in turn, since each waits for the one before.
        int quartile = 0, sixteenth = 0;
        auto take_least = [&](bool at_quartile, bool at_sixteenth) {
            #pragma unroll
            for (int slot = 0; slot < batch_lines; ++slot) {
                const int key = min_of(keys[slot]);
                if (at_quartile && lane == slot) quartile = key;
                if (at_sixteenth && lane == slot) sixteenth = key;
                if (keys[slot] == key) keys[slot] = no_key;
            }
        };
        if (groups == sample_groups) {
            const int quarter = (sample_groups - 1) / 4, part = (sample_groups - 1) / 16;
            #pragma unroll
            for (int rank = 0; rank <= quarter; ++rank) take_least(rank == quarter, rank == part);
        } else {
            #pragma unroll 1
            for (int rank = 0; rank <= rank_quartile; ++rank)
                take_least(rank == rank_quartile, rank == rank_sixteenth);
        }
        if (lane < slots) {
            const Level level = level_of(line, quartile, sixteenth);
            line.background = level.background;
            line_at[lane] = line;
            limits[lane] = level.limit;
            found[lane] = 0;
            lost[lane] = 0;
        }
        __syncwarp();
        return line.background;
    };
"""
