/** Changes of a profile's file: the text is the truth, and sliders edit the numbers in it. */

export interface Geometry {
  /** Distances between the sensors, as a factor of the profile's own. */
  readonly baseline: number;
  /** From the sensors to the middle of the volume, as a factor. */
  readonly distance: number;
  /** Sides of the volume, as a factor. */
  readonly volume: number;
  /** Exposure time, as a factor. */
  readonly exposure: number;
}

export const UNCHANGED: Geometry = { baseline: 1, distance: 1, volume: 1, exposure: 1 };

const TRIPLE = /\[\s*"([^"]*)"\s*,\s*"([^"]*)"\s*,\s*"([^"]*)"\s*\]/;
const QUANTITY = /^\s*(-?\d+(?:\.\d+)?(?:e-?\d+)?)\s*([^\d\s].*)$/i;

interface Quantity {
  readonly value: number;
  readonly unit: string;
}

/** Return a profile's text with another geometry; null where it is not written as quantities. */
export function changedProfile(toml: string, change: Geometry): string | null {
  const lines = toml.split("\n");
  const positions: { line: number; values: Quantity[] }[] = [];
  let table = "";
  let exposures = 0;
  let volumes = 0;
  for (let index = 0; index < lines.length; index += 1) {
    const line = lines[index] ?? "";
    const heading = /^\s*\[+([^\]]+)\]+\s*(?:#.*)?$/.exec(line);
    if (heading) table = (heading[1] ?? "").trim();
    const name = /^\s*(\w+)\s*=/.exec(line)?.[1];
    if (table === "sensors" && name === "position") {
      const values = triple(line);
      if (!values) return null;
      positions.push({ line: index, values });
    }
    if (table === "sensors" && name === "aim" && change.distance !== 1) lines[index] = scaled(line, [1, 1, change.distance]) ?? line;
    if (table === "volume" && name === "centre") lines[index] = scaled(line, [1, 1, change.distance]) ?? line;
    if (table === "volume" && name === "size") lines[index] = scaled(line, [change.volume, change.volume, change.volume]) ?? line;
    if (table === "volume" && (name === "centre" || name === "size")) volumes += triple(line) ? 1 : 0;
    if (table === "rates" && name === "exposure") {
      const quantity = parsed(/=\s*"([^"]*)"/.exec(line)?.[1] ?? "");
      if (!quantity) return null;
      lines[index] = line.replace(/"[^"]*"/, `"${written(quantity, change.exposure)}"`);
      exposures += 1;
    }
  }
  if (!positions.length || volumes !== 2 || exposures !== 1) return null;
  const units = new Set(positions.flatMap(({ values }) => values.map(({ unit }) => unit)));
  if (units.size > 1) return null;
  // As it is written: numbers that are only written anew would change under the hand that types.
  if (Object.values(change).every((factor) => factor === 1)) return toml;
  const centre = [0, 1, 2].map((axis) => positions.reduce((sum, { values }) => sum + (values[axis]?.value ?? 0), 0) / positions.length);
  for (const { line, values } of positions) {
    const moved = values.map(({ value, unit }, axis) => `"${rounded((centre[axis] ?? 0) + change.baseline * (value - (centre[axis] ?? 0)))} ${unit}"`);
    lines[line] = (lines[line] ?? "").replace(TRIPLE, `[${moved.join(", ")}]`);
  }
  return lines.join("\n");
}

/** Return a profile's text under another name, and title. */
export function renamed(toml: string, name: string): string {
  return toml.replace(/^name\s*=\s*"[^"]*"/m, () => `name = "${name}"`);
}

export interface StoredProfile {
  readonly name: string;
  readonly toml: string;
}

/** Return the name under which a text is kept, but for its name; null: it is not. */
export function keptAs(toml: string, stored: readonly StoredProfile[]): string | null {
  return stored.find((one) => renamed(one.toml, one.name) === renamed(toml, one.name))?.name ?? null;
}

export function nameOf(toml: string): string | null {
  return /^name\s*=\s*"([^"]*)"/m.exec(toml)?.[1] ?? null;
}

function triple(line: string): Quantity[] | null {
  const found = TRIPLE.exec(line)?.slice(1, 4).map(parsed);
  return found && found.every((one) => one !== null) ? (found as Quantity[]) : null;
}

function scaled(line: string, factors: readonly number[]): string | null {
  const values = triple(line);
  if (!values) return null;
  return line.replace(TRIPLE, `[${values.map((one, axis) => `"${written(one, factors[axis] ?? 1)}"`).join(", ")}]`);
}

function parsed(words: string): Quantity | null {
  const found = QUANTITY.exec(words);
  return found ? { value: Number(found[1]), unit: (found[2] ?? "").trim() } : null;
}

function written({ value, unit }: Quantity, factor: number): string {
  return `${rounded(value * factor)} ${unit}`;
}

function rounded(value: number): number {
  return Number(value.toPrecision(6));
}
