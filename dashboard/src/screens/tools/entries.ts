/** What people type: strobe slots, names of points. */

import { text } from "../../text";

export const MIN_MARKERS = 3;

/** Return strobe slots, or throw an Error that says what they are. */
export function slotsOf(entered: string): number[] {
  const words = entered.split(/[\s,;]+/).filter(Boolean);
  const slots = words.map(Number);
  if (slots.length < MIN_MARKERS || !slots.every((slot) => Number.isInteger(slot) && slot >= 0)) throw new Error(text.tools.noSlots(entered));
  return slots;
}

/** Return the name that follows: of "P9" it is "P10"; of a name without a number it is empty. */
export function following(name: string): string {
  const match = /^(.*?)(\d+)$/.exec(name);
  return match ? `${match[1]}${Number(match[2]) + 1}` : "";
}
