// Counts of a scan with the unevenness of their sensor taken out: what a search reads beside bright
// pixels, and a fit in its windows. Pixels that are dark by their raw counts are never corrected.
#pragma once

#include "compute/native/platform.h"
#include "compute/signal/native/definitions.gen.h"

namespace lumiline::signal {

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

#if !defined(__CUDA_ARCH__)
// Adjusted pixels of which those about a peak are worked out together, which the compiler
// vectorises.
struct BufferedPixels : AdjustedPixels {
    static constexpr int before = 16, size = 64;
    int first = -size - 1;
    int buffer[size];

    LUMILINE_FN explicit BufferedPixels(const AdjustedPixels& adjusted)
        : AdjustedPixels(adjusted) {}

    // Works out the pixels about one.
    LUMILINE_FN void fetch(int pixel) {
        if (pixels < size || sensor == nullptr) return;
        first = pixel - before;
        if (first > pixels - size) first = pixels - size;
        if (first < 0) first = 0;
        const PixelCorrection* own = correction + first;
        const float offset = sensor->offset;
        const float bend1 = sensor->first_bend, bend2 = sensor->second_bend;
        int masked = 0;
        for (int k = 0; k < size; ++k) {
            const float signal = (float)v[first + k] - own[k].dark;
            const float light = signal * (1.0f + signal * (bend1 + signal * bend2));
            const float rounded = light * own[k].scale + offset + 0.5f;
            const int value = rounded > 0.0f ? (int)rounded : 0;
            buffer[k] = value > 65535 ? 65535 : value;
            masked |= own[k].scale == 0.0f;
        }
        if (masked || ramp != 0)
            for (int k = 0; k < size; ++k) buffer[k] = AdjustedPixels::operator[](first + k);
    }

    LUMILINE_FN int operator[](int i) const {
        const unsigned k = (unsigned)(i - first);
        return k < (unsigned)size ? buffer[k] : AdjustedPixels::operator[](i);
    }
};

LUMILINE_FN void fetch(const unsigned short*, int) {}

LUMILINE_FN void fetch(BufferedPixels& v, int pixel) { v.fetch(pixel); }
#endif

// The count as it was read; a masked pixel's says nothing.
LUMILINE_FN int raw_count(const unsigned short* v, int i) { return v[i]; }

LUMILINE_FN int raw_count(const AdjustedPixels& v, int i) { return v.is_masked(i) ? 0 : v.v[i]; }

}  // namespace lumiline::signal
