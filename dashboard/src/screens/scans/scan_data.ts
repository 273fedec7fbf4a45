/** A scan as arrays to draw and rows to save: counts, fitted model, residuals. */

import type { Schemas } from "../../api/client";

export type Scan = Schemas["DeviceScan"];
export type Scans = Schemas["DeviceScans"];

/** What the vertical axis shows: the scan, the range of the detector, or the level of the threshold. */
export type Vertical = "scan" | "full" | "background";

export interface FittedLine {
  /** Expected counts of each pixel; null outside the fits. */
  readonly model: (number | null)[];
  /** Counts less model in standard deviations; null outside the fits, and where a pixel is left out. */
  readonly residual: (number | null)[];
}

/** Return model and residual of each pixel, from the windows that the service fitted. */
export function fittedLine(scan: Scan): FittedLine {
  const model = new Array<number | null>(scan.counts.length).fill(null);
  const residual = new Array<number | null>(scan.counts.length).fill(null);
  for (const window of scan.windows ?? []) {
    window.model.forEach((value, index) => {
      const pixel = window.first_px + index;
      if (pixel >= model.length || value === null) return;
      model[pixel] = value;
      residual[pixel] = window.used[index] ? (window.residual_sigma[index] ?? null) : null;
    });
  }
  return { model, residual };
}

/** Return the lowest and the highest count to show. */
export function verticalRange(scan: Scan, vertical: Vertical): [number, number] {
  const threshold = scan.threshold_counts ?? scan.background_counts + 6 * scan.noise_counts;
  if (vertical === "full") return [0, 1.05 * scan.full_scale_counts];
  if (vertical === "background") {
    const above = Math.max(threshold - scan.background_counts, scan.noise_counts, 1);
    return [scan.background_counts - above, scan.background_counts + 3 * above];
  }
  // Not Math.max(...): a sensor may have 65536 pixels.
  const lowest = scan.counts.reduce((a, b) => Math.min(a, b), scan.background_counts);
  const highest = scan.counts.reduce((a, b) => Math.max(a, b), threshold);
  const room = 0.08 * Math.max(highest - lowest, 1);
  return [lowest - room, highest + 1.5 * room];
}

const MIN_SHOWN_PX = 8;

/** Return a range of pixels moved and stretched about its middle, kept inside the sensor. */
export function zoomed(range: readonly [number, number], factor: number, shift: number, pixels: number): [number, number] {
  const last = pixels - 1;
  const size = Math.min(last, Math.max(MIN_SHOWN_PX, (range[1] - range[0]) * factor));
  const middle = (range[0] + range[1]) / 2 + shift * (range[1] - range[0]);
  const first = Math.min(Math.max(0, middle - size / 2), last - size);
  return [first, first + size];
}

/** Return the pixels about a peak, some of its widths. */
export function aroundPeak(position: number, width: number | null, pixels: number): [number, number] {
  const reach = Math.max(12, 4 * (width ?? 3));
  return zoomed([position - reach, position + reach], 1, 0, pixels);
}

/** Return the exposure as rows: every sensor's counts, and model and residual of the fitted one. */
export function csvRows(scans: Scans): (string | number | null)[][] {
  const fits = scans.scans.filter((scan) => scan.windows).map((scan) => ({ scan, line: fittedLine(scan) }));
  const heading = [
    "pixel",
    ...scans.scans.map((scan) => `${scan.sensor} [counts]`),
    ...fits.flatMap(({ scan }) => [`${scan.sensor} model [counts]`, `${scan.sensor} residual [sigma]`]),
  ];
  const pixels = scans.scans.reduce((most, scan) => Math.max(most, scan.counts.length), 0);
  const rows: (string | number | null)[][] = [heading];
  for (let pixel = 0; pixel < pixels; pixel += 1)
    rows.push([
      pixel,
      ...scans.scans.map((scan) => scan.counts[pixel] ?? null),
      ...fits.flatMap(({ line }) => [line.model[pixel] ?? null, line.residual[pixel] ?? null]),
    ]);
  return rows;
}

export function fileName(scans: Scans, ending: string): string {
  return `${scans.device_id}-exposure-${scans.sequence}.${ending}`;
}
