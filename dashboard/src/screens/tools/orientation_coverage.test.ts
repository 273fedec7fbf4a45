import { describe, expect, test } from "vitest";
import { OrientationCoverage, relative } from "./orientation_coverage";

/** Rotation about an axis (x, y, z) by degrees, by rows. */
function about([x, y, z]: readonly [number, number, number], degrees: number): number[][] {
  const [c, s] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  return [
    [c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s],
    [y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s],
    [z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)],
  ];
}

function coverage(rotations: readonly number[][][]): readonly number[] {
  const seen = new OrientationCoverage();
  for (const one of rotations) seen.take(one);
  return seen.swings() ?? [];
}

describe("OrientationCoverage", () => {
  test("has nothing to say of no orientation", () => {
    expect(new OrientationCoverage().swings()).toBeNull();
  });

  test("is zero of a tool at rest, however it is held", () => {
    const held = about([0.6, 0, 0.8], 77);
    for (const swing of coverage([held, held, held])) expect(swing).toBeCloseTo(0, 5);
  });

  test("leaves the axis of a spin where it is", () => {
    // Two orientations 2 a apart: directions across the axis are a off their mean, all of them.
    const [least, middle, most] = coverage([about([0, 0, 1], 12), about([0, 0, 1], -12)]);
    expect(least).toBeCloseTo(0, 5);
    expect(middle).toBeCloseTo(12, 9);
    expect(most).toBeCloseTo(12, 9);
  });

  test("is that of a quarter turn and more", () => {
    const [, middle, most] = coverage([0, 90, 180, 270].map((angle) => about([0, 1, 0], angle)));
    expect(middle).toBeCloseTo(90, 1);
    expect(most).toBeCloseTo(90, 1);
  });

  test("adds up what two axes do", () => {
    // To and fro about X and Y by 10: X swings in half of them, Y in the other half, Z in all.
    const four = [about([1, 0, 0], 10), about([1, 0, 0], -10), about([0, 1, 0], 10), about([0, 1, 0], -10)];
    const cosine = Math.cos(Math.PI / 18);
    const angle = (mean: number) => (Math.acos(mean) * 180) / Math.PI;
    const [least, middle, most] = coverage(four);
    expect(least).toBeCloseTo(angle((1 + cosine) / 2), 6);
    expect(middle).toBeCloseTo(angle((1 + cosine) / 2), 6);
    expect(most).toBeCloseTo(10, 9);
  });
});

test("a tool that goes with its reference does not turn relative to it", () => {
  const held = about([0, 0.6, 0.8], 30);
  const seen = new OrientationCoverage();
  for (const angle of [0, 20, 50]) {
    const reference = about([1, 0, 0], angle);
    const tool = reference.map((_, i) => [0, 1, 2].map((j) => [0, 1, 2].reduce((sum, k) => sum + (reference[i]?.[k] ?? 0) * (held[k]?.[j] ?? 0), 0)));
    seen.take(relative(reference, tool));
  }
  for (const swing of seen.swings() ?? [90]) expect(swing).toBeCloseTo(0, 5);
});
