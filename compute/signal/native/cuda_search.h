// The search on CUDA: a warp takes a few scans, then their bright chunks, then their peaks.
//
// Scans that a warp takes together are a batch; it may take several, one after another.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/background_ramp.h"
#include "compute/signal/native/centroid.h"
#include "compute/signal/native/cuda_memory.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

#if defined(__CUDA_ARCH__)

namespace lumiline::signal {

template <int batch_scans, Length length>
LUMILINE_NOINLINE void search_sloped_scans(Search search, int first_scan, int end_scan,
                                           SharedMemory<batch_scans>* shared);

template <int batch_scans, Length length, Counts counts>
struct WarpSearch : WarpMemory<batch_scans, length> {
    using Memory = WarpMemory<batch_scans, length>;
    using Memory::await_scans, Memory::await_stage, Memory::before, Memory::begin, Memory::chunks,
        Memory::end_of_stage, Memory::end_scan, Memory::first_scan, Memory::first_v, Memory::found,
        Memory::in_shared, Memory::lane, Memory::limits, Memory::load_chunk, Memory::lost,
        Memory::pixels_of, Memory::run_queue, Memory::scan_at, Memory::scan_blocks, Memory::search,
        Memory::slots, Memory::stage, Memory::stage_batch, Memory::staged, Memory::step_scans,
        Memory::stride, Memory::top_queue, Memory::words;

    const int groups, group_step, rank_of_quartile, rank_of_sixteenth, group_chunk;
    SharedMemory<batch_scans>& shared;
    int runs_waiting = 0, tops_waiting = 0;
    // Whether the lane's scan was left out, since its background has a slope.
    bool is_left_out = false;

    LUMILINE_FN WarpSearch(const Search& from, int first, int end,
                           SharedMemory<batch_scans>& own_shared)
        : Memory(from, first, end, own_shared),
          groups(from.groups()),
          group_step(from.group_step()),
          rank_of_quartile(Search::rank_of_quartile(groups)),
          rank_of_sixteenth(Search::rank_of_sixteenth(groups)),
          group_chunk(lane * group_step / group_pixels),
          shared(own_shared) {}

    // The least of all lanes' keys.
    LUMILINE_FN int min_of(int key) {
#if __CUDA_ARCH__ >= 800
        return __reduce_min_sync(every, key);
#else
        for (int step = 16; step > 0; step /= 2)
            key = smaller(key, __shfl_xor_sync(every, key, step));
        return key;
#endif
    }

    // The sum of all lanes' values.
    LUMILINE_FN int add_of(int value) {
#if __CUDA_ARCH__ >= 800
        return __reduce_add_sync(every, value);
#else
        for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(every, value, step);
        return value;
#endif
    }

    // The sum of a chunk's pixels.
    LUMILINE_FN int sum_of(uint4 words) {
#if __CUDA_ARCH__ >= 610
        const unsigned ones = 0x0101u;
        return __dp2a_lo(
            words.x, ones,
            __dp2a_lo(words.y, ones, __dp2a_lo(words.z, ones, __dp2a_lo(words.w, ones, 0u))));
#else
        const unsigned low = 0xffffu;
        return (words.x & low) + (words.x >> 16) + (words.y & low) + (words.y >> 16)
               + (words.z & low) + (words.z >> 16) + (words.w & low) + (words.w >> 16);
#endif
    }

    LUMILINE_FN Scan lane_scan() {
        const int line = smaller(first_scan + lane, search.scans - 1);
        return search.scan_of(line, search.sensors == 1 ? 0 : line % search.sensors);
    }

    // Scans in shared memory are corrected there.
    template <class Where>
    static constexpr bool corrected_in_place = counts == Counts::corrected && bool(Where{});

    LUMILINE_FN bool is_calibrated() {
        return counts == Counts::corrected
               || (counts == Counts::adjusted && search.corrections != nullptr);
    }

    // The key of the lane's group.
    template <class Where>
    LUMILINE_FN int group_key(Where where, int slot) {
        const int key =
            sum_of(load_chunk(where, pixels_of(where, slot), group_chunk)) * sample_groups + lane;
        if (!is_calibrated()) return key;
        const int sensor = search.sensors == 1 ? 0 : (first_scan + slot) % search.sensors;
        return search.shifted_key(sensor, key, lane);
    }

