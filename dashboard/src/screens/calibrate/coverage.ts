/** Which parts of each sensor's pixels the captured readings cover. */

import type { Schemas } from "../../api/client";

export interface SensorCoverage {
  readonly sensor: string;
  readonly readings: number;
  /** Share of the sensor's parts that hold a reading. */
  readonly share: number;
  /** Pixels, first and last, of neighbouring parts without any. */
  readonly gaps: readonly (readonly [number, number])[];
}

const PARTS = 8;

/** Return the coverage of each sensor, in the sensors' order. */
export function coverage(
  capture: Pick<Schemas["Capture"], "captured">,
  sensors: readonly Schemas["Sensor"][],
): SensorCoverage[] {
  return sensors.map(({ name, pixels }) => {
    const readings = capture.captured.flatMap((target) =>
      target.sensors.filter(({ sensor }) => sensor === name).map(({ mean_px }) => mean_px),
    );
    const filled = Array.from({ length: PARTS }, () => false);
    for (const px of readings) filled[Math.min(PARTS - 1, Math.max(0, Math.floor(((px + 0.5) / pixels) * PARTS)))] = true;
    const gaps: [number, number][] = [];
    filled.forEach((full, part) => {
      if (full) return;
      const from = Math.round((part / PARTS) * pixels);
      const to = Math.round(((part + 1) / PARTS) * pixels) - 1;
      const before = gaps.at(-1);
      if (before && before[1] === from - 1) before[1] = to;
      else gaps.push([from, to]);
    });
    return { sensor: name, readings: readings.length, share: filled.filter(Boolean).length / PARTS, gaps };
  });
}
