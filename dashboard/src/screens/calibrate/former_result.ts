/** A calibration beside the one that it was made again from, errors of left-out points first. */

import type { Schemas } from "../../api/client";
import { text } from "../../text";
import { significant } from "../../ui/format";

type Document = Schemas["CalibrationDocument"];
type Compared = Pick<Document, "errors" | "result">;
type Errors = Schemas["PointErrors"] | null | undefined;

export interface ComparedRow {
  readonly figure: string;
  readonly former: string;
  readonly now: string;
}

/** Return the figures of both; `changed` are the points of which a reading was changed, by index. */
export function comparedRows(former: Compared, now: Compared, changed: ReadonlySet<number>): ComparedRow[] {
  const rows: ComparedRow[] = [];
  const add = (figure: string, of: (one: Compared) => string) => {
    const row = { figure, former: of(former), now: of(now) };
    if (row.former !== text.missing || row.now !== text.missing) rows.push(row);
  };
  const errors = (of: (errors: Compared["errors"]) => Errors, name: string) => {
    add(text.labels.mean(name), (one) => axes(of(one.errors)?.statistics?.mean_absolute_mm));
    add(text.labels.max(name), (one) => axes(of(one.errors)?.statistics?.max_absolute_mm));
  };
  errors(({ leave_one_out }) => leave_one_out, text.labels.leftOut);
  const [before, after] = untouchedErrors(former, now, changed);
  if (before && after) rows.push({ figure: text.labels.untouched(before.points), former: axes(before.mean_mm), now: axes(after.mean_mm) });
  errors(({ blocks_left_out }) => blocks_left_out, text.labels.blocks);
  add(text.labels.mean(text.labels.fitted), (one) => axes(one.errors.fitted?.statistics?.mean_absolute_mm));
  add(text.labels.readings, (one) => String(one.errors.fitted?.readings ?? text.missing));
  for (const { model } of now.result.sensors)
    add(text.labels.rms(model.name), (one) => significant(one.result.sensors.find((fit) => fit.model.name === model.name)?.rms_px, 3));
  add(text.labels.suspect, (one) => String(one.result.labels.length));
  return rows;
}

interface Untouched {
  readonly points: number;
  readonly mean_mm: readonly number[];
}

/** Return the mean errors of left-out points that no judgement changed: the same points in both.
 *
 * Without the readings that were left out, errors are smaller for that alone; these are not.
 */
export function untouchedErrors(
  former: Compared,
  now: Compared,
  changed: ReadonlySet<number>,
): readonly [Untouched | null, Untouched | null] {
  const before = former.errors.leave_one_out?.differences_mm;
  const after = now.errors.leave_one_out?.differences_mm;
  if (!before || !after || before.length !== after.length) return [null, null];
  const shared = before.map((_, index) => index).filter((index) => !changed.has(index) && before[index] && after[index]);
  if (!shared.length) return [null, null];
  const mean = (differences: readonly (readonly number[] | null)[]): Untouched => ({
    points: shared.length,
    mean_mm: [0, 1, 2].map(
      (axis) => shared.reduce((sum, index) => sum + Math.abs(differences[index]?.[axis] ?? 0), 0) / shared.length,
    ),
  });
  return [mean(before), mean(after)];
}

function axes(values: readonly number[] | null | undefined): string {
  return values?.map((value) => significant(value, 2)).join(", ") ?? text.missing;
}
