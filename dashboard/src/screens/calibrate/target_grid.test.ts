import { describe, expect, test } from "vitest";
import { parseTargets, targetsTable } from "../../ui/targets";
import { gridTargets } from "./target_grid";

const GRID = { origin: "-200, -100, 1300", steps: "200, 100, 150", counts: "3, 3, 2" };

function places(entered: Partial<typeof GRID>) {
  return gridTargets({ ...GRID, ...entered }).map(({ position_mm }) => position_mm);
}

describe("grid of targets", () => {
  test("has every place once", () => {
    const found = places({});
    expect(found).toHaveLength(18);
    expect(new Set(found.map(String)).size).toBe(18);
    for (const axis of [0, 1, 2]) {
      const values = new Set(found.map((place) => place[axis]));
      expect([...values].sort((a, b) => (a ?? 0) - (b ?? 0))).toEqual([[-200, 0, 200], [-100, 0, 100], [1300, 1450]][axis]);
    }
  });

  test("is a serpentine: each move is one step along one axis, mostly the shortest", () => {
    const found = places({});
    const moves = found.slice(1).map((place, index) => place.map((value, axis) => Math.abs(value - (found[index]?.[axis] ?? 0))));
    expect(moves.every((move) => move.filter((size) => size > 0).length === 1)).toBe(true);
    const along = (axis: number) => moves.filter((move) => (move[axis] ?? 0) > 0).map((move) => move[axis]);
    expect(along(1)).toEqual(Array.from({ length: 12 }, () => 100));
    expect(along(2)).toEqual([150, 150, 150]);
    expect(along(0)).toEqual([200, 200]);
  });

  test("begins at its origin, in steps of either sign", () => {
    expect(places({ origin: "0; 0; 0", steps: "-0.1 0 0", counts: "4 1 1" })).toEqual([
      [0, 0, 0],
      [-0.1, 0, 0],
      [-0.2, 0, 0],
      [-0.3, 0, 0],
    ]);
  });

  test("is read back from the table that it fills", () => {
    const targets = gridTargets(GRID);
    expect(parseTargets(targetsTable(targets))).toEqual(targets);
  });

  test.each([
    [{ origin: "1, 2" }, "First target X, Y, Z [mm]: three numbers"],
    [{ steps: "1, two, 3" }, '"two" is no number'],
    [{ counts: "3, 2.5, 1" }, "2.5 targets"],
    [{ counts: "3, 0, 1" }, "0 targets"],
    [{ steps: "100, 0, 100" }, "step"],
    [{ counts: "20, 20, 20" }, "8000 targets"],
  ])("%j is refused with %j", (entered, words) => {
    expect(() => places(entered)).toThrow(words);
  });
});
