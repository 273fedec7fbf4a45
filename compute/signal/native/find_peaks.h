// Threshold and centre of gravity: from scans to peaks, on the CPU and on CUDA.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/cpu_search.h"
#include "compute/signal/native/cuda_search.h"
#include "compute/signal/native/search.h"

namespace lumiline::signal {

// Finds the peaks of scan `number` on the CPU; on CUDA warp `number` finds those of its scans.
template <int batch_scans, Length length, bool corrected>
LUMILINE_FN void find_peaks(const Search& search, int number) {
#if defined(__CUDA_ARCH__)
    __shared__ SharedMemory<batch_scans> shared;
    using Hot = WarpSearch<batch_scans, length, corrected ? Counts::corrected : Counts::raw>;
    const int first = number * search.scans_per_warp;
    Hot warp(search, first, first + search.scans_per_warp, shared);
    warp.solve();
#else
    find_peaks_on_cpu(search, number);
#endif
}

}  // namespace lumiline::signal
