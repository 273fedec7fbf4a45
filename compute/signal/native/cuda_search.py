"""Native source for CUDA: which chunks of a line are bright, and which pixels are maxima."""

from typing import Final

# Each lane looks at 8 neighbouring chunks; a block is 2048 pixels. A pair of pixels is bright when
# the greater of it and the limit less one is not that. Lanes begin with different ones of their
# chunks, so that no two meet at a bank of the memory.
SCAN: Final = """
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
SEARCH_CHUNKS: Final = """
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
