// Counts of a scan with the unevenness of their sensor taken out: what a search reads beside bright
// pixels, and a fit in its windows. Pixels that are dark by their raw counts are never corrected.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/definitions.gen.h"

namespace lumiline::signal {

// A pixel's record, at once.
LUMILINE_FN PixelCorrection load_correction(const PixelCorrection* corrections, int pixel) {
#if defined(__CUDA_ARCH__)
    const float2 both = __ldg((const float2*)corrections + pixel);
    return PixelCorrection{both.x, both.y};
#else
    return corrections[pixel];
#endif
}

// Count that a mean pixel would have under the same light.
LUMILINE_FN float corrected_count(const SensorCorrection& sensor, const PixelCorrection& pixel,
                                  int count) {
    const float signal = (float)count - pixel.dark;
    const float light =
        signal * (1.0f + signal * (sensor.first_bend + signal * sensor.second_bend));
    return light * pixel.scale + sensor.offset;
}

// What the background rises from the scan's middle to a pixel, in counts.
LUMILINE_FN int ramp_at(int ramp, int pixels, int pixel) {
    const long long rise = (long long)ramp * (2 * pixel - (pixels - 1));
    return (int)(rise >= 0 ? rise / (2 * ramp_unit) : -(-rise / (2 * ramp_unit)));
}

// A scan's pixels, corrected where its sensor is calibrated, less the background's ramp. A masked
// pixel has the value between its next good neighbours.
struct AdjustedPixels {
    const unsigned short* v;
    const SensorCorrection* sensor;
    const PixelCorrection* correction;
    int pixels, ramp;

    LUMILINE_FN bool is_masked(int i) const {
        return sensor != nullptr && correction[i].scale == 0.0f;
    }

    // The count as it was read; a masked pixel's says nothing.
    LUMILINE_FN int raw_count(int i) const { return is_masked(i) ? 0 : v[i]; }

    LUMILINE_FN float unrounded(int i) const {
        return corrected_count(*sensor, correction[i], v[i]);
    }

    LUMILINE_FN float corrected(int i) const {
        if (correction[i].scale != 0.0f) return unrounded(i);
        int left = i - 1, right = i + 1;
        while (left >= 0 && correction[left].scale == 0.0f) --left;
        while (right < pixels && correction[right].scale == 0.0f) ++right;
        if (left < 0 && right >= pixels) return sensor->offset;
        if (left < 0) return unrounded(right);
        if (right >= pixels) return unrounded(left);
        const float below = unrounded(left), above = unrounded(right);
        return below + (above - below) * ((float)(i - left) / (float)(right - left));
    }

    // Whole counts, so that all devices decide alike; dark beyond the scan's ends.
    LUMILINE_FN int operator[](int i) const {
        if (i < 0 || i >= pixels) return 0;
        int value = v[i];
        if (sensor != nullptr) {
            const float rounded = corrected(i) + 0.5f;
            value = rounded > 0.0f ? (int)rounded : 0;
        }
        if (ramp != 0) value -= ramp_at(ramp, pixels, i);
        return value < 0 ? 0 : value > 65535 ? 65535 : value;
    }
};

// As AdjustedPixels, of a calibrated sensor and a level background: quicker, since masked pixels
// are worked out apart.
struct CorrectedPixels {
    const unsigned short* v;
    const SensorCorrection* sensor;
    const PixelCorrection* correction;
    int pixels;

    LUMILINE_FN int raw_count(int i) const { return correction[i].scale == 0.0f ? 0 : v[i]; }

    LUMILINE_FN int operator[](int i) const {
        if ((unsigned)i >= (unsigned)pixels) return 0;
        const PixelCorrection own = load_correction(correction, i);
        if (own.scale == 0.0f) return masked_count(*this, i);
        const float rounded = corrected_count(*sensor, own, v[i]) + 0.5f;
        const int value = rounded > 0.0f ? (int)rounded : 0;
        return value > 65535 ? 65535 : value;
    }

    static LUMILINE_NOINLINE int masked_count(CorrectedPixels all, int i) {
        return AdjustedPixels{all.v, all.sensor, all.correction, all.pixels, 0}[i];
    }
};

#if !defined(__CUDA_ARCH__)
// The adjusted pixels about a peak, worked out together, which the compiler vectorises; beside the
// first and the last lie dark ones.
struct AdjustedWindow {
    static constexpr int before = 16, size = 64;
    int first = 0, last = -1;
    unsigned short values[size + 2];

    LUMILINE_FN int operator[](int i) const { return values[i - first + 1]; }

    // Whether the scan goes on beyond the window, which does not reach to a pixel.
    LUMILINE_FN bool lacks(const AdjustedPixels& v, int pixel) const {
        return pixel > last && last < v.pixels - 1;
    }

    // Whether a run ends where the window does, but not the scan.
    LUMILINE_FN bool cuts(const AdjustedPixels& v, int left, int right) const {
        return (left <= first && first > 0) || (right >= last && last < v.pixels - 1);
    }

    // Works out the pixels about one.
    LUMILINE_FN void fill(const AdjustedPixels& v, int pixel) {
        first = larger(pixel - before, 0);
        const int count = smaller(size, v.pixels - first);
        last = first + count - 1;
        if (v.sensor == nullptr) {
            for (int k = 0; k < count; ++k) values[k + 1] = v[first + k];
        } else if (count == size) {
            fill_corrected(v, size);
        } else {
            fill_corrected(v, count);
        }
        values[0] = values[count + 1] = 0;
    }

    LUMILINE_FN void fill_corrected(const AdjustedPixels& v, int count) {
        const unsigned short* raw = v.v + first;
        const PixelCorrection* own = v.correction + first;
        const float offset = v.sensor->offset;
        const float bend1 = v.sensor->first_bend, bend2 = v.sensor->second_bend;
        int masked = 0;
        for (int k = 0; k < count; ++k) {
            const float signal = (float)raw[k] - own[k].dark;
            const float light = signal * (1.0f + signal * (bend1 + signal * bend2));
            const float rounded = light * own[k].scale + offset + 0.5f;
            const int value = rounded > 0.0f ? (int)rounded : 0;
            values[k + 1] = (unsigned short)(value > 65535 ? 65535 : value);
            masked |= own[k].scale == 0.0f;
        }
        if (masked || v.ramp != 0)
            for (int k = 0; k < count; ++k)
                if (v.ramp != 0 || own[k].scale == 0.0f) values[k + 1] = v[first + k];
    }
};
#endif

}  // namespace lumiline::signal