    // The backgrounds of all scans. A group of the sample is a chunk; its lane keeps the key. One
    // lane a scan works out what follows from it, and returns its background.
    template <class Where>
    LUMILINE_FN int estimate_backgrounds(Where where, Scan scan) {
        int keys[batch_scans];
#pragma unroll
        for (int slot = 0; slot < batch_scans; ++slot) {
            keys[slot] = slot < slots && lane < groups ? group_key(where, slot) : no_key;
        }
        // By repeated minima; those of the lines in turn, since each waits for the one before.
        int quartile = 0, sixteenth = 0;
        auto take_least = [&](bool at_quartile, bool at_sixteenth) {
#pragma unroll
            for (int slot = 0; slot < batch_scans; ++slot) {
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
            for (int rank = 0; rank <= rank_of_quartile; ++rank)
                take_least(rank == rank_of_quartile, rank == rank_of_sixteenth);
        }
        // The places of the groups that were taken, which are a lane each.
        int contrast = 0;
#pragma unroll
        for (int slot = 0; slot < batch_scans; ++slot) {
            const bool taken = lane < groups && keys[slot] == no_key;
            const int sum = add_of(taken ? 2 * lane - (groups - 1) : 0);
            if (lane == slot) contrast = sum;
        }
        const bool sloped = lane < slots && is_sloped(groups, rank_of_quartile, contrast);
        SlopedBackground beside = {0, quartile, sixteenth};
        if constexpr (counts == Counts::adjusted) {
            for (unsigned left = __ballot_sync(every, sloped); left != 0u; left &= left - 1u) {
                const int slot = __ffs(left) - 1;
                const SlopedBackground level = {0, __shfl_sync(every, quartile, slot),
                                                __shfl_sync(every, sixteenth, slot)};
                const int key = lane < groups ? group_key(where, slot) : no_key;
                const SlopedBackground better = estimate_ramp(search, key, level);
                if (lane == slot) beside = better;
            }
            scan.ramp = beside.ramp;
        } else {
            is_left_out = sloped;
        }
        if (lane < slots) {
            const Level level = search.level_of(scan, beside.quartile, beside.sixteenth);
            scan.background = level.background;
            scan_at[lane] = scan;
            // No pixel of a scan that is left out is bright.
            limits[lane] = is_left_out ? 65536 : level.limit;
            found[lane] = 0;
            lost[lane] = 0;
        }
        __syncwarp();
        return scan.background;
    }

    // A bit for each of up to 256 chunks, to words[at ..]. A pair of pixels is bright when the
    // greater of it and the limit less one is not that. `first` is the number of the first chunk.
    LUMILINE_FN void find_bright_chunks(const uint4* block, int there, int slot, int first,
                                        int at) {
        const int limit = limits[slot];
        const int ramp = counts == Counts::adjusted ? scan_at[slot].ramp : 0;
        unsigned below = (unsigned)(limit - 1) * 0x10001u;
        auto look = [&](int i, bool inside) {
            uint4 pairs = make_uint4(0u, 0u, 0u, 0u);
            if (inside) pairs = block[i * 32 + lane];
            const unsigned most =
                __vmaxu2(__vmaxu2(pairs.x, pairs.y), __vmaxu2(__vmaxu2(pairs.z, pairs.w), below));
            return __ballot_sync(every, most != below);
        };
        if (ramp != 0) {
#pragma unroll 1
            for (int i = 0; i < 8; ++i) {
                const int start = (first + i * 32 + lane) * 8;
                const int own = limit + ramp_at(ramp, search.pixels, ramp > 0 ? start : start + 7);
                below = (unsigned)(larger(smaller(own, 65536), 1) - 1) * 0x10001u;
                const unsigned bits = look(i, i * 32 + lane < there);
                if (lane == 0) ((unsigned*)(words + at))[i] = bits;
            }
            return;
        }
        unsigned bits[8];
        if (there >= block_chunks) {
#pragma unroll
            for (int i = 0; i < 8; ++i) bits[i] = look(i, true);
        } else {
#pragma unroll
            for (int i = 0; i < 8; ++i) bits[i] = look(i, i * 32 + lane < there);
        }
        if (lane == 0) {
            words[at] = make_uint4(bits[0], bits[1], bits[2], bits[3]);
            words[at + 1] = make_uint4(bits[4], bits[5], bits[6], bits[7]);
        }
    }

    LUMILINE_FN unsigned pair_of(unsigned left, unsigned right) {
        return __funnelshift_l(left, right, 16);
    }

    // Corrects the bright chunks in shared memory and those beside them; the lane's word has a bit
    // for each of 32 chunks, from chunk `first` of scan `slot` on. Its pixels' raw counts are then
    // those in global memory.
    LUMILINE_FN void correct_chunks(unsigned word, int slot, int first) {
        const int last_word = scan_blocks * 8 - 1, own_word = first / 32;
        const unsigned left = __shfl_up_sync(every, word, 1);
        const unsigned right = __shfl_down_sync(every, word, 1);
        unsigned near = word | word << 1 | word >> 1;
        if (own_word > 0) near |= left >> 31;
        if (own_word < last_word && lane < 31) near |= right << 31;
        if (slot >= slots || first >= chunks)
            near = 0u;
        else if (chunks - first < 32)
            near &= (1u << (chunks - first)) - 1u;
        if (lane < batch_scans * 8) ((unsigned*)words)[lane] = near;
        int waiting = 0, place = queue_position(__popc(near), waiting);
#pragma unroll 1
        for (; waiting > 0; waiting -= 32, place -= 32) {
#pragma unroll 1
            for (; near != 0u && place < 32; ++place, near &= near - 1u)
                run_queue[place] = slot << 16 | (first + __ffs(near) - 1);
            __syncwarp();
            if (lane < waiting) correct_chunk(run_queue[lane] >> 16, run_queue[lane] & 0xffffu);
            __syncwarp();
        }
    }

    LUMILINE_FN CorrectedPixels corrected_pixels(int slot) {
        const int sensor = scan_at[slot].sensor;
        return CorrectedPixels{first_v + (long long)slot * search.pixels,
                               search.corrections + sensor, search.pixel_corrections(sensor),
                               search.pixels};
    }

    LUMILINE_FN void correct_chunk(int slot, int chunk) {
        const CorrectedPixels all = corrected_pixels(slot);
        const SensorCorrection& sensor = *all.sensor;
        uint4* at = staged + slot * stride + chunk;
        const uint4 pairs = *at;
        const unsigned own[4] = {pairs.x, pairs.y, pairs.z, pairs.w};
        unsigned corrected[4];
        PixelCorrection pixels[8];
#pragma unroll
        for (int i = 0; i < 8; ++i)
            pixels[i] = load_correction(all.correction, smaller(chunk * 8 + i, search.pixels - 1));
        unsigned masked = 0u;
#pragma unroll
        for (int i = 0; i < 8; ++i) {
            const int raw = own[i / 2] >> 16 * (i % 2) & 0xffffu;
            const float rounded = corrected_count(sensor, pixels[i], raw) + 0.5f;
            const int value = rounded > 0.0f ? smaller((int)rounded, 65535) : 0;
            if (i % 2 == 0)
                corrected[i / 2] = value;
            else
                corrected[i / 2] |= value << 16;
            if (pixels[i].scale == 0.0f || chunk * 8 + i >= search.pixels) masked |= 1u << i;
        }
        *at = make_uint4(corrected[0], corrected[1], corrected[2], corrected[3]);
        for (; masked != 0u; masked &= masked - 1u) {
            const int i = __ffs(masked) - 1;
            ((unsigned short*)at)[i] = all[chunk * 8 + i];
        }
    }

    // Whether all chunks of a run, and the pixels beside it, are corrected.
    LUMILINE_FN bool is_corrected(int slot, const Run& run) {
        const unsigned* bits = (const unsigned*)words + slot * scan_blocks * 8;
        bool all = true;
        const int end = smaller((run.right + 1) / 8, chunks - 1);
        for (int chunk = larger(run.left - 1, 0) / 8; chunk <= end; ++chunk)
            all = all && (bits[chunk / 32] >> chunk % 32 & 1u) != 0u;
        return all;
    }

    // As find_tops, of adjusted pixels: those between the first and the last that may be bright.
    template <class Where>
    LUMILINE_FN unsigned adjusted_tops(Where where, int slot, int start, int end) {
        const Scan& scan = scan_at[slot];
        const unsigned short* v = pixels_of(where, slot);
        const auto pixels = adjusted_pixels(scan, v);
        const int limit = limits[slot];
        const int least = counts == Counts::corrected
                              ? limit
                              : smaller(raw_limit_of(search, scan, limit, start, start),
                                        raw_limit_of(search, scan, limit, end - 1, end - 1));
        const unsigned below = (unsigned)(larger(smaller(least, 65536), 1) - 1) * 0x10001u;
        unsigned bright = 0u, tops = 0u;
#pragma unroll 1
        for (int p = start; p < end; p += 8) {
            const uint4 pairs = load_chunk(where, v, p / 8);
            const unsigned own[4] = {pairs.x, pairs.y, pairs.z, pairs.w};
            unsigned bits = 0u;
#pragma unroll
            for (int i = 0; i < 4; ++i)
                bits |= __vminu2(__vmaxu2(own[i], below) ^ below, 0x10001u) << 2 * i;
            bright |= ((bits | bits >> 15) & 0xffu) << (p - start);
        }
        if (bright == 0u) return 0u;
        const int first = start + __ffs(bright) - 1, last = start + 31 - __clz(bright);
        int left = pixels[first - 1], own = pixels[first];
#pragma unroll 1
        for (int p = first; p <= last; ++p) {
            const int right = pixels[p + 1];
            if (own >= limit && own > left && own >= right) tops |= 1u << (p - start);
            left = own;
            own = right;
        }
        return tops & bright;
    }

    LUMILINE_FN auto adjusted_pixels(const Scan& scan, const unsigned short* v) {
        if constexpr (counts == Counts::corrected)
            return CorrectedPixels{v, search.corrections + scan.sensor,
                                   search.pixel_corrections(scan.sensor), search.pixels};
        else
            return search.adjusted(scan, v);
    }

    // Each lane up to four neighbouring chunks: which of their pixels are bright and a maximum
    // among their neighbours, as bits. Two pixels at a time: a pixel is one when it is greater than
    // the left one, the limit less one, and the right one less one.
    template <class Where>
    LUMILINE_FN unsigned find_tops(Where where, unsigned entry) {
        const int slot = entry >> 16, start = (entry & 0x1fffu) * 8;
        const int stop = start + (entry >> 13 & 3u) * 8;
        if constexpr (counts != Counts::raw && !corrected_in_place<Where>)
            return adjusted_tops(where, slot, start, stop + 8);
        const unsigned below = (unsigned)(limits[slot] - 1) * 0x10001u, ones = 0x10001u;
        const unsigned short* v = pixels_of(where, slot);
        unsigned left = where || start > 0 ? (unsigned)v[start - 1] << 16 : 0u, tops = 0u;
#pragma unroll 1
        for (int p = start, shift = 0; p <= stop; p += 8, shift += 8) {
            const uint4 pairs = load_chunk(where, v, p / 8);
            const unsigned right = where || p + 8 < search.pixels ? v[p + 8] : 0u;
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
    }

    // Each lane one maximum: whether it is a peak's, the peak's centre of gravity, and its position
    // among its scan's records.
    template <class Where>
    LUMILINE_FN void measure_tops(Where where, int count) {
        bool good = lane < count;
        int slot = 0;
        PeakRecord record;
        record.amplitude = 0.0f;
        if (good) {
            const unsigned entry = top_queue[lane];
            slot = entry >> 16;
            Scan scan = scan_at[slot];
            scan.v = pixels_of(where, slot);
            Run run;
            const int top = entry & 0xffffu;
            if constexpr (counts == Counts::raw) {
                good = is_peak(search, where, scan.v, scan.background, top, run);
                if (good) record = measure(search, scan, scan.v, run, scan.v[top]);
            } else if constexpr (corrected_in_place<Where>) {
                const CorrectedPixels all = corrected_pixels(slot);
                int raw_top = all.v[top];
                good = raw_top >= limits[slot];
                if (good) {
                    if (raw_top >= scan.full_scale) raw_top = all.raw_count(top);
                    run = Run{top, top, top};
                    good = is_peak(search, where, scan.v, scan.background, top, run);
                    if (!is_corrected(slot, run))
                        good = measure_corrected(search, scan, all, top, &record);
                    else if (good)
                        record = measure(search, scan, scan.v, run, raw_top);
                }
            } else {
                const auto v = adjusted_pixels(scan, scan.v);
                good = counts == Counts::corrected
                       || is_bright(search, scan, limits[slot], top, v[top], scan.v[top]);
                good = good && is_peak(search, where, v, scan.background, top, run);
                if (good) record = measure(search, scan, v, run, v.raw_count(top));
            }
        }
        // Lanes of the same line; those without a peak are of none.
        const unsigned same = __match_any_sync(every, good ? slot : -1);
        const int at = found[slot], rank = __popc(same & before);
        PeakRecord* records = (PeakRecord*)(search.record_of(first_scan + slot) + 8);
        const bool room = !good || at + __popc(same) <= search.max_peaks;
        __syncwarp();
        if (__all_sync(every, room)) {
            if (good) {
                records[at + rank] = record;
                if (rank == 0) found[slot] = at + __popc(same);
            }
        } else {
// One after another, in order.
#pragma unroll 1
            for (int owner = 0; owner < 32; ++owner) {
                if (good && owner == lane) {
                    int place = found[slot];
                    if (place < search.max_peaks) {
                        ++found[slot];
                    } else {
                        lost[slot] = flag_truncated;
                        place = make_room(search, records, record.amplitude);
                    }
                    if (place >= 0) records[place] = record;
                }
                __syncwarp();
            }
        }
        __syncwarp();
    }

    // A peak whose run is longer than what was corrected.
    static LUMILINE_NOINLINE bool measure_corrected(Search search, Scan scan, CorrectedPixels all,
                                                    int top, PeakRecord* found) {
        Run run;
        if (!is_peak(search, Bare{}, all, scan.background, top, run)) return false;
        *found = measure(search, scan, all, run, all.raw_count(top));
        return true;
    }

    // Where a lane's entries go: behind those of the lanes before. Adds the number of all.
    LUMILINE_FN int queue_position(int own, int& waiting) {
        int place = own;
#pragma unroll
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(every, place, step);
            if (lane >= step) place += other;
        }
        const int start = waiting + place - own;
        waiting += __shfl_sync(every, place, 31);
        return start;
    }

    // Entries wait in a queue until every lane has one, or all are to be taken; those for which it
    // has no room wait as bits of their lanes. A lane's word has a bit for each of 32 chunks, from
    // chunk `first` of scan `slot` on.
    template <class Where>
    LUMILINE_FN void take_chunks(Where where, unsigned word, int slot, int first, bool all) {
        // A run of bright chunks begins an entry, and every fourth chunk in it a further one.
        const unsigned fifth = word & word << 1 & word << 2 & word << 3 & word << 4;
        unsigned starts = word & ~(word << 1);
        for (unsigned more = starts << 4 & fifth; more != 0u; more = more << 4 & fifth)
            starts |= more;
        int run_place = queue_position(__popc(starts), runs_waiting);
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
                measure_tops(where, smaller(32, tops_waiting));
                tops_waiting = tops_waiting > 32 ? tops_waiting - 32 : 0;
                top_place -= 32;
            } else if (runs_waiting >= 32 || (all && runs_waiting > 0)) {
                queue_runs();
                tops = 0u;
                if (lane < runs_waiting) {
                    top_entry = run_queue[lane];
                    tops = find_tops(where, top_entry);
                    top_entry = top_entry & 0x30000u | (top_entry & 0x1fffu) * 8;
                }
                runs_waiting = runs_waiting > 32 ? runs_waiting - 32 : 0;
                run_place -= 32;
                top_place = queue_position(__popc(tops), tops_waiting);
            } else {
                break;
            }
#pragma unroll 1
            for (; tops != 0u && top_place < 32; ++top_place, tops &= tops - 1u)
                top_queue[top_place] = top_entry + __ffs(tops) - 1;
            __syncwarp();
        }
        if (!all) queue_runs();
    }

