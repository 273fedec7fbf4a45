// The reported pose: PoseState.reported_pose of compute.pose.filtering.pose_filter.
#pragma once

#include "compute/native/platform.h"
#include "compute/pose/filtering/native/definitions.gen.h"
#include "compute/pose/filtering/native/pose_algebra.h"

namespace lumiline::pose {

LUMILINE_FN void pose_outputs(const StepRecord& step, const double* pose, double* to) {
    const double *r = pose, *covariance = pose + pose_size;
    double origin[3], tip[3];
    for (int i = 0; i < 3; ++i) {
        const double *centroid = step.centroid, *tool_tip = step.tip;
        origin[i] =
            r[3 * i] * centroid[0] + r[3 * i + 1] * centroid[1] + r[3 * i + 2] * centroid[2];
        tip[i] = r[3 * i] * tool_tip[0] + r[3 * i + 1] * tool_tip[1] + r[3 * i + 2] * tool_tip[2];
    }
    // Covariance of (rotation, translation) at an arm from the centroid, from row `first` on.
    auto at = [&](const double* a, double sign, int first, double* into) {
        const double x = sign * a[0], y = sign * a[1], z = sign * a[2];
        const double swept[3][3] = {{0.0, -z, y}, {z, 0.0, -x}, {-y, x, 0.0}};
        double half[6][6];
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) {
                half[i][j] = covariance[12 * i + j];
                for (int k = 0; i > 2 && k < 3; ++k)
                    half[i][j] += swept[i - 3][k] * covariance[12 * k + j];
            }
        for (int i = first; i < 6; ++i)
            for (int j = first; j < 6; ++j) {
                double sum = half[i][j];
                for (int k = 0; j > 2 && k < 3; ++k) sum += half[i][k] * swept[j - 3][k];
                into[(i - first) * (6 - first) + j - first] = sum;
            }
    };
    copy(9, r, to);
    copy(3, pose + 15, to + 9);
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        to[12 + i] = pose[9 + i] - origin[i];
        to[51 + i] = pose[9 + i] + tip[i];
        to[63 + i] = pose[12 + i] - (pose[15 + j] * origin[k] - pose[15 + k] * origin[j]);
    }
    at(origin, 1.0, 0, to + 15);
    at(tip, -1.0, 3, to + 54);
    to[66] = to[54] + to[58] + to[62];
    const double *c = covariance, radius = step.radius_mm;
    to[67] = radius * radius * (c[0] + c[13] + c[26]) + (c[39] + c[52] + c[65]);
}

}  // namespace lumiline::pose
