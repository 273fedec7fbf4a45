/** Documents whose ids outlive the screen, see ``keptSignal``. */

import type { Signal } from "@preact/signals";
import { RequestFailed } from "../api/client";

/** Return the document of an id; null where there is none. An id that the server knows no more is forgotten. */
export async function whileKnown<T>(id: Signal<string | null>, get: (id: string) => Promise<T>): Promise<T | null> {
  const asked = id.value;
  if (asked === null) return null;
  try {
    return await get(asked);
  } catch (failure) {
    if (!(failure instanceof RequestFailed) || failure.status !== 404) throw failure;
    // Another one may have been begun meanwhile.
    if (id.value === asked) id.value = null;
    return null;
  }
}
