/** Requests to a server that is busy at times: they are sent again. */

import { RequestFailed } from "./client";

/** After it a busy server is asked again. */
export const RETRY_MS = 1000;
const BUSY = 503;

/** Return the answer of a server that is busy at times: ask again while it answers 503, and the page is visible.
 *
 * `busy` is called with what such a server says and whether the next request waits for its time, and with null in the end.
 */
export async function whenFree<T>(
  send: () => Promise<T>,
  signal: AbortSignal,
  busy: (failure: RequestFailed | null, waits: boolean) => void = () => {},
): Promise<T> {
  let said = false;
  try {
    for (;;) {
      try {
        return await send();
      } catch (failure) {
        if (signal.aborted || !(failure instanceof RequestFailed) || failure.status !== BUSY) throw failure;
        said = true;
        busy(failure, true);
        do await pause(RETRY_MS, signal);
        while (hidden() && !signal.aborted);
        signal.throwIfAborted();
        // Its message stays until there is another answer: one that comes and goes moves all that is below it.
        busy(failure, false);
      }
    }
  } finally {
    if (said) busy(null, false);
  }
}

/** Whether the server failed at what it was asked for, and not the request. */
export function serverFailed(failure: unknown): failure is RequestFailed {
  return failure instanceof RequestFailed && failure.status >= 500 && failure.status !== BUSY;
}

function hidden(): boolean {
  return typeof document !== "undefined" && document.visibilityState === "hidden";
}

function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(end, milliseconds);
    function end() {
      clearTimeout(timer);
      signal.removeEventListener("abort", end);
      resolve();
    }
    if (signal.aborted) end();
    else signal.addEventListener("abort", end);
  });
}
