// A scan as the fit reads it: pixels, noise, line spread function, candidates and results.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/fit/native/definitions.gen.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/search.h"

namespace lumiline::signal {

// Cubics of the line spread function, by sensor, node and position; in float64, then in float32.
template <class Real>
struct alignas(16) Cubic {
    Real c0, c1, c2, c3;
};

using Piece = Cubic<double>;
using PieceF = Cubic<float>;

// The pieces of the nodes about a position along the sensor.
template <class Real>
struct Rows {
    const Cubic<Real>* near;
    const Cubic<Real>* far;
    Real far_part;
    bool between_nodes;

    LUMILINE_FN Cubic<Real> piece(int k) const {
        Cubic<Real> piece = near[k];
        if (between_nodes) {
            const Cubic<Real> next = far[k];
            piece.c0 += far_part * (next.c0 - piece.c0);
            piece.c1 += far_part * (next.c1 - piece.c1);
            piece.c2 += far_part * (next.c2 - piece.c2);
            piece.c3 += far_part * (next.c3 - piece.c3);
        }
        return piece;
    }
};

// Of the pieces of one sensor.
template <class Real>
LUMILINE_FN Rows<Real> rows_at(const Plan& plan, const Cubic<Real>* pieces, double position_px) {
    if (plan.nodes == 1) return Rows<Real>{pieces, pieces, 0, false};
    const double node = (position_px - plan.first_node) / plan.node_step;
    const int below = node > 0.0 ? (node < plan.nodes - 2 ? (int)node : plan.nodes - 2) : 0;
    const double part = node - below;
    const Cubic<Real>* near = pieces + below * plan.pieces;
    const double inside = part > 0.0 ? (part < 1.0 ? part : 1.0) : 0.0;
    return Rows<Real>{near, near + plan.pieces, (Real)inside, true};
}

// Flags of a candidate beside those of a peak.
constexpr int flag_starts_group = 1 << 16, flag_after_cut = 1 << 17, begin_bits = 18;

// The scan that a thread fits. The plan is followed by the limits of chi-square and the pieces.
struct FitScan : Scan {
    const Search& search;
    const Plan& plan;
    // By degrees of freedom: the chi-square that is exceeded with the probability of a false split.
    const double* const chi2_limits;
    const int sensor_pieces;
    const Piece* const all_pieces;
    const PieceF* const all_pieces_f;
    const int pixels, max_peaks;
    // Of the scan that was taken. Its record: how many peaks, then these, then how many candidates,
    // the background, and the candidates.
    double background_counts = 0.0;
    // Of the background about the group that is fitted: level to start with, slope per pixel.
    double level = 0.0, slope = 0.0;
    int candidate_count = 0;
    // Without a calibration there are none.
    const SensorCorrection* sensor_correction = nullptr;
    const PixelCorrection* corrections = nullptr;
    const Piece* pieces = nullptr;
    const PieceF* pieces_f = nullptr;
    int* count = nullptr;
    FittedPeak* records = nullptr;
    PeakRecord* candidates = nullptr;

    LUMILINE_FN FitScan(const Search& from, unsigned long long plan_address)
        : Scan{},
          search(from),
          plan(*(const Plan*)plan_address),
          chi2_limits((const double*)(plan_address + sizeof(Plan))),
          sensor_pieces(plan.nodes * plan.pieces),
          all_pieces((const Piece*)(chi2_limits + plan.limits)),
          all_pieces_f((const PieceF*)(all_pieces + plan.sensors * sensor_pieces)),
          pixels(from.pixels),
          max_peaks(from.max_peaks) {}

    LUMILINE_FN void take_scan(int number) {
        const int own = number % search.sensors;
        static_cast<Scan&>(*this) = search.scan_of(number, own);
        if (search.corrections != nullptr) {
            sensor_correction = search.corrections + own;
            corrections = search.pixel_corrections(own);
        }
        pieces = all_pieces + (own % plan.sensors) * sensor_pieces;
        pieces_f = all_pieces_f + (own % plan.sensors) * sensor_pieces;
        count = (int*)search.record_of(number);
        records = (FittedPeak*)(count + 2);
        const int* header = (const int*)(records + max_peaks);
        candidates = (PeakRecord*)(header + 2);
        candidate_count = header[0];
        background_counts = (double)header[1] / level_unit;
    }

    LUMILINE_FN bool is_masked(int i) const {
        return corrections != nullptr && corrections[i].scale == 0.0f;
    }

    // Whether a pixel counts: neither full nor masked.
    LUMILINE_FN bool is_used(int i) const { return v[i] < full_scale && !is_masked(i); }

    // The pixel's count, corrected where the sensor is calibrated.
    LUMILINE_FN double count_at(int i) const {
        return corrections == nullptr
                   ? (double)v[i]
                   : (double)corrected_count(*sensor_correction, corrections[i], v[i]);
    }

    // The variance of a pixel that is `above` counts above the offset.
    LUMILINE_FN double variance_at(int i, double above) const {
        const double light = above > 0.0 ? photon * above : 0.0;
        if (corrections == nullptr) return dark + light;
        const double scale = corrections[i].scale;
        return scale * (scale * dark + light);
    }

    LUMILINE_FN const double* noise_chi2() const { return chi2_limits + max_window + 1; }

    // What a misfit multiplies the covariance by.
    LUMILINE_FN double variance_factor(double chi2, int dof) const {
        const double excess = chi2 - noise_chi2()[dof];
        return excess > 0.0 ? 1.0 + excess / dof : 1.0;
    }
};

}  // namespace lumiline::signal
