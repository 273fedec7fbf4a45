// Values of several sensors that are calculated together: a vector on the CPU, one value on CUDA.
#pragma once

#include "compute/native/platform.h"
#include "compute/reconstruction/native/definitions.gen.h"

namespace lumiline {

#if defined(__CUDA_ARCH__)
typedef double Lanes;
// Vectors that the values of S sensors are, and the length of rows filled up to whole vectors.
template <int S>
constexpr int vector_count = S;
template <int S>
constexpr int row_length = S;

LUMILINE_FN double sum_lanes(Lanes a) { return a; }
#else
typedef double Lanes __attribute__((vector_size(8 * cpu_lanes), aligned(8), may_alias));
template <int S>
constexpr int vector_count = (S + cpu_lanes - 1) / cpu_lanes;
template <int S>
constexpr int row_length = vector_count<S> * cpu_lanes;

LUMILINE_FN double sum_lanes(Lanes a) { return (a[0] + a[1]) + (a[2] + a[3]); }
#endif

LUMILINE_FN Lanes lanes(const double* row, int v) { return ((const Lanes*)row)[v]; }

}  // namespace lumiline
