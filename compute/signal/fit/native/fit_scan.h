// What a fit knows of its scan: pixels, noise, line spread function, candidates and results.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/native/definitions.gen.h"

namespace lumiline::signal {

// Cubics of the line spread function, by sensor, node and position; in float64, then in float32.
struct Piece {
    double c0, c1, c2, c3;
};

struct alignas(16) PieceF {
    float c0, c1, c2, c3;
};

// Flags of a candidate beside those of a peak.
constexpr int flag_starts_group = 1 << 16, flag_after_cut = 1 << 17, begin_bits = 18;

union Word {
    unsigned bits;
    float value;
};

LUMILINE_FN float quiet_nan() {
    const Word word = {0x7fc00000u};
    return word.value;
}

// What a batch of fits is given; the plan is followed by the limits of chi-square and the pieces.
struct FitJob {
    unsigned long long lines_address;
    int lines, pixels, lines_per_warp;
    unsigned long long dark_variance_address, photon_variance_address, offset_address,
        full_scale_address;
    int sensors, max_peaks;
    unsigned long long plan_address, records_address;
    int record_bytes;
};

struct FitScan {
    const FitJob& job;
    const Plan& plan;
    // By degrees of freedom: the chi-square that is exceeded with the probability of a false split.
    const double* const chi2_limits;
    const int sensor_pieces;
    const Piece* const all_pieces;
    const PieceF* const all_pieces_f;
    const int pixels, max_peaks;
    // Of the scan that was taken. Its record: how many peaks, then these, then how many candidates,
    // the background, and the candidates.
    const unsigned short* v = nullptr;
    double dark_variance = 0.0, photon_variance = 0.0, offset = 0.0, background = 0.0;
    int full_scale = 0, found = 0;
    const Piece* pieces = nullptr;
    const PieceF* pieces_f = nullptr;
    int* count = nullptr;
    FittedPeak* records = nullptr;
    PeakRecord* candidates = nullptr;

    LUMILINE_FN explicit FitScan(const FitJob& from)
        : job(from),
          plan(*(const Plan*)from.plan_address),
          chi2_limits((const double*)(from.plan_address + sizeof(Plan))),
          sensor_pieces(plan.nodes * plan.pieces),
          all_pieces((const Piece*)(chi2_limits + plan.limits)),
          all_pieces_f((const PieceF*)(all_pieces + plan.sensors * sensor_pieces)),
          pixels(from.pixels),
          max_peaks(from.max_peaks) {}

    LUMILINE_FN void take_scan(int line) {
        const int sensor = line % job.sensors;
        v = (const unsigned short*)job.lines_address + (long long)line * pixels;
        dark_variance = ((const double*)job.dark_variance_address)[sensor];
        photon_variance = ((const double*)job.photon_variance_address)[sensor];
        offset = ((const double*)job.offset_address)[sensor];
        full_scale = ((const int*)job.full_scale_address)[sensor];
        pieces = all_pieces + (sensor % plan.sensors) * sensor_pieces;
        pieces_f = all_pieces_f + (sensor % plan.sensors) * sensor_pieces;
        count = (int*)((char*)job.records_address + (long long)line * job.record_bytes);
        records = (FittedPeak*)(count + 2);
        const int* header = (const int*)(records + max_peaks);
        candidates = (PeakRecord*)(header + 2);
        found = header[0];
        background = (double)header[1] / level_unit;
    }
};

}  // namespace lumiline::signal