    LUMILINE_FN void finish(int background) {
        const int count = lane < slots ? found[lane] : search.max_peaks;
        const int lacks = lane < slots ? lost[lane] : 0;
        if (lane < slots)
            *(int2*)search.record_of(first_scan + lane) = make_int2(count, background);
        if (!__all_sync(every, count == search.max_peaks && lacks == 0)) {
            // Eight lanes a line.
            const int slot = lane / 8;
            const int filled = slot < slots ? found[slot] : search.max_peaks;
            const int flags = slot < slots ? lost[slot] : 0;
            PeakRecord* records = (PeakRecord*)(search.record_of(first_scan + slot) + 8);
#pragma unroll 1
            for (int k = filled + lane % 8; k < search.max_peaks; k += 8)
                records[k] = empty_record();
            if (flags != 0)
                for (int k = lane % 8; k < filled; k += 8) records[k].flags |= flags;
        }
        __syncwarp();
    }

    LUMILINE_FN int take_short_scans() {
        const Padded where;
        const Scan scan = lane_scan();
        if constexpr (counts != Counts::adjusted) await_scans();
        const int background = estimate_backgrounds(where, scan);
#pragma unroll 1
        for (int slot = 0, block = 0, at = 0; slot < slots; at += 2) {
            const int first = block * block_chunks;
            find_bright_chunks(staged + slot * stride + first, chunks - first, slot, first, at);
            if (++block == scan_blocks) {
                block = 0;
                ++slot;
            }
        }
        __syncwarp();
        const int own_block = lane / 8;
        const int slot = scan_blocks == 1 ? own_block : scan_blocks == 2 ? own_block / 2 : 0;
        const int first = (lane - slot * scan_blocks * 8) * 32;
        const bool there = slot < slots && first < chunks;
        const unsigned word = there ? ((const unsigned*)words)[lane] : 0u;
        if constexpr (corrected_in_place<Padded>) correct_chunks(word, slot, first);
        take_chunks(where, word, slot, first, true);
        return background;
    }

