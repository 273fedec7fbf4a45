// Scans, their background, and the thresholds of peaks. Every decision is taken in integers, so
// that all devices take the same.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/definitions.gen.h"
#include "compute/signal/native/pixel_correction.h"

namespace lumiline::signal {

// One row of pixels with the noise of its sensor, its background in 1 / level_unit counts, and the
// background's slope in 1 / ramp_unit counts per pixel.
struct Scan {
    const unsigned short* v;
    double dark, photon, offset;
    int full_scale, background, ramp, sensor;
};

// A background in 1 / level_unit counts, and the lowest count of a pixel that may be a peak's.
struct Level {
    int background, limit;
};

// Whether memory before and behind a scan's pixels holds dark ones.
struct Padded {
    constexpr LUMILINE_FN operator bool() const { return true; }
};

struct Bare {
    constexpr LUMILINE_FN operator bool() const { return false; }
};

// Scans of at most BLOCK_PIXELS, of at most SHORT_PIXELS, longer ones, or all: on CUDA, with less
// to choose from the code is shorter, which leaves the compiler more registers.
enum class Length { block, at_most_short, longer, any };

// Counts as they are, corrected ones, or what may also lie on a background with a slope.
enum class Counts { raw, corrected, adjusted };

// What a search is given: a batch of scans of `pixels` pixels, of sensor `scan % sensors`.
struct Search {
    unsigned long long scans_address, records_address;
    int scans, scans_per_warp, pixels, sensors, record_bytes;
    const double *dark_variance, *photon_variance, *offset;
    const int* full_scale;
    double detection_sigma;
    int fraction_units, weigh_above_threshold, correct_edges, min_width_px, max_peaks;
    // Of all sensors, then of all their pixels; null without a calibration.
    const SensorCorrection* corrections;

    LUMILINE_FN char* record_of(int scan) const {
        return (char*)records_address + (long long)scan * record_bytes;
    }

    LUMILINE_FN Scan scan_of(int scan, int sensor) const {
        return Scan{(const unsigned short*)scans_address + (long long)scan * pixels,
                    dark_variance[sensor],
                    photon_variance[sensor],
                    offset[sensor],
                    full_scale[sensor],
                    0,
                    0,
                    sensor};
    }

    LUMILINE_FN const PixelCorrection* pixel_corrections(int sensor) const {
        return (const PixelCorrection*)(corrections + sensors) + sensor * pixels;
    }

    // A scan's pixels, which lie at `v`, corrected and without the background's slope.
    LUMILINE_FN AdjustedPixels adjusted(const Scan& scan, const unsigned short* v) const {
        if (corrections == nullptr) return AdjustedPixels{v, nullptr, nullptr, pixels, scan.ramp};
        return AdjustedPixels{v, corrections + scan.sensor, pixel_corrections(scan.sensor), pixels,
                              scan.ramp};
    }

    // A peak's own threshold, in 1/level_unit counts, and the least count above it.
    LUMILINE_FN int threshold_of(int background, int value) const {
        const int excess = value * level_unit - background;
        return background + (int)((long long)excess * fraction_units / fraction_unit);
    }

    LUMILINE_FN int cut_of(int background, int value) const {
        return threshold_of(background, value) / level_unit + 1;
    }

    // The groups of pixels that the background is estimated from.
    LUMILINE_FN int groups() const { return smaller(pixels / group_pixels, sample_groups); }

    // Nearly always by a constant, which is quicker.
    LUMILINE_FN int group_step() const {
        return groups() == sample_groups ? (pixels - group_pixels) / (sample_groups - 1)
                                         : (pixels - group_pixels) / (groups() - 1);
    }

    static LUMILINE_FN int rank_of_quartile(int groups) { return (groups - 1) / 4; }

    static LUMILINE_FN int rank_of_sixteenth(int groups) { return (groups - 1) / 16; }

    LUMILINE_FN int start_of_group(int group, int group_step) const {
        return group * group_step / group_pixels * group_pixels;
    }

    // A group's sum as a key to rank it by; keys are unique, since its number is in the low bits.
    LUMILINE_FN int group_key(const unsigned short* v, int group, int group_step) const {
        const unsigned short* first = v + start_of_group(group, group_step);
        int sum = 0;
        for (int i = 0; i < group_pixels; ++i) sum += first[i];
        return sum * sample_groups + group;
    }

    // The key of the group's sum less what its pixels' offsets are above the mean one.
    LUMILINE_FN int shifted_key(int sensor, int key, int group) const {
        return larger(key - corrections[sensor].group_shifts[group] * sample_groups, group);
    }

    // Background and limit from the first quartile and the first sixteenth of the keys.
    LUMILINE_FN Level level_of(const Scan& scan, int quartile_key, int sixteenth_key) const {
        const int quartile = quartile_key / sample_groups;
        const int sixteenth = sixteenth_key / sample_groups;
        const int background = quartile * (level_unit / group_pixels);
        const double noise_level =
            double((quartile - sixteenth) * (level_unit / group_pixels)) / level_unit;
        double light = double(background) / level_unit - scan.offset;
        if (light < 0.0) light = 0.0;
        double sigma = sqrt(scan.dark + scan.photon * light);
        if (sigma < noise_level) sigma = noise_level;
        const double level = ceil(double(background) / level_unit + detection_sigma * sigma);
        return Level{background, level > 65536.0 ? 65536 : (int)level};
    }
};

// The search of a launch; Batch is ScanBatch of scan_kernel.py.
template <class Batch>
LUMILINE_FN Search search_of(const Batch& batch, unsigned long long scans_address, int scans,
                             int scans_per_warp, unsigned long long records_address) {
    return Search{scans_address,
                  records_address,
                  scans,
                  scans_per_warp,
                  batch.pixels,
                  batch.sensors,
                  batch.record_bytes,
                  batch.dark_variance.data,
                  batch.photon_variance.data,
                  batch.offset_counts.data,
                  batch.full_scale_counts.data,
                  batch.detection_sigma,
                  batch.fraction_units,
                  batch.weigh_above_threshold,
                  batch.correct_edges,
                  batch.min_width_px,
                  batch.max_peaks,
                  (const SensorCorrection*)batch.corrections_address};
}

}  // namespace lumiline::signal
