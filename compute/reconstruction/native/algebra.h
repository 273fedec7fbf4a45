// Systems of three equations, and singular values of three by three.
#pragma once

#include "compute/native/platform.h"

namespace lumiline {

// Symmetric 3 x 3 matrices are xx, xy, yy, xz, yz, zz: the lower triangle by rows.
// L D L' of a symmetric matrix: returns the determinant, or nan where it is not positive definite.
LUMILINE_FN double factor_ldl(const double* a, double* l, double* d) {
    d[0] = a[0];
    l[0] = a[1] / d[0];
    l[1] = a[3] / d[0];
    d[1] = a[2] - l[0] * a[1];
    const double yz = a[4] - l[1] * a[1];
    l[2] = yz / d[1];
    d[2] = a[5] - l[1] * a[3] - l[2] * yz;
    return d[0] > 0.0 && d[1] > 0.0 && d[2] > 0.0 ? d[0] * d[1] * d[2] : not_a_number();
}

LUMILINE_FN void solve_ldl(const double* l, const double* d, const double* b, double* x) {
    const double y1 = b[1] - l[0] * b[0];
    const double y2 = b[2] - l[1] * b[0] - l[2] * y1;
    x[2] = y2 / d[2];
    x[1] = y1 / d[1] - l[2] * x[2];
    x[0] = b[0] / d[0] - l[0] * x[1] - l[1] * x[2];
}

// The least over the largest singular value, by one-sided Jacobi rotations of the columns
// (J. Demmel, K. Veselic, 10.1137/0613074): the small ones to their last digits.
LUMILINE_FN double singular_ratio(double (&a)[3][3]) {
    double squares[3];
    for (int sweep = 0; sweep < 12; ++sweep) {
        double largest_rotation = 0.0;
        for (int pair = 0; pair < 3; ++pair) {
            const int i = pair == 2 ? 1 : 0, j = pair == 0 ? 1 : 2;
            double ii = 0.0, jj = 0.0, ij = 0.0;
            for (int r = 0; r < 3; ++r) {
                ii += a[r][i] * a[r][i];
                jj += a[r][j] * a[r][j];
                ij += a[r][i] * a[r][j];
            }
            if (ij == 0.0) continue;
            const double zeta = (jj - ii) / (2.0 * ij);
            const double t =
                (zeta < 0.0 ? -1.0 : 1.0) / ((zeta < 0.0 ? -zeta : zeta) + sqrt(1.0 + zeta * zeta));
            const double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
            largest_rotation = larger(largest_rotation, ij * ij / (ii * jj));
            for (int r = 0; r < 3; ++r) {
                const double x = a[r][i], y = a[r][j];
                a[r][i] = c * x - s * y;
                a[r][j] = s * x + c * y;
            }
        }
        if (!(largest_rotation > 1e-30)) break;
    }
    for (int i = 0; i < 3; ++i)
        squares[i] = a[0][i] * a[0][i] + a[1][i] * a[1][i] + a[2][i] * a[2][i];
    const double low = smaller(squares[0], smaller(squares[1], squares[2]));
    const double high = larger(squares[0], larger(squares[1], squares[2]));
    return high > 0.0 ? sqrt(low / high) : 0.0;
}

}  // namespace lumiline
