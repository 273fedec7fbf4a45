import { describe, expect, test } from "vitest";
import { differenceRows, differences, samplePages } from "./differences";

type Frame = Parameters<typeof differences>[0][number];

function frame(number: number, marker: number | null, ...positions: ([number, number, number] | null)[]): Frame {
  return { number, marker, points: positions.map((position_mm) => ({ marker, position_mm })) };
}

describe("points that belong together", () => {
  test("a strobed frame's are one marker's, however far apart", () => {
    expect(differences([frame(3, 7, [0, 0, 0])], [frame(3, 7, [100, 2, -3])])).toEqual([[100, 2, -3]]);
  });
  test("of markers lit together the nearest are, in whatever order", () => {
    const first = [frame(0, null, [0, 0, 0], [50, 0, 0])];
    expect(differences(first, [frame(0, null, [51, 0, 0], [0, 2, 0])])).toEqual([
      [0, 2, 0],
      [1, 0, 0],
    ]);
  });
  test("a point that only one calibration has belongs to none", () => {
    expect(differences([frame(0, null, [0, 0, 0], [50, 0, 0])], [frame(0, null, [49, 0, 0])])).toEqual([[-1, 0, 0]]);
  });
  test.each([
    ["another frame", [frame(1, 0, [1, 0, 0])]],
    ["no position", [frame(0, 0, null)]],
    ["no number", [frame(0, 0, [Number.NaN, 0, 0])]],
  ])("%s is none", (_, second) => expect(differences([frame(0, 0, [0, 0, 0])], second)).toEqual([]));
});

describe("differences", () => {
  const found = Array.from({ length: 101 }, (_, index) => [-index, 2, 0] as const);
  const [x, y, z, distance] = differenceRows(found);
  test("of an axis have the median's sign, and sizes", () =>
    expect(x).toEqual({ axis: "X", median_mm: -50, p95_mm: 95, largest_mm: 100 }));
  test("that are all the same are that", () => expect(y).toEqual({ axis: "Y", median_mm: 2, p95_mm: 2, largest_mm: 2 }));
  test("of nothing are zero", () => expect(z).toMatchObject({ median_mm: 0, largest_mm: 0 }));
  test("in space are distances", () => expect(distance?.largest_mm).toBeCloseTo(Math.hypot(100, 2)));
  test("without points are none", () => expect(differenceRows([])).toEqual([]));
});

describe("pages of a recording", () => {
  test("of a short one are all of it", () => expect(samplePages(100, 10, 32)).toEqual([0, 32, 64, 96]));
  test("of a long one reach from its begin to its end", () => {
    const pages = samplePages(10_000, 5, 32);
    expect(pages).toHaveLength(5);
    expect(pages[0]).toBe(0);
    expect(pages.at(-1)).toBe(10_000 - 32);
  });
  test("of none are none", () => expect(samplePages(0, 5, 32)).toEqual([]));
});
