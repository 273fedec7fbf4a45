import { expect, test } from "vitest";
import { comparedRows, untouchedErrors } from "./former_result";

type Compared = Parameters<typeof comparedRows>[0];

function result(leftOut: ([number, number, number] | null)[], rms: number): Compared {
  const statistics = { points: 1, mean_absolute_mm: [rms, 0, 0], max_absolute_mm: [2 * rms, 0, 0] };
  const errors = { statistics, differences_mm: leftOut, readings: 57 };
  const sensors = [{ model: { name: "left" }, rms_px: rms }];
  return { errors: { fitted: errors, leave_one_out: errors, blocks_left_out: null }, result: { sensors, labels: [] } } as unknown as Compared;
}

const FORMER = result([[9, 9, 9], [-1, 2, 0], [3, 0, 0], null], 3);
const NOW = result([[0, 0, 0], [-0.5, 1, 0], [0.5, 0, 0], [8, 8, 8]], 1);

test("the fair comparison has the points that are in both and were not changed", () => {
  const [before, after] = untouchedErrors(FORMER, NOW, new Set([0]));
  expect(before).toEqual({ points: 2, mean_mm: [2, 1, 0] });
  expect(after).toEqual({ points: 2, mean_mm: [0.5, 0.5, 0] });
});

test("without such points there is none", () => {
  expect(untouchedErrors(FORMER, NOW, new Set([0, 1, 2]))).toEqual([null, null]);
});

test("errors of left-out points come first, and what neither has is no row", () => {
  const rows = comparedRows(FORMER, NOW, new Set([0]));
  expect(rows[0]).toEqual({ figure: "Left out one by one: mean error X, Y, Z [mm]", former: "3.0, 0, 0", now: "1.0, 0, 0" });
  expect(rows[2]?.figure).toContain("the 2 points not touched");
  expect(rows.map(({ figure }) => figure).join()).not.toContain("regions");
  expect(rows.find(({ figure }) => figure.startsWith("left: RMS"))).toMatchObject({ former: "3.00", now: "1.00" });
});
