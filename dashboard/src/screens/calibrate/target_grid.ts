/** Targets on a regular grid, for a machine that carries the marker: in the order in which it moves least. */

import { text } from "../../text";
import type { Target } from "../../ui/targets";
import { numbers } from "./wand_input";

type Triple = [number, number, number];

/** As many as a capture session takes. */
export const MAX_TARGETS = 2000;
/** [mm]; finer than any machine is, and it hides the rounding of decimal fractions. */
const DECIMALS = 6;

export interface EnteredGrid {
  /** Position of the first target [mm]. */
  readonly origin: string;
  /** From one target to the next along X, Y, Z [mm]; negative: the other way. */
  readonly steps: string;
  /** Of the targets along X, Y, Z. */
  readonly counts: string;
}

/** Return the targets of a grid as it is entered, or throw an Error that says what to change.
 *
 * They are a serpentine: each is one step from the one before. The axis of the shortest step comes
 * first, that of the longest last, which makes the way as short as that of any serpentine.
 */
export function gridTargets(entered: EnteredGrid): Target[] {
  const origin = triple(entered.origin, text.grid.origin);
  const steps = triple(entered.steps, text.grid.steps);
  const counts = triple(entered.counts, text.grid.counts);
  const wrong = counts.find((count) => !Number.isInteger(count) || count < 1);
  if (wrong !== undefined) throw new Error(text.grid.noCount(wrong));
  if (counts.some((count, axis) => count > 1 && steps[axis] === 0)) throw new Error(text.grid.noStep);
  const all = counts.reduce((product, count) => product * count, 1);
  if (all > MAX_TARGETS) throw new Error(text.grid.tooMany(all, MAX_TARGETS));
  const axes = [0, 1, 2].sort((a, b) => Math.abs(steps[a] ?? 0) - Math.abs(steps[b] ?? 0));
  return Array.from({ length: all }, (_, number): Target => {
    const place: Triple = [...origin];
    let rest = number;
    for (const axis of axes) {
      const count = counts[axis] ?? 1;
      const row = Math.floor(rest / count);
      // Every other row goes back, so that it begins where the one before ended.
      const index = row % 2 ? count - 1 - (rest % count) : rest % count;
      place[axis] = Number(((origin[axis] ?? 0) + index * (steps[axis] ?? 0)).toFixed(DECIMALS));
      rest = row;
    }
    return { name: `${number + 1}`, position_mm: place, marker: null };
  });
}

function triple(entered: string, name: string): Triple {
  const values = numbers(entered);
  if (values.length !== 3) throw new Error(text.grid.noTriple(name));
  return values as Triple;
}
