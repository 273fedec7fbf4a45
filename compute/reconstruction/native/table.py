"""Native source: a correction table's splines, variances and valid cells at a point."""

from typing import Final

TABLE: Final = """
    struct Place { int cell[3]; double t[3]; bool inside, clamped[3]; };
    struct Linear { enum { degree = 1 }; };
    struct Cubic { enum { degree = 3 }; };
    const int cells[3] = {(int)job.cells_x, (int)job.cells_y, (int)job.cells_z};
    auto locate = [&](const double* x) -> Place {
        Place place;
        place.inside = true;
        for (int axis = 0; axis < 3; ++axis) {
            const double origin = job.origin[axis], pitch = job.pitch[axis];
            double at = (x[axis] - origin) / pitch;
            const double end = cells[axis];
            place.inside = place.inside && at >= 0.0 && at <= end;
            // Beyond the box the correction does not change along the axes that are clamped.
            place.clamped[axis] = x[axis] < origin || x[axis] > origin + pitch * end;
            at = smaller(larger(at, 0.0), end);
            int cell = (int)at;
            cell = cell < cells[axis] ? cell : cells[axis] - 1;
            place.cell[axis] = cell;
            place.t[axis] = at - cell;
        }
        return place;
    };
    // Weights of the degree + 1 coefficients and their slopes, as of ``compute.mapping.basis``.
    auto basis = [](double t, auto kind, double* weight, double* slope) {
        const double s = 1.0 - t;
        if (decltype(kind)::degree == 1) {
            weight[0] = s;
            weight[1] = t;
            slope[0] = -1.0;
            slope[1] = 1.0;
            return;
        }
        const double sixth = 1.0 / 6.0;
        weight[0] = s * s * s * sixth;
        weight[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) * sixth;
        weight[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) * sixth;
        weight[3] = t * t * t * sixth;
        slope[0] = -0.5 * s * s;
        slope[1] = (9.0 * t * t - 12.0 * t) * sixth;
        slope[2] = (12.0 * s - 9.0 * s * s) * sixth;
        slope[3] = 0.5 * t * t;
    };
    // Values of all sensors and their slopes by the point.
    auto splines = [&](const Place& place, auto kind, double* value, double (*by)[S]) {
        const int count = decltype(kind)::degree + 1;
        double weight[3][count], slope[3][count];
        for (int axis = 0; axis < 3; ++axis) {
            basis(place.t[axis], kind, weight[axis], slope[axis]);
            const double scale = place.clamped[axis] ? 0.0 : 1.0 / job.pitch[axis];
            for (int i = 0; i < count; ++i) slope[axis][i] *= scale;
        }
        const int ny = cells[1] + count - 1, nz = cells[2] + count - 1;
        for (int s = 0; s < S; ++s) value[s] = by[0][s] = by[1][s] = by[2][s] = 0.0;
        for (int i = 0; i < count; ++i) {
            double sheet[S], sheet_y[S], sheet_z[S];
            for (int s = 0; s < S; ++s) sheet[s] = sheet_y[s] = sheet_z[s] = 0.0;
            for (int j = 0; j < count; ++j) {
                const double* node = job.values
                    + (((long long)(place.cell[0] + i) * ny + place.cell[1] + j) * nz
                       + place.cell[2]) * S;
                double line[S], line_z[S];
                for (int s = 0; s < S; ++s) line[s] = line_z[s] = 0.0;
                for (int k = 0; k < count; ++k)
                    for (int s = 0; s < S; ++s) {
                        line[s] += weight[2][k] * node[k * S + s];
                        line_z[s] += slope[2][k] * node[k * S + s];
                    }
                for (int s = 0; s < S; ++s) {
                    sheet[s] += weight[1][j] * line[s];
                    sheet_y[s] += slope[1][j] * line[s];
                    sheet_z[s] += weight[1][j] * line_z[s];
                }
            }
            for (int s = 0; s < S; ++s) {
                value[s] += weight[0][i] * sheet[s];
                by[0][s] += slope[0][i] * sheet[s];
                by[1][s] += weight[0][i] * sheet_y[s];
                by[2][s] += weight[0][i] * sheet_z[s];
            }
        }
    };
    auto correction = [&](const double* x, double* value, double (*by)[S]) {
        const Place place = locate(x);
        if (job.degree == 3) splines(place, Cubic(), value, by);
        else splines(place, Linear(), value, by);
    };
    auto add_table = [&](const double* x, const bool* used, const double* slope, double* variance) {
        const Place place = locate(x);
        const int ny = cells[1] + 1, nz = cells[2] + 1;
        for (int corner = 0; corner < 8; ++corner) {
            const int i = corner >> 2, j = corner >> 1 & 1, k = corner & 1;
            const double weight = (i ? place.t[0] : 1.0 - place.t[0])
                * (j ? place.t[1] : 1.0 - place.t[1]) * (k ? place.t[2] : 1.0 - place.t[2]);
            const double* node = job.variance
                + (((long long)(place.cell[0] + i) * ny + place.cell[1] + j) * nz
                   + place.cell[2] + k) * S;
            for (int s = 0; s < S; ++s)
                variance[s] += used[s] ? weight * node[s] * slope[s] * slope[s] : 0.0;
        }
    };
    auto vouched = [&](const double* x, const bool* used) -> bool {
        const Place place = locate(x);
        const unsigned char* cell = job.valid
            + (((long long)place.cell[0] * cells[1] + place.cell[1]) * cells[2] + place.cell[2])
                * S;
        bool all = place.inside;
        for (int s = 0; s < S; ++s) all = all && (!used[s] || cell[s]);
        return all;
    };
"""
