/** What people enter and measure on a screen, kept while they look at another one. */

import { type Signal, signal } from "@preact/signals";

/** Return a function that gives each device a signal of its own, which outlives the screen. */
export function keptByDevice<T>(initial: () => T): (device: string) => Signal<T> {
  const signals = new Map<string, Signal<T>>();
  return (device) => {
    const known = signals.get(device);
    if (known) return known;
    const made = signal(initial());
    signals.set(device, made);
    return made;
  };
}
