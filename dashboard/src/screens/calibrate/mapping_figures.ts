/** What a correction table's validation says of each sensor; an uploaded table may hold anything. */

import type { Schemas } from "../../api/client";

type Table = Pick<Schemas["CorrectionTableDocument"], "sensors" | "valid_share" | "max_correction_px" | "validation" | "settings">;

export interface MappedSensor {
  readonly sensor: string;
  readonly points: number | null;
  /** RMS error of measurements that the table never saw [px]. */
  readonly leftOut_px: number | null;
  /** The same measurements without the table [px]. */
  readonly without_px: number | null;
  /** With the table, of the measurements that it was made from [px]. */
  readonly fitted_px: number | null;
  /** Standard deviation of a reading [px]. */
  readonly sigma_px: number | null;
  readonly supported: number;
  readonly correction_px: number | null;
  readonly resolution_mm: number | null;
  readonly coverage: string;
  readonly suspects: readonly number[];
}

/** Return the figures of each sensor, in the table's order. */
export function mappedSensors(table: Table): MappedSensor[] {
  const found = Array.isArray(table.validation["sensors"]) ? table.validation["sensors"] : [];
  return table.sensors.map((sensor, index) => {
    const figures = (found.find((one) => isObject(one) && one["sensor"] === sensor) ?? {}) as Record<string, unknown>;
    const suspects = Array.isArray(figures["suspects"]) ? figures["suspects"] : [];
    return {
      sensor,
      points: number(figures["points"]),
      leftOut_px: number(figures["left_out_rms_px"]),
      without_px: number(figures["before_rms_px"]),
      fitted_px: number(figures["after_rms_px"]),
      sigma_px: number(figures["sigma_px"]),
      supported: table.valid_share[index] ?? 0,
      correction_px: table.max_correction_px[index] ?? null,
      resolution_mm: number(figures["resolution_mm"]),
      coverage: typeof figures["coverage"] === "string" ? figures["coverage"] : "",
      suspects: suspects.flatMap((one) => (isObject(one) && typeof one["point"] === "number" ? [one["point"]] : [])),
    };
  });
}

export type MappingVerdict = "better" | "mixed" | "worse" | "unknown";

/** Return whether measurements that the table never saw say that it helps.
 *
 * A sensor gets worse by more than twice its readings' noise, or not at all.
 */
export function mappingVerdict(sensors: readonly MappedSensor[]): MappingVerdict {
  const judged = sensors.flatMap(({ leftOut_px: left, without_px: without, sigma_px }) =>
    left === null || without === null ? [] : [left < without ? "better" : left > Math.hypot(without, 2 * (sigma_px ?? 0)) ? "worse" : "same"],
  );
  if (!judged.length) return "unknown";
  if (!judged.includes("better")) return "worse";
  return judged.includes("worse") ? "mixed" : "better";
}

/** Return whether the table was made from points that made its calibration: its errors there look too small. */
export function sharesPoints(table: Table): boolean {
  return table.settings["points_made_the_calibration"] === true;
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null;
}

function number(value: unknown): number | null {
  return typeof value === "number" && Number.isFinite(value) ? value : null;
}
