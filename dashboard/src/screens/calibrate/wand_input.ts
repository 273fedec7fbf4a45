/** What is entered of a wand: its markers' positions, strobe numbers, directions of pixels. */

import { text } from "../../text";

/** Return the numbers in a text, or throw an Error that says what to change. */
export function numbers(entered: string): number[] {
  return entered
    .split(/[\s;]+|,\s*(?=\S)/)
    .filter(Boolean)
    .map((word) => {
      const value = Number(word);
      if (!Number.isFinite(value)) throw new Error(text.wand.noNumber(word));
      return value;
    });
}

/** Return positions along the wand [mm] and strobe numbers, or throw an Error. */
export function wand(positions: string, markers: string): { position_mm: number[]; markers: number[] } {
  const position_mm = numbers(positions);
  const strobed = numbers(markers);
  if (position_mm.length < 2) throw new Error(text.wand.tooFew);
  if (strobed.length !== position_mm.length) throw new Error(text.wand.asMany(position_mm.length, strobed.length));
  const wrong = strobed.find((one) => !Number.isInteger(one) || one < 0);
  if (wrong !== undefined) throw new Error(text.wand.noMarker(`${wrong}`));
  return { position_mm, markers: strobed };
}

/** Return the directions of all sensors' pixels; null: none is entered; throw where some are missing. */
export function directions(
  entered: Readonly<Record<string, string>>,
  sensors: readonly string[],
): Record<string, number> | null {
  const given = sensors.filter((name) => entered[name]?.trim());
  if (!given.length) return null;
  const missing = sensors.filter((name) => !given.includes(name));
  if (missing.length) throw new Error(text.wand.directionMissing(missing.join(", ")));
  return Object.fromEntries(
    sensors.map((name) => {
      const [value, ...more] = numbers(entered[name] ?? "");
      if (value === undefined || more.length) throw new Error(text.wand.noNumber(entered[name] ?? ""));
      return [name, value];
    }),
  );
}