    LUMILINE_FN int take_long_scans() {
        const Bare where;
        // All blocks but one that there is room for are on their way while one is looked at.
        int coming_slot = 0, coming_chunk = 0, coming = 0, at = 0;
        auto stage_next = [&]() {
            if (coming_slot < slots)
                stage(staged + coming * block_chunks,
                      first_v + (long long)coming_slot * search.pixels, coming_chunk * 8,
                      smaller(block_chunks, chunks - coming_chunk));
            end_of_stage();
            coming = coming == batch_scans - 1 ? 0 : coming + 1;
            coming_chunk += block_chunks;
            if (coming_chunk >= chunks) {
                coming_chunk = 0;
                ++coming_slot;
            }
        };
        for (int k = 1; k < batch_scans; ++k) stage_next();
        const int background = estimate_backgrounds(where, lane_scan());
        for (int slot = 0; slot < slots; ++slot)
            for (int first = 0; first < chunks; first += block_chunks) {
                stage_next();
                await_stage(true);
                find_bright_chunks(staged + at * block_chunks, chunks - first, slot, first, 0);
                __syncwarp();
                at = at == batch_scans - 1 ? 0 : at + 1;
                const bool last = slot + 1 == slots && first + block_chunks >= chunks;
                const unsigned word = lane < 8 ? ((const unsigned*)words)[lane] : 0u;
                if (last || __any_sync(every, word != 0u))
                    take_chunks(where, word, slot, first + lane * 32, last);
            }
        return background;
    }

