/** The key of this browser tab. It is kept for the session only and never part of an address. */

import { signal } from "@preact/signals";

const STORED = "lumiline.key";

export const key = signal<string | null>(sessionStorage.getItem(STORED));

export function setKey(value: string | null): void {
  if (value) sessionStorage.setItem(STORED, value);
  else sessionStorage.removeItem(STORED);
  key.value = value;
}
