import { describe, expect, test } from "vitest";
import { proposedTarget, volumeCoverage } from "./volume_coverage";

type Place = [number, number, number];

function session(places: Place[], ...captured: number[]) {
  return {
    targets: places.map((position_mm, index) => ({ name: `${index}`, position_mm })),
    captured: captured.map((index) => ({ target: `${index}` })),
  };
}

const CORNERS: Place[] = [0, 1, 2, 3, 4, 5, 6, 7].map((index) => [100 * (index % 2), 100 * ((index >> 1) % 2), 100 * (index >> 2)]);

describe("coverage of the volume", () => {
  test("counts the targets of each eighth, and those that are captured", () => {
    const found = volumeCoverage(session([...CORNERS, [10, 10, 10], [50, 50, 50]], 0, 8, 9));
    expect(found).toHaveLength(8);
    expect(found[0]).toEqual({ low: [0, 0, 0], high: [50, 50, 50], targets: 2, captured: 2 });
    expect(found[1]).toEqual({ low: [50, 0, 0], high: [100, 50, 50], targets: 1, captured: 0 });
    // What is on the border belongs to the upper half.
    expect(found[7]).toEqual({ low: [50, 50, 50], high: [100, 100, 100], targets: 2, captured: 1 });
  });

  test("a plane is halved along two axes, a single place along none", () => {
    expect(volumeCoverage(session(CORNERS.slice(0, 4), 3)).map(({ captured }) => captured)).toEqual([0, 0, 0, 1]);
    expect(volumeCoverage(session([[1, 2, 3]]))).toEqual([{ low: [1, 2, 3], high: [1, 2, 3], targets: 1, captured: 0 }]);
  });

  test("parts without a target are there, too", () => {
    const found = volumeCoverage(session([CORNERS[0] as Place, CORNERS[7] as Place]));
    expect(found.map(({ targets }) => targets)).toEqual([1, 0, 0, 0, 0, 0, 0, 1]);
  });
});

describe("next target", () => {
  test("is the first where none is captured", () => {
    expect(proposedTarget(session(CORNERS), "farthest")?.name).toBe("0");
  });

  test("is the farthest from the nearest captured one", () => {
    expect(proposedTarget(session(CORNERS, 0), "farthest")?.name).toBe("7");
    const line: Place[] = [0, 10, 40, 65, 100].map((x) => [x, 0, 0]);
    expect(proposedTarget(session(line, 0, 4), "farthest")?.name).toBe("2");
  });

  test("of equal ones is the first, also where they differ by rounding", () => {
    expect(proposedTarget(session(CORNERS, 0, 7), "farthest")?.name).toBe("1");
    expect(proposedTarget(session([[0, 0, 0], [0.3, 0, 0], [0, 0.1 + 0.2, 0]], 0), "farthest")?.name).toBe("1");
  });

  test("is that of the table for a machine", () => {
    expect(proposedTarget(session(CORNERS, 0, 2), "table")?.name).toBe("1");
  });

  test("is none where all are captured", () => {
    expect(proposedTarget(session(CORNERS.slice(0, 2), 0, 1), "farthest")).toBeNull();
    expect(proposedTarget(session(CORNERS.slice(0, 2), 0, 1), "table")).toBeNull();
  });
});
