/** Geometry of what is drawn: sensors from their models, ellipsoids from covariances. */

import type { Schemas } from "../../api/client";

export type SensorModel = Schemas["SensorModel"];
export type Vector = readonly [number, number, number];
/** Rows of a 3x3 matrix. */
export type Matrix = readonly [Vector, Vector, Vector];

/** Return the rotation matrix of a rotation vector [rad], by Rodrigues' formula. */
export function rotationOf(vector: readonly number[]): Matrix {
  const [x = 0, y = 0, z = 0] = vector;
  const angle = Math.hypot(x, y, z);
  if (angle === 0) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const [a, b, c] = [x / angle, y / angle, z / angle];
  const cos = Math.cos(angle);
  const sin = Math.sin(angle);
  const rest = 1 - cos;
  return [
    [cos + a * a * rest, a * b * rest - c * sin, a * c * rest + b * sin],
    [b * a * rest + c * sin, cos + b * b * rest, b * c * rest - a * sin],
    [c * a * rest - b * sin, c * b * rest + a * sin, cos + c * c * rest],
  ];
}

export interface SensorPose {
  /** World coordinates [mm] of the lens; along the slit, the place nearest to `near`. */
  readonly position: Vector;
  /** The sensor's x (along the pixels), y (along the slit) and z (to the scene) in the world. */
  readonly axes: Matrix;
}

/** Return where a sensor is.
 *
 * Its model leaves the place along the slit open (but with distortion): x = r1.X + offset_x and
 * z = r3.X + offset_z vanish on a line, on which the point nearest to `near` [mm] is taken.
 */
export function sensorPose(model: SensorModel, near: Vector): SensorPose {
  const axes = rotationOf(model.rotation_vector_rad);
  const [r1, r2, r3] = axes;
  const along = dot(r2, near);
  const position = [0, 1, 2].map(
    (k) => -model.offset_x_mm * at(r1, k) - model.offset_z_mm * at(r3, k) + along * at(r2, k),
  ) as unknown as Vector;
  return { position, axes };
}

/** Return the lower triangular L with L L^T = covariance, or null where it is not positive. */
export function cholesky(covariance: readonly (readonly number[])[]): Matrix | null {
  const c = (i: number, j: number) => covariance[i]?.[j] ?? Number.NaN;
  const a = Math.sqrt(c(0, 0));
  const b = c(1, 0) / a;
  const d = Math.sqrt(c(1, 1) - b * b);
  const e = c(2, 0) / a;
  const f = (c(2, 1) - e * b) / d;
  const g = Math.sqrt(c(2, 2) - e * e - f * f);
  const found: Matrix = [[a, 0, 0], [b, d, 0], [e, f, g]];
  return found.every((row) => row.every(Number.isFinite)) && a > 0 && d > 0 && g > 0 ? found : null;
}

/** Return the centre of points [mm]; the origin where there are none. */
export function centreOf(points: readonly Vector[]): Vector {
  if (!points.length) return [0, 0, 0];
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (const point of points)
    for (let axis = 0; axis < 3; axis++) {
      low[axis] = Math.min(at(low, axis), at(point, axis));
      high[axis] = Math.max(at(high, axis), at(point, axis));
    }
  return [0, 1, 2].map((axis) => (at(low, axis) + at(high, axis)) / 2) as unknown as Vector;
}

/** Return the corners of a box with these corners opposite each other [mm]. */
export function cornersOf([low, high]: readonly [Vector, Vector]): Vector[] {
  return [0, 1, 2, 3, 4, 5, 6, 7].map((corner) => [0, 1, 2].map((axis) => at(corner & (1 << axis) ? high : low, axis)) as unknown as Vector);
}

/** Return from how far a camera that looks at the origin has all points [mm] in its picture.
 *
 * `axes`: the camera's right, its up, and the direction from the origin to it; `slopes`: tangents
 * of half the angles that the picture spans across and up.
 */
export function distanceToSee(points: readonly Vector[], axes: Matrix, slopes: readonly [number, number]): number {
  const [right, up, back] = axes;
  return Math.max(
    0,
    ...points.map((point) => dot(point, back) + Math.max(Math.abs(dot(point, right)) / slopes[0], Math.abs(dot(point, up)) / slopes[1])),
  );
}

export function dot(a: readonly number[], b: readonly number[]): number {
  return at(a, 0) * at(b, 0) + at(a, 1) * at(b, 1) + at(a, 2) * at(b, 2);
}

function at(values: readonly number[], index: number): number {
  return values[index] ?? Number.NaN;
}
