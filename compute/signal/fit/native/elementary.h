// The logarithm and the exponential, with the same bits on all devices: a library's differ in the
// last digit.
#pragma once

#include "compute/native/platform.h"

namespace lumiline::signal {

LUMILINE_FN double log_of(double value) {
    union {
        double value;
        unsigned long long bits;
    } word = {value};

    int power = (int)(word.bits >> 52) - 1023;
    word.bits = (word.bits & 0x000fffffffffffffull) | 0x3ff0000000000000ull;
    double m = word.value;
    if (m > 1.4142135623730951) {
        m *= 0.5;
        power += 1;
    }
    const double s = (m - 1.0) / (m + 1.0), s2 = s * s;
    double sum = 1.0 / 19.0;
    for (int k = 17; k > 0; k -= 2) sum = sum * s2 + 1.0 / k;
    return 2.0 * s * sum + power * 0.6931471805599453;
}

// Of a small number: to 1e-16 within 0.3; more by squaring.
LUMILINE_FN double exp_of(double value) {
    int halvings = 0;
    while (value > 0.3 || value < -0.3) {
        value *= 0.5;
        ++halvings;
    }
    double sum = 1.0;
    for (int k = 12; k > 0; --k) sum = 1.0 + sum * value / k;
    for (; halvings > 0; --halvings) sum *= sum;
    return sum;
}

}  // namespace lumiline::signal
