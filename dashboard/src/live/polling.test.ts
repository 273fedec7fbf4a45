import type * as Signals from "@preact/signals";
import { afterEach, beforeAll, beforeEach, expect, test, vi } from "vitest";

// Hooks without a component: what they keep lives as long as the test.
vi.mock("preact/hooks", () => ({
  useCallback: (call: unknown) => call,
  useEffect: () => undefined,
  useRef: (current: unknown) => ({ current }),
}));
vi.mock("@preact/signals", async (original) => {
  const signals = await original<typeof Signals>();
  return { ...signals, useSignal: signals.signal, useComputed: signals.computed, useSignalEffect: signals.effect };
});

let polling: typeof import("./polling");
let client: typeof import("../api/client");

beforeAll(async () => {
  vi.stubGlobal("document", Object.assign(new EventTarget(), { visibilityState: "visible" }));
  vi.stubGlobal("sessionStorage", { getItem: () => null });
  polling = await import("./polling");
  client = await import("../api/client");
}, 60_000);

beforeEach(() => void vi.useFakeTimers());

afterEach(() => {
  vi.clearAllTimers();
  vi.useRealTimers();
});

/** Poll what fails as often as said, then answers; return how often it was asked for after each of these seconds. */
async function askedAfter(failures: number, seconds: number, pauses: readonly number[]): Promise<number[]> {
  let asked = 0;
  const load = () => {
    asked += 1;
    return asked > failures ? Promise.resolve("found") : Promise.reject(new client.RequestFailed(503, null, "busy"));
  };
  polling.usePolled("one", load, seconds);
  const counts: number[] = [];
  for (const pause of pauses) {
    await vi.advanceTimersByTimeAsync(pause * 1000);
    counts.push(asked);
  }
  return counts;
}

test("what failed is asked for again soon, and once it is answered as seldom as it ought to be", async () => {
  expect(await askedAfter(2, 3600, [1, 3, 3, 3000, 700])).toEqual([1, 2, 3, 3, 4]);
});

test("what is polled often is not asked for more slowly after a failure", async () => {
  expect(await askedAfter(2, 1, [0.5, 1, 1, 1])).toEqual([1, 2, 3, 4]);
});
