/** Which parts of the targets' volume have a captured target, and which target would help most next. */

import type { Schemas } from "../../api/client";

type Capture = Schemas["Capture"];
type Target = Capture["targets"][number];
type Session = { readonly targets: readonly Pick<Target, "name" | "position_mm">[]; readonly captured: readonly Pick<Capture["captured"][number], "target">[] };
type Triple = readonly [number, number, number];

export interface Box {
  /** Corners with the least and the largest coordinates [mm]. */
  readonly low: Triple;
  readonly high: Triple;
  readonly targets: number;
  readonly captured: number;
}

const HALVES = 2;

/** Return the bounds of all targets in halves along each axis, X fastest.
 *
 * Along an axis on which all targets have the same coordinate there is nothing to halve.
 */
export function volumeCoverage({ targets, captured }: Session): Box[] {
  const done = new Set(captured.map(({ target }) => target));
  const [x, y, z] = [0, 1, 2].map((axis) => halves(targets.map(({ position_mm }) => position_mm[axis] ?? 0))) as [Halves, Halves, Halves];
  const boxes: Box[] = [];
  for (const [zPart, zRange] of z.ranges.entries())
    for (const [yPart, yRange] of y.ranges.entries())
      for (const [xPart, xRange] of x.ranges.entries()) {
        const inside = targets.filter((_, index) => x.part[index] === xPart && y.part[index] === yPart && z.part[index] === zPart);
        boxes.push({
          low: [xRange[0], yRange[0], zRange[0]],
          high: [xRange[1], yRange[1], zRange[1]],
          targets: inside.length,
          captured: inside.filter(({ name }) => done.has(name)).length,
        });
      }
  return boxes;
}

interface Halves {
  readonly ranges: readonly (readonly [number, number])[];
  /** In which of them each value is. */
  readonly part: readonly number[];
}

function halves(values: readonly number[]): Halves {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const count = high > low ? HALVES : 1;
  const width = (high - low) / count;
  const ranges = Array.from({ length: count }, (_, index) => [low + index * width, low + (index + 1) * width] as const);
  // What is on the border of two belongs to the upper one.
  return { ranges, part: values.map((value) => (count === 1 ? 0 : Math.min(count - 1, Math.floor((value - low) / width)))) };
}

/** Whether the next target is the one that helps most, or the next of the table. */
export type Order = "farthest" | "table";

/** Return the next target that is not captured; null: all are.
 *
 * `farthest` is the one that is farthest from all captured ones, of equal ones the first.
 */
export function proposedTarget<T extends Pick<Target, "name" | "position_mm">>(
  { targets, captured }: { readonly targets: readonly T[]; readonly captured: Session["captured"] },
  order: Order,
): T | null {
  const done = new Set(captured.map(({ target }) => target));
  const left = targets.filter(({ name }) => !done.has(name));
  if (order === "table") return left[0] ?? null;
  const places = targets.filter(({ name }) => done.has(name)).map(({ position_mm }) => position_mm);
  let best: T | null = null;
  let farthest = -1;
  for (const target of left) {
    const distance = Math.min(...places.map((place) => squaredDistance(place, target.position_mm)));
    // Distances that differ by rounding alone are equal.
    if (best === null || distance > farthest * (1 + 1e-9)) {
      best = target;
      farthest = distance;
    }
  }
  return best;
}

function squaredDistance(first: readonly number[], second: readonly number[]): number {
  return [0, 1, 2].reduce((sum, axis) => sum + ((first[axis] ?? 0) - (second[axis] ?? 0)) ** 2, 0);
}
