/** Numbers and times as text, with as many digits as say something. */

import { text } from "../text";

/** Return a number with the digits that its standard deviation allows: two of that. */
export function withSigma(value: number | null | undefined, sigma: number | null | undefined): string {
  if (value == null || !Number.isFinite(value)) return text.missing;
  if (sigma == null || !Number.isFinite(sigma) || sigma <= 0) return significant(value, 4);
  const digits = Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(sigma))));
  return value.toFixed(digits);
}

/** Return a number with so many significant digits, never in powers of ten within reason. */
export function significant(value: number | null | undefined, digits = 3): string {
  if (value == null || !Number.isFinite(value)) return text.missing;
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e7 || size < 1e-5) return value.toExponential(digits - 1);
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(Math.min(decimals, 8));
}

/** Return a position [mm] with the digits that its covariance allows. */
export function position(
  values: readonly number[] | null | undefined,
  covariance?: readonly (readonly number[])[] | null,
): string {
  if (!values) return text.missing;
  return values
    .map((value, axis) => withSigma(value, Math.sqrt(covariance?.[axis]?.[axis] ?? Number.NaN)))
    .join(", ");
}

/** Return the root of the mean variance of a 3x3 covariance. */
export function meanSigma(covariance: readonly (readonly number[])[] | null | undefined): number | null {
  if (!covariance) return null;
  const trace = [0, 1, 2].reduce((sum, axis) => sum + (covariance[axis]?.[axis] ?? 0), 0);
  return Math.sqrt(trace / 3);
}

export function bytes(count: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let size = count;
  let unit = 0;
  while (size >= 1000 && unit < units.length - 1) {
    size /= 1000;
    unit += 1;
  }
  return `${unit ? significant(size, 3) : size} ${units[unit]}`;
}

/** Return a time of the server [ISO 8601] in the reader's own zone. */
export function time(iso: string | null | undefined): string {
  if (!iso) return text.missing;
  const moment = new Date(iso);
  return Number.isNaN(moment.getTime()) ? iso : moment.toLocaleString();
}

/** Return a time [ms since 1970] as time of day. */
export function timeOfDay(milliseconds: number): string {
  return new Date(milliseconds).toLocaleTimeString();
}

/** Return a time [ms since 1970] as time of day, with its date where that is not today's. */
export function sinceTime(milliseconds: number, now = new Date()): string {
  const moment = new Date(milliseconds);
  return moment.toDateString() === now.toDateString() ? moment.toLocaleTimeString() : moment.toLocaleString();
}
