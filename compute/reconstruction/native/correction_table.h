// A correction table's splines, variances and valid cells at a point.
#pragma once

#include "compute/native/platform.h"
#include "compute/reconstruction/native/definitions.gen.h"
#include "compute/reconstruction/native/lanes.h"

namespace lumiline {

// Weights of the degree + 1 coefficients and their derivatives: compute.mapping.b_splines.
template <int degree>
LUMILINE_FN void spline_basis(double t, double* weight, double* derivative) {
    const double s = 1.0 - t;
    if constexpr (degree == 1) {
        weight[0] = s;
        weight[1] = t;
        derivative[0] = -1.0;
        derivative[1] = 1.0;
    } else {
        const double sixth = 1.0 / 6.0;
        weight[0] = s * s * s * sixth;
        weight[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) * sixth;
        weight[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) * sixth;
        weight[3] = t * t * t * sixth;
        derivative[0] = -0.5 * s * s;
        derivative[1] = (9.0 * t * t - 12.0 * t) * sixth;
        derivative[2] = (12.0 * s - 9.0 * s * s) * sixth;
        derivative[3] = 0.5 * t * t;
    }
}

// A point's cell, its coordinates there from 0 to 1, and how far it lies beyond the box, in cells.
struct GridCell {
    int cell[3];
    double t[3], beyond[3];
    bool inside;
};

// The table of S sensors; a degree of 0: there is none.
template <int S>
struct CorrectionTable {
    static constexpr int V = vector_count<S>, R = row_length<S>;

    const CameraRecord& record;
    const int cells[3];

    LUMILINE_FN explicit CorrectionTable(const CameraRecord& from)
        : record(from), cells{(int)from.cells[0], (int)from.cells[1], (int)from.cells[2]} {}

    LUMILINE_FN bool exists() const { return record.degree != 0; }

    LUMILINE_FN GridCell locate(const double* x) const {
        GridCell grid_cell;
        grid_cell.inside = true;
        for (int axis = 0; axis < 3; ++axis) {
            const double origin = record.origin_mm[axis], pitch = record.pitch_mm[axis];
            double at = (x[axis] - origin) / pitch;
            const double end = cells[axis];
            grid_cell.inside = grid_cell.inside && at >= 0.0 && at <= end;
            const double nearest = smaller(larger(at, 0.0), end);
            grid_cell.beyond[axis] = at - nearest;
            at = nearest;
            int cell = (int)at;
            cell = cell < cells[axis] ? cell : cells[axis] - 1;
            grid_cell.cell[axis] = cell;
            grid_cell.t[axis] = at - cell;
        }
        return grid_cell;
    }

    // Values of all sensors and their derivatives by the point: along z, then y, then x. Beyond the
    // box the splines go on as straight lines.
    template <int degree>
    LUMILINE_FN void splines(const GridCell& grid_cell, Lanes* value, Lanes (*by)[V]) const {
        const int count = degree + 1;
        double weight[3][count], derivative[3][count];
        for (int axis = 0; axis < 3; ++axis) {
            spline_basis<degree>(grid_cell.t[axis], weight[axis], derivative[axis]);
            for (int i = 0; i < count; ++i) {
                weight[axis][i] += derivative[axis][i] * grid_cell.beyond[axis];
                derivative[axis][i] *= 1.0 / record.pitch_mm[axis];
            }
        }
        const int ny = cells[1] + count - 1, nz = cells[2] + count - 1;
        const double* corner =
            record.table_values
            + (((long long)grid_cell.cell[0] * ny + grid_cell.cell[1]) * nz + grid_cell.cell[2])
                  * R;
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
                        line_z += derivative[2][k] * here;
                    }
                    sheet += weight[1][j] * line;
                    sheet_y += derivative[1][j] * line;
                    sheet_z += weight[1][j] * line_z;
                }
                all += weight[0][i] * sheet;
                all_x += derivative[0][i] * sheet;
                all_y += weight[0][i] * sheet_y;
                all_z += weight[0][i] * sheet_z;
            }
            value[v] = all;
            by[0][v] = all_x;
            by[1][v] = all_y;
            by[2][v] = all_z;
        }
    }

    LUMILINE_FN void correction(const double* x, Lanes* value, Lanes (*by)[V]) const {
        const GridCell grid_cell = locate(x);
        if (record.degree == 3)
            splines<3>(grid_cell, value, by);
        else
            splines<1>(grid_cell, value, by);
    }

    LUMILINE_FN void add_variance(const double* x, const bool* used, const double* derivative,
                                  double* variance) const {
        const GridCell grid_cell = locate(x);
        const int ny = cells[1] + 1, nz = cells[2] + 1;
        // compute.mapping.table.variance_growth; 1 within the box.
        double distance2 = 0.0;
        for (int axis = 0; axis < 3; ++axis)
            distance2 += grid_cell.beyond[axis] * grid_cell.beyond[axis];
        double growth = 1.0 + 0.5 * smaller(distance2, max_growth_cells * max_growth_cells);
        growth *= growth;
        growth *= growth;
        for (int corner = 0; corner < 8; ++corner) {
            const int i = corner >> 2, j = corner >> 1 & 1, k = corner & 1;
            const double weight = growth * (i ? grid_cell.t[0] : 1.0 - grid_cell.t[0])
                                  * (j ? grid_cell.t[1] : 1.0 - grid_cell.t[1])
                                  * (k ? grid_cell.t[2] : 1.0 - grid_cell.t[2]);
            const double* node =
                record.table_variance
                + (((long long)(grid_cell.cell[0] + i) * ny + grid_cell.cell[1] + j) * nz
                   + grid_cell.cell[2] + k)
                      * R;
            for (int s = 0; s < S; ++s)
                variance[s] += used[s] ? weight * node[s] * derivative[s] * derivative[s] : 0.0;
        }
    }

    // Whether the table says how certain the readings of a point are.
    LUMILINE_FN bool in_box(const double* x) const { return locate(x).inside; }

    LUMILINE_FN bool is_valid(const double* x, const bool* used) const {
        const GridCell grid_cell = locate(x);
        const unsigned char* cell =
            record.table_valid
            + (((long long)grid_cell.cell[0] * cells[1] + grid_cell.cell[1]) * cells[2]
               + grid_cell.cell[2])
                  * R;
        bool all = grid_cell.inside;
        for (int s = 0; s < S; ++s) all = all && (!used[s] || cell[s]);
        return all;
    }
};

}  // namespace lumiline
