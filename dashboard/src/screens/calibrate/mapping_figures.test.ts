import { describe, expect, test } from "vitest";
import { mappedSensors, mappingVerdict, sharesPoints } from "./mapping_figures";

function table(validation: Record<string, unknown>, settings: Record<string, unknown> = {}) {
  return { sensors: ["left", "right"], valid_share: [0.9, 0.5], max_correction_px: [1, 2], validation, settings };
}

function figures(sensor: string, without: number, leftOut: number | null) {
  return { sensor, points: 60, before_rms_px: without, left_out_rms_px: leftOut, after_rms_px: 0.01, sigma_px: 0.2, coverage: "all of it", suspects: [{ point: 4 }] };
}

test("figures are found by the sensor's name, in the table's order", () => {
  const [left, right] = mappedSensors(table({ sensors: [figures("right", 2, 1), figures("left", 0.5, 0.2)] }));
  expect(left).toMatchObject({ sensor: "left", leftOut_px: 0.2, without_px: 0.5, supported: 0.9, correction_px: 1, suspects: [4] });
  expect(right).toMatchObject({ sensor: "right", leftOut_px: 1, without_px: 2, supported: 0.5 });
});

test.each([[{}], [{ sensors: "many" }], [{ sensors: [null, 3, { sensor: "left", points: "<b>", suspects: [{}], coverage: 5 }] }]])(
  "an uploaded table may say %j",
  (validation) => {
    expect(mappedSensors(table(validation))[0]).toMatchObject({ points: null, leftOut_px: null, coverage: "", suspects: [] });
  },
);

describe("verdict", () => {
  test.each([
    ["better", 0.2, 0.3],
    ["mixed", 0.2, 0.7],
    ["worse", 0.6, 0.7],
    ["better", 0.2, 0.6],
    ["worse", 0.55, 0.6],
    ["better", 0.2, null],
    ["unknown", null, null],
  ])("is %s", (verdict, left, right) => {
    expect(mappingVerdict(mappedSensors(table({ sensors: [figures("left", 0.5, left), figures("right", 0.5, right)] })))).toBe(verdict);
  });
});

test("points that made the calibration are said", () => {
  expect(sharesPoints(table({}, { points_made_the_calibration: true }))).toBe(true);
  expect(sharesPoints(table({}))).toBe(false);
});