    LUMILINE_FN void solve() {
        begin();
        // As early as can be: the rest is worked out meanwhile.
        stage_batch();
        while (slots > 0) {
            finish(in_shared ? take_short_scans() : take_long_scans());
            if (__any_sync(every, is_left_out)) {
                search_sloped_scans<batch_scans, length>(search, first_scan, first_scan + slots,
                                                         &shared);
                is_left_out = false;
            }
            first_scan += step_scans;
            first_v += (long long)step_scans * search.pixels;
            stage_batch();
        }
    }

    // A batch that lies in shared memory, or of long scans.
    LUMILINE_FN void solve_again() {
        slots = end_scan - first_scan;
        if (in_shared) {
            // Part of it may be corrected.
            for (int slot = 0; slot < slots; ++slot)
                stage(staged + slot * stride, first_v + slot * search.pixels, 0, chunks);
            end_of_stage();
            await_stage(false);
        }
        finish(in_shared ? take_short_scans() : take_long_scans());
    }
};

// Searches the scans of a batch again, of which some have a background with a slope: few have. It
// is called, and all that it needs comes by value: neither costs the other scans registers.
template <int batch_scans, Length length>
LUMILINE_NOINLINE void search_sloped_scans(Search search, int first_scan, int end_scan,
                                           SharedMemory<batch_scans>* shared) {
    WarpSearch<batch_scans, length, Counts::adjusted> again(search, first_scan, end_scan, *shared);
    again.solve_again();
}

}  // namespace lumiline::signal

#endif
