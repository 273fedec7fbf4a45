// The cubic distortion of thesis [5.12], inverted. As invert_cubic of
// compute.measurement.measurement_model.
#pragma once

#include "compute/native/platform.h"

namespace lumiline {

// Steps after which the last digit stays: the distortion may reach 0.3 of a reading's distance from
// p0 where it is negative (it folds at 1/3), and that distance itself where it is positive.
constexpr int cubic_iterations = 8;

// The raw reading q of `q + D (q - p0)^3 = projected`, by Newton's method, and dq / d projected;
// nan beyond the fold of a negative D.
LUMILINE_FN double invert_cubic(double projected, double principal_point, double cubic,
                                double& derivative) {
    const double offset = projected - principal_point;
    double reading = -6.75 * cubic * offset * offset > 1.0 ? not_a_number() : projected;
    for (int iteration = 0; iteration < cubic_iterations; ++iteration) {
        const double apart = reading - principal_point, bend = cubic * apart * apart;
        reading -= (reading + bend * apart - projected) / (1.0 + 3.0 * bend);
    }
    const double apart = reading - principal_point;
    derivative = 1.0 / (1.0 + 3.0 * cubic * apart * apart);
    return reading;
}

}  // namespace lumiline
