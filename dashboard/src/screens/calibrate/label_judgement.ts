/** Control points after a person's judgement of the labels that look wrong. */

import type { Schemas } from "../../api/client";
import { text } from "../../text";

export type ControlPoint = Schemas["ControlPoint"];
export type LabelFinding = Schemas["LabelFinding"];
/** `keep`: the readings stay as they are. `exclude`: they are left out. `repair`: they get their own labels. */
export type Judgement = "keep" | "exclude" | "repair";

/** Return the judgements that a finding allows: an outlier belongs to no other point. */
export function judgementsOf({ kind }: LabelFinding): readonly Judgement[] {
  return kind === "outlier" ? ["keep", "exclude"] : ["keep", "exclude", "repair"];
}

/** Return the name of a finding's point, which it counts from 1. */
function pointName(points: readonly ControlPoint[], number: number): string {
  return points[number - 1]?.name ?? String(number);
}

/** Return in words what a finding says. */
export function meaning(finding: LabelFinding, points: readonly ControlPoint[]): string {
  const sensor = finding.sensor ?? text.labels.allSensors;
  const names = finding.points.map((number) => pointName(points, number));
  const [first = "", second = ""] = names;
  if (finding.kind === "outlier") return text.labels.outlier(sensor, first);
  if (finding.kind === "wrong-label") return text.labels.wrongLabel(sensor, first, second);
  if (names.length === 2) return text.labels.exchanged(sensor, first, second);
  return text.labels.cycle(sensor, [...names, first].join(" → "));
}

/** Return the points with each finding kept, left out or repaired; the points given stay unchanged.
 *
 * The same as the server's `repair` and `exclude` (compute/calibration/mislabels/repair.py), finding
 * by finding: those of single sensors name points as they are called once those of all sensors are
 * repaired, also where a person left these as they were.
 */
export function judgePoints(
  points: readonly ControlPoint[],
  findings: readonly LabelFinding[],
  judgements: readonly Judgement[],
): ControlPoint[] {
  const judged = points.map((point) => ({ ...point, readings: { ...point.readings } }));
  /** Where the readings are that a finding expects at a point. */
  const at = points.map((_, index) => index);
  for (const [number, finding] of findings.entries()) {
    const judgement = judgements[number] ?? "keep";
    const named = finding.points.map((point) => point - 1);
    const places = named.map((index) => at[index] ?? index);
    const sensors = finding.sensor === null ? sensorsOf(points) : [finding.sensor];
    for (const sensor of sensors) {
      const before = places.map((place) => judged[place]?.readings[sensor]);
      for (const [index, place] of places.entries()) {
        const readings = judged[place]?.readings;
        if (!readings || judgement === "keep") continue;
        // The reading labelled with each point belongs to the next, the last one's to the first.
        const own = judgement === "repair" ? before.at(index - 1) : undefined;
        if (own === undefined) delete readings[sensor];
        else readings[sensor] = own;
      }
    }
    if (finding.sensor === null && judgement !== "repair")
      for (const [index, place] of named.entries()) at[place] = places.at(index - 1) ?? place;
  }
  return judged;
}

function sensorsOf(points: readonly ControlPoint[]): string[] {
  return [...new Set(points.flatMap(({ readings }) => Object.keys(readings)))];
}

/** Return the indices of the points of which a judgement changed a reading. */
export function changedPoints(before: readonly ControlPoint[], after: readonly ControlPoint[]): ReadonlySet<number> {
  const changed = after.flatMap((point, index) =>
    JSON.stringify(sorted(point)) === JSON.stringify(sorted(before[index])) ? [] : [index],
  );
  return new Set(changed);
}

function sorted(point: ControlPoint | undefined): unknown {
  return Object.entries(point?.readings ?? {}).sort(([a], [b]) => a.localeCompare(b));
}
