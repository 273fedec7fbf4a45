/** Choices that outlive the screen they are made on: whoever comes back, or reloads, finds them again. */

import { effect, type Signal, signal } from "@preact/signals";

const kept = new Map<string, Signal<string | null>>();

/** Return the signal of this name; at first what the browser's tab remembers, else null. */
export function keptSignal(name: string): Signal<string | null> {
  const known = kept.get(name);
  if (known) return known;
  const stored = `lumiline.kept.${name}`;
  const made = signal<string | null>(sessionStorage.getItem(stored));
  effect(() => {
    if (made.value === null) sessionStorage.removeItem(stored);
    else sessionStorage.setItem(stored, made.value);
  });
  kept.set(name, made);
  return made;
}
