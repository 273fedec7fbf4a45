import { expect, test } from "vitest";
import type { Device } from "../../devices";
import type { MeasuredPoint } from "./digitise";
import { measuredFor, remeasured, type Row, TRACKER } from "./registration_points";

const device = { id: "sim", active_calibration_id: "c-1", active_table_id: null } as Device;
const row: Row = { name: "nose", position_mm: [1, 2, 3] };
const point = { device_id: "sim", calibration_id: "c-1", table_id: null, frame_id: TRACKER, position_mm: [9, 8, 7] } as MeasuredPoint;

test("a point counts for the row, device, calibration and reference it was measured for, and for no others", () => {
  const measured = remeasured([], row, point);
  expect(measuredFor(measured, { ...row }, device, TRACKER)).toBe(point);
  expect(measuredFor(measured, { ...row, position_mm: [1, 2, 4] }, device, TRACKER)).toBeUndefined();
  expect(measuredFor(measured, { ...row, name: "ear" }, device, TRACKER)).toBeUndefined();
  expect(measuredFor(measured, row, device, "head")).toBeUndefined();
  expect(measuredFor(measured, row, { ...device, id: "bar" }, TRACKER)).toBeUndefined();
  expect(measuredFor(measured, row, { ...device, active_calibration_id: "c-2" }, TRACKER)).toBeUndefined();
  expect(measuredFor(measured, row, { ...device, active_table_id: "t-1" }, TRACKER)).toBeUndefined();
});

test("a row that is measured again has its newest point alone; others keep theirs", () => {
  const ear: Row = { name: "ear", position_mm: [0, 0, 0] };
  const newest = { ...point, position_mm: [9, 8, 6] } as MeasuredPoint;
  const measured = remeasured(remeasured(remeasured([], row, point), ear, point), row, newest);
  expect(measured).toHaveLength(2);
  expect(measuredFor(measured, row, device, TRACKER)).toBe(newest);
  expect(measuredFor(measured, ear, device, TRACKER)).toBe(point);
});
