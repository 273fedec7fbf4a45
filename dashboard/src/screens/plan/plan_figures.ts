/** The figures of a plan that are compared: what is reached, and at which cost. */

import type { Schemas } from "../../api/client";
import { text } from "../../text";
import { significant } from "../../ui/format";

export type Plan = Schemas["Plan"];
type Summary = Schemas["AxisSummary"];

export interface Figure {
  readonly name: string;
  readonly value: number | null;
  readonly unit: string;
  /** Whether less is better. */
  readonly less: boolean;
  /** Its standard error, where it is drawn by lot. */
  readonly sigma?: number;
}

/** Return the root of the sum of squares of X, Y and Z; null: no point can be reconstructed. */
export function length(vector: readonly number[] | null | undefined): number | null {
  return vector ? Math.hypot(...vector) : null;
}

export function figures(plan: Plan): Figure[] {
  const of = (summary: Summary | undefined, which: "median" | "worst") => length(summary?.[which]);
  const markers = plan.ghosts.at(-1);
  return [
    { name: text.plan.noiseMedian, value: of(plan.noise, "median"), unit: "mm", less: true },
    { name: text.plan.noiseWorst, value: of(plan.noise, "worst"), unit: "mm", less: true },
    { name: text.plan.total, value: plan.budget?.total_rms_mm ?? null, unit: "mm", less: true },
    { name: text.plan.dilution, value: of(plan.dilution, "median"), unit: "mm/px", less: true },
    { name: text.plan.seenByAll, value: 100 * plan.coverage.all_sensors, unit: "%", less: false },
    { name: text.plan.seenByThree, value: 100 * plan.coverage.three_or_more, unit: "%", less: false },
    ...(markers ? [{ name: text.plan.ghosts(markers.markers), value: markers.expected, unit: "", less: true, sigma: markers.standard_error }] : []),
    {
      name: text.plan.saturated,
      value: plan.sensors.length ? 100 * Math.max(...plan.sensors.map(({ saturated }) => saturated)) : null,
      unit: "%",
      less: true,
    },
  ];
}

/** Return how a figure changed: whether it became better, and by what factor or difference. */
export function difference(before: Figure, after: Figure): { kind: "good" | "bad" | "idle"; words: string } {
  if (before.value === null || after.value === null) {
    if (before.value === after.value) return { kind: "idle", words: text.plan.same };
    return { kind: after.value === null ? "bad" : "good", words: text.missing };
  }
  const change = after.value - before.value;
  if (Math.abs(change) <= 1e-3 * Math.max(Math.abs(before.value), 1e-9)) return { kind: "idle", words: text.plan.same };
  if (Math.abs(change) <= Math.hypot(before.sigma ?? 0, after.sigma ?? 0)) return { kind: "idle", words: text.plan.withinError };
  const kind = change < 0 === before.less ? "good" : "bad";
  const sign = change > 0 ? "+" : "−";
  if (before.unit === "%" || before.value === 0) return { kind, words: `${sign}${significant(Math.abs(change), 2)} ${before.unit}` };
  return { kind, words: `${sign}${significant(Math.abs((100 * change) / before.value), 2)} %` };
}

/** Return the counted contributions of the budget, largest first, with their share of the variance. */
export function contributions(plan: Plan): { name: string; kind: string; rms: number; share: number; assumed: boolean }[] {
  return (plan.budget?.contributions ?? [])
    .filter(({ counted, share }) => counted && share > 0)
    .map(({ name, kind, rms_mm, share, assumed }) => ({ name, kind, rms: rms_mm, share, assumed }))
    .sort((a, b) => b.share - a.share);
}
