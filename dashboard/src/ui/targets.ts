/** Target coordinates from a table: CSV or TSV with a heading, as spreadsheets write it. */

import { text } from "../text";

export interface Target {
  name: string;
  position_mm: [number, number, number];
  marker: number | null;
}

const UNITS: Record<string, number> = { mm: 1, cm: 10, m: 1000, um: 1e-3, "µm": 1e-3 };
const AXES = ["x", "y", "z"] as const;

/** Return the targets of a table, or throw an Error that says what to change.
 *
 * Columns X, Y, Z (with a unit: `X_mm`, `X [cm]`; none: mm), optionally `name` and `marker`.
 * Separators are semicolons, tabs or commas; with one of the first two, decimals may have commas.
 *
 * @param table with its heading.
 * @param unlit the name of a row that has no marker.
 */
export function parseTargets(table: string, unlit?: string): Target[] {
  const lines = table.split(/\r\n|\r|\n/).filter((line) => line.trim() && !line.trimStart().startsWith("#"));
  const heading = lines[0];
  if (heading === undefined) throw new Error(text.targets.empty);
  const separator = [";", "\t", ","].find((one) => heading.includes(one));
  if (separator === undefined) throw new Error(text.targets.heading(heading));
  const columns = cells(heading, separator).map((cell) => cell.toLowerCase());
  const axes = AXES.map((axis) => axisColumn(columns, axis));
  const missing = AXES.filter((_, index) => axes[index] === null);
  if (missing.length) throw new Error(text.targets.noColumn(missing.join(", ").toUpperCase(), heading));
  const name = columns.indexOf("name");
  const marker = columns.indexOf("marker");
  const targets = lines.slice(1).map((line, index): Target => {
    const row = cells(line, separator);
    const position = axes.map((axis) => {
      const cell = row[axis?.column ?? -1] ?? "";
      const value = toNumber(cell, separator);
      if (value === null) throw new Error(text.targets.noNumber(index + 2, cell));
      return value * (axis?.factor ?? 1);
    }) as [number, number, number];
    const title = (name < 0 ? "" : row[name]) || `${index + 1}`;
    const dark = marker < 0 || title === unlit;
    const lit = dark ? null : toNumber(row[marker] ?? "", separator);
    if (!dark && (lit === null || !Number.isInteger(lit) || lit < 0))
      throw new Error(text.targets.noMarker(index + 2, row[marker] ?? ""));
    return { name: title, position_mm: position, marker: lit };
  });
  if (!targets.length) throw new Error(text.targets.empty);
  const twice = targets.find((one, index) => targets.findIndex((other) => other.name === one.name) !== index);
  if (twice) throw new Error(text.targets.twice(twice.name));
  return targets;
}

/** Return targets as a table that `parseTargets` reads. */
export function targetsTable(targets: readonly Pick<Target, "name" | "position_mm" | "marker">[]): string {
  const markers = targets.some(({ marker }) => marker !== null);
  const rows = targets.map(({ name, position_mm, marker }) => [name.replaceAll(/[\t\r\n]/g, " "), ...position_mm, ...(markers ? [marker ?? ""] : [])]);
  return [["name", "X [mm]", "Y [mm]", "Z [mm]", ...(markers ? ["marker"] : [])], ...rows].map((row) => row.join("\t")).join("\n");
}

function cells(line: string, separator: string): string[] {
  return line.split(separator).map((cell) => cell.trim().replace(/^"(.*)"$/, "$1").trim());
}

function axisColumn(columns: readonly string[], axis: string): { column: number; factor: number } | null {
  for (const [column, title] of columns.entries()) {
    const match = /^([xyz])[\s_]*(?:[[(]?\s*(mm|cm|m|um|µm)\s*[\])]?)?$/.exec(title);
    if (match?.[1] === axis) return { column, factor: UNITS[match[2] ?? "mm"] ?? 1 };
  }
  return null;
}

function toNumber(cell: string, separator: string): number | null {
  const decimal = separator === "," ? cell : cell.replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(decimal) ? Number(decimal) : null;
}
