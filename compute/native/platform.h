// What differs between the compilers that read these headers: Warp's Clang for the CPU, NVRTC for
// CUDA, and a host compiler for the linter and the unit tests.
#pragma once

#if !defined(WP_NO_CRT)
// A host compiler. Warp's own declare these functions before they read the headers.
#include <math.h>
#endif

#if defined(__CUDACC__)
#define LUMILINE_FN __device__ inline
#define LUMILINE_NOINLINE __device__ __noinline__
#else
#define LUMILINE_FN inline
// Kept as functions: copied to wherever they are called, they take ten seconds to compile.
#define LUMILINE_NOINLINE __attribute__((noinline)) inline
#endif

#if defined(__CUDACC__) || defined(__clang__)
#define LUMILINE_UNROLL _Pragma("unroll")
#else
#define LUMILINE_UNROLL
#endif

namespace lumiline {

LUMILINE_FN double infinity() { return 1.0 / 0.0; }

LUMILINE_FN double not_a_number() { return infinity() - infinity(); }

LUMILINE_FN bool is_finite(double x) { return x - x == 0.0; }

LUMILINE_FN double larger(double a, double b) { return a > b ? a : b; }

LUMILINE_FN double smaller(double a, double b) { return a < b ? a : b; }

LUMILINE_FN int larger(int a, int b) { return a > b ? a : b; }

LUMILINE_FN int smaller(int a, int b) { return a < b ? a : b; }

}  // namespace lumiline
