import { describe, expect, test } from "vitest";
import { centreOf, cholesky, cornersOf, distanceToSee, dot, rotationOf, sensorPose, type Vector } from "./geometry";

describe("rotationOf", () => {
  test("a quarter turn about z takes x to y", () => {
    const rows = rotationOf([0, 0, Math.PI / 2]);
    const turned = rows.map((row) => dot(row, [1, 0, 0]));
    expect(turned[0]).toBeCloseTo(0);
    expect(turned[1]).toBeCloseTo(1);
    expect(turned[2]).toBeCloseTo(0);
  });

  test("rows of any rotation are orthonormal", () => {
    const rows = rotationOf([0.3, -1.2, 0.7]);
    rows.forEach((a, i) => rows.forEach((b, j) => expect(dot(a, b)).toBeCloseTo(i === j ? 1 : 0)));
  });
});

describe("sensorPose", () => {
  const model = {
    name: "left",
    pixels: 2048,
    principal_distance_px: 3000,
    principal_point_px: 1000,
    rotation_vector_rad: [0.2, -0.4, 0.1] as [number, number, number],
    offset_x_mm: 120,
    offset_z_mm: 800,
    cubic_per_px2: 0,
    distortion: null,
  };

  test("x and z of the sensor's frame vanish at its position", () => {
    const near: Vector = [10, 50, -20];
    const { position, axes } = sensorPose(model, near);
    expect(dot(axes[0], position) + model.offset_x_mm).toBeCloseTo(0);
    expect(dot(axes[2], position) + model.offset_z_mm).toBeCloseTo(0);
    expect(dot(axes[1], position)).toBeCloseTo(dot(axes[1], near));
  });
});

describe("cholesky", () => {
  test("its product is the covariance", () => {
    const covariance = [
      [4, 1, 0.5],
      [1, 3, -0.2],
      [0.5, -0.2, 2],
    ];
    const factor = cholesky(covariance);
    expect(factor).not.toBeNull();
    covariance.forEach((row, i) =>
      row.forEach((value, j) => expect(dot(factor?.[i] ?? [], factor?.[j] ?? [])).toBeCloseTo(value)),
    );
  });

  test("of what is no covariance is null", () => {
    expect(cholesky([[1, 2, 0], [2, 1, 0], [0, 0, 1]])).toBeNull();
    expect(cholesky([[Number.NaN, 0, 0], [0, 1, 0], [0, 0, 1]])).toBeNull();
  });
});

test("centreOf is the centre of the bounding box", () => {
  expect(centreOf([[0, 0, 0], [10, 4, -2], [1, 1, 1]])).toEqual([5, 2, -0.5]);
  expect(centreOf([])).toEqual([0, 0, 0]);
});

describe("distanceToSee", () => {
  const slopes = [0.8, 0.4] as const;
  const points = cornersOf([[-300, -80, -500], [250, 120, 400]]);

  test.each([
    ["from the front", [0, 0, 0]],
    ["from above", [Math.PI / 2, 0, 0]],
    ["from anywhere", [0.4, -0.9, 0.2]],
  ])("shows all points, the outermost at the edge: %s", (_, turn) => {
    const axes = rotationOf(turn as [number, number, number]);
    const far = distanceToSee(points, axes, slopes);
    const outermost = points.map((point) => {
      const depth = far - dot(point, axes[2]);
      expect(depth).toBeGreaterThan(0);
      return Math.max(Math.abs(dot(point, axes[0])) / (slopes[0] * depth), Math.abs(dot(point, axes[1])) / (slopes[1] * depth));
    });
    expect(Math.max(...outermost)).toBeCloseTo(1);
  });

  test("a box has eight corners", () => {
    expect(new Set(points.map(String)).size).toBe(8);
    expect(points).toContainEqual([250, -80, 400]);
  });
});
