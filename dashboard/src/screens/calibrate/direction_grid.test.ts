import { expect, test } from "vitest";
import { sectors } from "./direction_grid";

test("each bin has its own sector, in order, with its count", () => {
  const found = sectors([1, 4, 8], [7, 1, 2, 3, 4, 0, 0, 0, 0, 0, 0, 0, 9]);
  expect(found.map(({ count }) => count)).toEqual([7, 1, 2, 3, 4, 0, 0, 0, 0, 0, 0, 0, 9]);
  expect(new Set(found.map(({ path }) => path)).size).toBe(13);
});

test("sectors begin at x, go towards y, and reach the edge of the disc", () => {
  const [, first, second] = sectors([1, 4, 8], []);
  const radius = Math.sqrt(5 / 13).toFixed(4);
  expect(first?.path.startsWith(`M ${radius} 0.0000 A `)).toBe(true);
  // A quarter turn further it begins at the top, where y of SVG is negative.
  expect(second?.path).toContain(`M 0.0000 -${radius} A `);
  expect(sectors([1, 4, 8], []).at(-1)?.path).toContain("A 1 1 0 0 0 1.0000");
});
