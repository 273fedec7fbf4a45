/** Resources that are asked for again while they are shown, so that what others change appears. */

import { useComputed, useSignal, useSignalEffect } from "@preact/signals";
import { useCallback, useEffect, useRef } from "preact/hooks";
import { RequestFailed } from "../api/client";
import { RequestOrder } from "../api/request_order";
import { openSession, serverReached } from "../api/session";
import { text } from "../text";
import { visible } from "./visibility";

/** An answer that takes longer is not waited for: without one nothing would be asked any more. */
const LIMIT_MS = 15_000;

export interface Polled<T> {
  readonly value: T | null;
  readonly error: string | null;
  /** Ask again now. */
  readonly refresh: () => Promise<void>;
}

/** What failed is asked for again after so long at most: what is hardly ever polled would else show its error for an hour. */
const RETRY_S = 3;

/** Return what `load` gives, asked for at once, every `seconds`, sooner after a failure, and when the page is seen again.
 *
 * `identity` names what is asked for: another one begins anew.
 */
export function usePolled<T>(identity: string, load: () => Promise<T>, seconds = 3): Polled<T> {
  const value = useSignal<T | null>(null);
  const error = useSignal<string | null>(null);
  const current = useRef({ identity, load });
  if (current.current.identity !== identity) {
    value.value = null;
    error.value = null;
  }
  current.current = { identity, load };
  const order = useRef(new RequestOrder()).current;
  const waiting = useRef(0);

  const refresh = useCallback(async () => {
    const asked = current.current.identity;
    const number = order.begin();
    waiting.current += 1;
    try {
      const found = await withinLimit(current.current.load());
      if (asked !== current.current.identity || !order.isNewest(number)) return;
      // Equal documents are not set: whatever shows them need not be drawn again.
      if (JSON.stringify(found) !== JSON.stringify(value.value)) value.value = found;
      error.value = null;
      serverReached.value = true;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      if (asked !== current.current.identity || !order.isNewest(number)) return;
      error.value = failure.message;
      if (failure.status === 0) serverReached.value = false;
      if (failure.status === 401) await openSession();
    } finally {
      waiting.current -= 1;
    }
  }, []);

  useSignalEffect(() => {
    if (visible.value) void refresh();
  });
  const failed = useComputed(() => error.value !== null);
  useSignalEffect(() => {
    if (!visible.value) return undefined;
    // A server that is slower than that is not asked again meanwhile.
    const timer = setInterval(
      () => {
        if (waiting.current === 0) void refresh();
      },
      (failed.value ? Math.min(seconds, RETRY_S) : seconds) * 1000,
    );
    return () => clearInterval(timer);
  });
  const first = useRef(true);
  useEffect(() => {
    if (first.current) first.current = false;
    else void refresh();
  }, [identity]);
  return { value: value.value, error: error.value, refresh };
}

function withinLimit<T>(answer: Promise<T>): Promise<T> {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(() => reject(new RequestFailed(0, null, text.connection.noAnswer)), LIMIT_MS);
    void answer.then(resolve, reject).finally(() => clearTimeout(timer));
  });
}
