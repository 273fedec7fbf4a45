// The scans of a CUDA warp in shared memory.
//
// 8 pixels are a chunk: 16 bytes. The warp's scans are brought to shared memory, each filled up to
// whole chunks with dark pixels, and a dark chunk before and behind each; of scans that are too
// long, one block after another. Two queues of what each lane is to take next, each scan's entries
// in the order of its pixels: neighbouring bright chunks, and maxima.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/centroid.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

#if defined(__CUDA_ARCH__)

namespace lumiline::signal {

constexpr int warps = block_threads / 32, block_chunks = block_pixels / 8;
constexpr unsigned every = 0xffffffffu;

template <int batch_scans>
struct SharedMemory {
    uint4 staged[warps][batch_scans * (block_chunks + 1) + 1];
    uint4 words[warps][batch_scans * 2];
    unsigned runs[warps][32], tops[warps][32];
    Scan scans[warps][batch_scans];
    int limits[warps][batch_scans], found[warps][batch_scans], lost[warps][batch_scans];
    unsigned long long arrivals[warps];
};

template <int batch_scans, Length length>
struct WarpMemory {
    static constexpr bool all_blocks = length == Length::block;
    static constexpr bool all_short = all_blocks || length == Length::at_most_short;
    static constexpr bool all_long = length == Length::longer;

    const Search& search;
    const int lane;
    const unsigned before;
    uint4 *const words, *const staged;
    unsigned *const run_queue, *const top_queue;
    Scan* const scan_at;
    int *const limits, *const found, *const lost;
    const int end_scan;
    int first_scan, slots = 0;
    const unsigned short* first_v;
    const int chunks, stride, scan_blocks;
    const bool in_shared;
    // Without a division; of scans of three blocks or four there is one.
    const int step_scans;
    // 16-byte copies, where every scan begins on a boundary.
    const bool whole;
    const unsigned arrival;
    unsigned phase = 0;

    LUMILINE_FN WarpMemory(const Search& from, int first, int end,
                           SharedMemory<batch_scans>& shared)
        : search(from),
          lane(threadIdx.x % 32),
          before((1u << lane) - 1u),
          words(shared.words[threadIdx.x / 32]),
          staged(shared.staged[threadIdx.x / 32] + 1),
          run_queue(shared.runs[threadIdx.x / 32]),
          top_queue(shared.tops[threadIdx.x / 32]),
          scan_at(shared.scans[threadIdx.x / 32]),
          limits(shared.limits[threadIdx.x / 32]),
          found(shared.found[threadIdx.x / 32]),
          lost(shared.lost[threadIdx.x / 32]),
          end_scan(smaller(from.scans, end)),
          first_scan(first),
          first_v((const unsigned short*)from.scans_address + (long long)first_scan * from.pixels),
          chunks((from.pixels + 7) / 8),
          stride(chunks + 1),
          scan_blocks(all_blocks ? 1 : (chunks + block_chunks - 1) / block_chunks),
          in_shared(all_short || (!all_long && scan_blocks <= batch_scans)),
          step_scans(!in_shared || scan_blocks == 1 ? batch_scans
                     : scan_blocks == 2             ? batch_scans / 2
                                                    : 1),
          whole(((from.scans_address | (unsigned long long)(from.pixels * 2)) & 15ull) == 0),
          arrival((unsigned)__cvta_generic_to_shared(shared.arrivals + threadIdx.x / 32)) {}

    // Before any scan is staged.
    LUMILINE_FN void begin() {
#if __CUDA_ARCH__ >= 900
        if (lane == 0) {
            asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" ::"r"(arrival) : "memory");
            asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
        }
#endif
        __syncwarp();
    }

    // Brings chunks of one line, from pixel `first` on.
    LUMILINE_FN void stage(uint4* to, const unsigned short* v, int first, int count) {
        if (whole) {
            const uint4* from = (const uint4*)(v + first);
#pragma unroll 4
            for (int i = lane; i < count; i += 32) {
#if __CUDA_ARCH__ >= 800
                asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(
                                 (unsigned)__cvta_generic_to_shared(to + i)),
                             "l"(from + i)
                             : "memory");
#else
                to[i] = from[i];
#endif
            }
        } else {
            for (int p = lane; p < count * 8; p += 32)
                ((unsigned short*)to)[p] = first + p < search.pixels ? v[first + p] : 0;
        }
    }

    LUMILINE_FN void end_of_stage() {
#if __CUDA_ARCH__ >= 800
        asm volatile("cp.async.commit_group;" ::: "memory");
#endif
    }

    // Waits for all that was staged, or for the first of as many blocks as there is room for.
    LUMILINE_FN void await_stage(bool for_one) {
#if __CUDA_ARCH__ >= 800
        if (for_one)
            asm volatile("cp.async.wait_group %0;" ::"n"(batch_scans - 1) : "memory");
        else
            asm volatile("cp.async.wait_group 0;" ::: "memory");
#endif
        __syncwarp();
    }

    LUMILINE_FN void stage_scans() {
        // Again for every batch: the long lines' blocks lie here too.
        if (lane <= slots) staged[lane * stride - 1] = make_uint4(0u, 0u, 0u, 0u);
#if __CUDA_ARCH__ >= 900
        // By the copy engine, which one lane a line asks.
        if (whole) {
            if (lane == 0)
                asm volatile(
                    "mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(arrival),
                    "r"(slots * chunks * 16)
                    : "memory");
            __syncwarp();
            if (lane < slots)
                asm volatile(
                    "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes"
                    " [%0], [%1], %2, [%3];" ::"r"(
                        (unsigned)__cvta_generic_to_shared(staged + lane * stride)),
                    "l"(first_v + lane * search.pixels), "r"(chunks * 16), "r"(arrival)
                    : "memory");
            return;
        }
#endif
        for (int slot = 0; slot < slots; ++slot)
            stage(staged + slot * stride, first_v + slot * search.pixels, 0, chunks);
        end_of_stage();
    }

    LUMILINE_FN void await_scans() {
#if __CUDA_ARCH__ >= 900
        if (whole) {
            unsigned there;
            do {
                asm volatile(
                    "{ .reg .pred p;"
                    " mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2;"
                    " selp.u32 %0, 1, 0, p; }"
                    : "=r"(there)
                    : "r"(arrival), "r"(phase)
                    : "memory");
            } while (there == 0u);
            phase ^= 1u;
            return;
        }
#endif
        await_stage(false);
    }

    // As early as can be: the rest is worked out meanwhile.
    LUMILINE_FN void stage_batch() {
        slots = smaller(step_scans, end_scan - first_scan);
        if (in_shared && slots > 0) stage_scans();
    }

    // Lines lie there, or are looked at where they are after the search for bright chunks.
    template <class Where>
    LUMILINE_FN const unsigned short* pixels_of(Where where, int slot) {
        if constexpr (where)
            return (const unsigned short*)(staged + slot * stride);
        else
            return first_v + (long long)slot * search.pixels;
    }

    template <class Where>
    LUMILINE_FN uint4 load_chunk(Where where, const unsigned short* v, int chunk) {
        const bool at_once = where || whole;
        if (at_once) return ((const uint4*)v)[chunk];
        unsigned value[8];
#pragma unroll
        for (int i = 0; i < 8; ++i) {
            const int p = chunk * 8 + i;
            value[i] = p < search.pixels ? v[p] : 0u;
        }
        return make_uint4(value[0] | value[1] << 16, value[2] | value[3] << 16,
                          value[4] | value[5] << 16, value[6] | value[7] << 16);
    }
};

}  // namespace lumiline::signal

#endif
