"""Native source for CUDA: which chunks of a line are bright, and which pixels are maxima."""

from typing import Final

# A bit for each of up to 256 chunks, to `words[at ..]`. A pair of pixels is bright when the greater
# of it and the limit less one is not that.
SCAN: Final = """
    auto scan = [&](const uint4* block, int there, int limit, int at) {
        const unsigned below = (unsigned)(limit - 1) * 0x10001u;
        unsigned bits[8];
        auto look = [&](int i, bool inside) {
            uint4 pairs = make_uint4(0u, 0u, 0u, 0u);
            if (inside) pairs = block[i * 32 + lane];
            const unsigned most = __vmaxu2(__vmaxu2(pairs.x, pairs.y),
                __vmaxu2(__vmaxu2(pairs.z, pairs.w), below));
            bits[i] = __ballot_sync(every, most != below);
        };
        if (there >= block_chunks) {
            #pragma unroll
            for (int i = 0; i < 8; ++i) look(i, true);
        } else {
            #pragma unroll
            for (int i = 0; i < 8; ++i) look(i, i * 32 + lane < there);
        }
        if (lane == 0) {
            words[at] = make_uint4(bits[0], bits[1], bits[2], bits[3]);
            words[at + 1] = make_uint4(bits[4], bits[5], bits[6], bits[7]);
        }
    };
"""

# Each lane up to four neighbouring chunks: which of their pixels are bright and a maximum among
# their neighbours, as bits. Two pixels at a time: a pixel is one when it is greater than the left
# one, the limit less one, and the right one less one.
SEARCH: Final = """
    auto pair_of = [](unsigned left, unsigned right) -> unsigned {
        return __funnelshift_l(left, right, 16);
    };
    auto search = [&](auto where, unsigned entry) -> unsigned {
        const int slot = entry >> 16, start = (entry & 0x1fffu) * 8;
        const int end = start + (entry >> 13 & 3u) * 8;
        const unsigned below = (unsigned)(limits[slot] - 1) * 0x10001u, ones = 0x10001u;
        const unsigned short* v = pixels_of(where, slot);
        unsigned left = where || start > 0 ? (unsigned)v[start - 1] << 16 : 0u, tops = 0u;
        #pragma unroll 1
        for (int p = start, shift = 0; p <= end; p += 8, shift += 8) {
            const uint4 pairs = load_chunk(where, v, p / 8);
            const unsigned right = where || p + 8 < pixels ? v[p + 8] : 0u;
            const unsigned own[4] = {pairs.x, pairs.y, pairs.z, pairs.w};
            unsigned bits = 0u, to_left = pair_of(left, own[0]);
            #pragma unroll
            for (int i = 0; i < 4; ++i) {
                const unsigned to_right = pair_of(own[i], i < 3 ? own[i < 3 ? i + 1 : 0] : right);
                const unsigned most =
                    __vmaxu2(__vmaxu2(to_left, below), __vmaxu2(to_right, ones) - ones);
                bits |= __vminu2(__vmaxu2(own[i], most) ^ most, ones) << 2 * i;
                to_left = to_right;
            }
            tops |= ((bits | bits >> 15) & 0xffu) << shift;
            left = own[3];
        }
        return tops;
    };
"""
