/** Measured points of a registration, each with what it was measured for. */

import type { Device } from "../../devices";
import type { Target } from "../../ui/targets";
import type { MeasuredPoint } from "./digitise";

/** The frame that positions are in where no tool is the reference. */
export const TRACKER = "tracker";

/** A row of the table. */
export type Row = Pick<Target, "name" | "position_mm">;

export interface MeasuredRow {
  readonly row: Row;
  readonly point: MeasuredPoint;
}

/** Return the point measured for this row under these conditions; undefined: none. A point that was measured for another
 * position of the same name, or with another calibration, would register a wrong frame. */
export function measuredFor(measured: readonly MeasuredRow[], row: Row, device: Device, reference: string): MeasuredPoint | undefined {
  return measured.find(
    ({ row: of, point }) =>
      sameRow(of, row) &&
      point.device_id === device.id &&
      point.calibration_id === device.active_calibration_id &&
      point.table_id === device.active_table_id &&
      point.frame_id === reference,
  )?.point;
}

/** Return the points with a new one, which takes the place of the same row's former one. */
export function remeasured(measured: readonly MeasuredRow[], row: Row, point: MeasuredPoint): readonly MeasuredRow[] {
  return [...measured.filter(({ row: of }) => !sameRow(of, row)), { row, point }];
}

function sameRow(one: Row, other: Row): boolean {
  return one.name === other.name && one.position_mm.every((value, axis) => value === other.position_mm[axis]);
}
