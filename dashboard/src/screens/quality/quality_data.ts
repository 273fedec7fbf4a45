/** What the screen shows of a device's quality, in words and ranges. */

import type { Schemas } from "../../api/client";
import { text } from "../../text";
import { significant } from "../../ui/format";

type Chart = Schemas["Chart"];
type Check = Schemas["QualityCheck"];
export type Recommendation = Schemas["Quality"]["recommendation"];

export const KINDS: Record<Recommendation, "good" | "idle" | "warn" | "bad"> = {
  none: "good",
  observe: "idle",
  check: "warn",
  recalibrate: "bad",
};

export function toSeconds(iso: string): number {
  return Date.parse(iso) / 1000;
}

/** Return the range that shows all values and the limits. */
export function chartRange(chart: Pick<Chart, "points" | "lower" | "upper">): [number, number] {
  const levels = [
    ...chart.points.flatMap(({ value, average }) => [value, average]),
    ...[chart.lower, chart.upper].filter((level): level is number => level !== null),
  ].filter(Number.isFinite);
  if (!levels.length) return [0, 1];
  const low = Math.min(...levels);
  const high = Math.max(...levels);
  const room = 0.1 * (high - low) || Math.abs(high) * 0.1 || 1;
  return [low - room, high + room];
}

/** Return the newest signal of a chart; null: there is none. */
export function lastSignal(chart: Pick<Chart, "points">): "jump" | "drift" | null {
  const last = chart.points.at(-1)?.signal;
  return last === "jump" || last === "drift" ? last : null;
}

/** Return what a check found, in one line. */
export function found(check: Pick<Check, "kind" | "result">): string {
  const { result } = check;
  if ("errors" in result)
    return text.quality.distance(significant(result.errors.mean, 3), significant(result.errors.rms, 3), significant(result.errors.percentile_95, 3));
  const bias = result.bias === null ? null : significant(result.bias, 3);
  return text.quality.still(significant(result.scatter.rms, 3), significant(result.stated_mm, 3), bias);
}

/** Return numbers of a text such as "3, 4"; null: it is empty. Throws where it holds anything else. */
export function markerNumbers(entered: string): number[] | null {
  const words = entered.split(/[\s,;]+/).filter(Boolean);
  if (!words.length) return null;
  return words.map((word) => {
    if (!/^\d{1,5}$/.test(word)) throw new Error(text.quality.noMarker(word));
    return Number(word);
  });
}

/** Return the number of one marker; null: none is entered. Throws where it is anything else. */
export function oneMarker(entered: string): number | null {
  const numbers = markerNumbers(entered);
  if (numbers && numbers.length > 1) throw new Error(text.quality.noMarker(entered.trim()));
  return numbers?.[0] ?? null;
}
