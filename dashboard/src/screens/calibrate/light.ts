/** Judges the light that each sensor gets, from the peaks of recent frames. */

import type { Frame } from "../../live/messages";
import { text } from "../../text";

export type Verdict = "good" | "warn" | "bad";

export interface SensorLight {
  readonly sensor: string;
  /** Share of the frames in which it saw a peak. */
  readonly seen: number;
  readonly peaks: number;
  readonly amplitude: number | null;
  readonly sigma_px: number | null;
  readonly width_px: number | null;
  readonly verdict: Verdict;
  readonly advice: string;
}

/** A peak that is less certain costs more than the calibration gains from it. */
const MAX_SIGMA_PX = 0.2;
/** Below it a line is not sampled: its position jumps from pixel to pixel. */
const MIN_WIDTH_PX = 0.5;
const MIN_SEEN = 0.8;
const MIN_SATURATED = 0.05;

/** Return what each sensor sees, in the sensors' order. */
export function judgeLight(sensors: readonly string[], frames: readonly Frame[]): SensorLight[] {
  return sensors.map((sensor) => {
    const perFrame = frames.map((frame) => (frame.peaks ?? []).filter((peak) => peak.sensor === sensor));
    const peaks = perFrame.flat();
    const seen = frames.length ? perFrame.filter((each) => each.length).length / frames.length : 0;
    const saturated = peaks.filter((peak) => peak.flags.includes("saturated")).length;
    const sigma = median(peaks.map((peak) => peak.sigma_px));
    const width = median(peaks.map((peak) => peak.width_px));
    const [verdict, advice] = judge(seen, peaks.length ? saturated / peaks.length : 0, sigma, width);
    return {
      sensor,
      seen,
      peaks: frames.length ? peaks.length / frames.length : 0,
      amplitude: median(peaks.map((peak) => peak.amplitude)),
      sigma_px: sigma,
      width_px: width,
      verdict,
      advice,
    };
  });
}

function judge(seen: number, saturated: number, sigma: number | null, width: number | null): [Verdict, string] {
  if (seen === 0) return ["bad", text.light.none];
  if (saturated > MIN_SATURATED) return ["bad", text.light.saturated];
  if (seen < MIN_SEEN) return ["warn", text.light.rarely];
  if (sigma !== null && sigma > MAX_SIGMA_PX) return ["warn", text.light.dim];
  if (width !== null && width < MIN_WIDTH_PX) return ["warn", text.light.narrow];
  return ["good", text.light.good];
}

function median(values: readonly (number | null)[]): number | null {
  const known = values.filter((value): value is number => value !== null && Number.isFinite(value)).sort((a, b) => a - b);
  return known[Math.floor(known.length / 2)] ?? null;
}
