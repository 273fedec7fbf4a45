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
    // Weights of the degree + 1 coefficients and their slopes, as of ``compute.mapping.b_spline_basis``.
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
    // Values of all sensors and their slopes by the point: along z, then y, then x.
    auto splines = [&](const Place& place, auto kind, Lanes* value, Lanes (*by)[V]) {
        const int count = decltype(kind)::degree + 1;
        double weight[3][count], slope[3][count];
        for (int axis = 0; axis < 3; ++axis) {
            basis(place.t[axis], kind, weight[axis], slope[axis]);
            const double scale = place.clamped[axis] ? 0.0 : 1.0 / job.pitch[axis];
            for (int i = 0; i < count; ++i) slope[axis][i] *= scale;
        }
        const int ny = cells[1] + count - 1, nz = cells[2] + count - 1;
        const double* corner = job.values
            + (((long long)place.cell[0] * ny + place.cell[1]) * nz + place.cell[2]) * R;
        for (int v = 0; v < V; ++v) {
            Lanes all = Lanes{}, all_x = Lanes{}, all_y = Lanes{}, all_z = Lanes{};
            for (int i = 0; i < count; ++i) {
                Lanes sheet = Lanes{}, sheet_y = Lanes{}, sheet_z = Lanes{};
                for (int j = 0; j < count; ++j) {
                    const double* node = corner + ((long long)i * ny + j) * nz * R;
                    Lanes line = Lanes{}, line_z = Lanes{};
                    for (int k = 0; k < count; ++k) {
                        const Lanes here = lanes(node + k * R, v);
                        line += weight[2][k] * here;
                        line_z += slope[2][k] * here;
                    }
                    sheet += weight[1][j] * line;
                    sheet_y += slope[1][j] * line;
                    sheet_z += weight[1][j] * line_z;
                }
                all += weight[0][i] * sheet;
                all_x += slope[0][i] * sheet;
                all_y += weight[0][i] * sheet_y;
                all_z += weight[0][i] * sheet_z;
            }
            value[v] = all;
            by[0][v] = all_x;
            by[1][v] = all_y;
            by[2][v] = all_z;
        }
    };
    auto correction = [&](const double* x, Lanes* value, Lanes (*by)[V]) {
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
                   + place.cell[2] + k) * R;
            for (int s = 0; s < S; ++s)
                variance[s] += used[s] ? weight * node[s] * slope[s] * slope[s] : 0.0;
        }
    };
    auto vouched = [&](const double* x, const bool* used) -> bool {
        const Place place = locate(x);
        const unsigned char* cell = job.valid
            + (((long long)place.cell[0] * cells[1] + place.cell[1]) * cells[2] + place.cell[2])
                * R;
        bool all = place.inside;
        for (int s = 0; s < S; ++s) all = all && (!used[s] || cell[s]);
        return all;
    };
"""
