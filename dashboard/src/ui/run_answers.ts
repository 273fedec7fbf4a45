/** What a page asks for about a run. */

import type { Schemas } from "../api/client";

type Run = Schemas["Run"];

/** Return whether a run has not ended yet. */
export function isActive({ state }: Pick<Run, "state">): boolean {
  return state === "queued" || state === "running";
}

/** Return a function that gets a run by its id until it has ended: from then on it gives the last answer, as nothing changes. */
export function untilEnded(get: (id: string) => Promise<Run>): (id: string) => Promise<Run> {
  let last: Run | null = null;
  return async (id) => {
    if (last?.id !== id || isActive(last)) last = await get(id);
    return last;
  };
}
