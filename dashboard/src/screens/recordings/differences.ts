/** Points of the same frames by two calibrations: which belong together, and how far they are apart. */

import type { Schemas } from "../../api/client";

type RecordedFrame = Pick<Schemas["RecordedFrame"], "number" | "marker"> & {
  points: readonly Pick<Schemas["RecordedPoint"], "marker" | "position_mm">[];
};
type Vector = readonly [number, number, number];

/** Second minus first [mm]. */
export type Difference = Vector;

/** Return the differences of points that both calibrations have.
 *
 * A strobed frame has one marker. Points of markers lit together have no names: two belong together
 * where each is the other's nearest.
 */
export function differences(first: readonly RecordedFrame[], second: readonly RecordedFrame[]): Difference[] {
  const others = new Map(second.map((frame) => [frame.number, positions(frame)]));
  return first.flatMap((frame) => {
    const from = positions(frame);
    const to = others.get(frame.number) ?? [];
    if (frame.marker !== null && from.length === 1 && to.length === 1) return [minus(to[0] as Vector, from[0] as Vector)];
    return from.flatMap((point) => {
      const near = nearest(point, to);
      return near && nearest(near, from) === point ? [minus(near, point)] : [];
    });
  });
}

function positions(frame: RecordedFrame): Vector[] {
  return frame.points.flatMap(({ position_mm }) => (position_mm?.every(Number.isFinite) ? [position_mm as Vector] : []));
}

function minus(a: Vector, b: Vector): Vector {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

function nearest(point: Vector, others: readonly Vector[]): Vector | null {
  let best: Vector | null = null;
  let least = Number.POSITIVE_INFINITY;
  for (const other of others) {
    const distance = Math.hypot(...minus(other, point));
    if (distance < least) [best, least] = [other, distance];
  }
  return best;
}

export interface DifferenceRow {
  readonly axis: "X" | "Y" | "Z" | "distance";
  /** With its sign, of an axis. */
  readonly median_mm: number;
  /** 95 % are not further apart. */
  readonly p95_mm: number;
  readonly largest_mm: number;
}

/** Return median, 95 % and largest, by axis and of the distance; none without points. */
export function differenceRows(found: readonly Difference[]): DifferenceRow[] {
  if (!found.length) return [];
  const row = (axis: DifferenceRow["axis"], values: readonly number[]): DifferenceRow => {
    const sizes = values.map(Math.abs);
    return { axis, median_mm: quantile(values, 0.5), p95_mm: quantile(sizes, 0.95), largest_mm: quantile(sizes, 1) };
  };
  return [
    ...(["X", "Y", "Z"] as const).map((axis, index) => row(axis, found.map((one) => one[index] ?? 0))),
    row("distance", found.map((one) => Math.hypot(...one))),
  ];
}

/** Return the smallest value that the share does not exceed; of an even number's median the mean of two. */
function quantile(values: readonly number[], share: number): number {
  const sorted = [...values].sort((a, b) => a - b);
  const at = share * (sorted.length - 1);
  const low = sorted[Math.floor(at)] ?? Number.NaN;
  const high = sorted[Math.ceil(at)] ?? Number.NaN;
  return low + (high - low) * (at - Math.floor(at));
}

/** Return where pages of frames begin that are spread evenly over a recording. */
export function samplePages(frames: number, pages: number, count: number): number[] {
  if (frames <= pages * count) return Array.from({ length: Math.ceil(frames / count) }, (_, page) => page * count);
  return Array.from({ length: pages }, (_, page) => Math.round((page * (frames - count)) / (pages - 1)));
}
