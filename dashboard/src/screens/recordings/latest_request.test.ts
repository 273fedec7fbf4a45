import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";

vi.mock("../../api/key", () => ({ key: { value: null } }));

const { RequestFailed } = await import("../../api/client");
const { LatestRequest } = await import("./latest_request");

const failure = (status: number) => new RequestFailed(status, null, `answered ${status}`);

beforeEach(() => void vi.useFakeTimers());
afterEach(() => void vi.useRealTimers());

interface View {
  number: number;
  second: string;
}

/** Views that are loaded when `answer` is called. */
function setUp() {
  const state = { view: { number: 0, second: "" } as View | null, shown: [] as View[], failures: [] as unknown[] };
  const pending: { view: View; resolve: () => void; reject: (failure: unknown) => void }[] = [];
  const requests = new LatestRequest<View>({
    view: () => state.view,
    load: async (view, signal) => {
      await new Promise<void>((resolve, reject) => {
        pending.push({ view, resolve, reject });
        signal.addEventListener("abort", () => reject(failure(0)));
      });
      state.shown.push(view);
    },
    outdates: (newer, loading) => newer.second !== loading.second,
    failed: (one) => state.failures.push(one),
  });
  const answer = async () => {
    pending.shift()?.resolve();
    await vi.advanceTimersByTimeAsync(0);
  };
  const go = (view: View | null) => {
    state.view = view;
    return requests.show();
  };
  return { state, pending, requests, answer, go };
}

describe("the newest view", () => {
  test("is loaded behind the one in flight, and those between are left out", async () => {
    const { state, pending, requests, answer, go } = setUp();
    for (const number of [1, 2, 3]) void go({ number, second: "" });
    expect(pending).toHaveLength(1);
    await answer();
    expect(pending.map(({ view }) => view.number)).toEqual([3]);
    expect(requests.busy).toBe(true);
    await answer();
    expect(state.shown.map(({ number }) => number)).toEqual([1, 3]);
    expect(requests.busy).toBe(false);
  });

  test("of another second calibration aborts the one in flight, whose answer is not shown", async () => {
    const { state, pending, answer, go } = setUp();
    void go({ number: 1, second: "a" });
    void go({ number: 1, second: "b" });
    await vi.advanceTimersByTimeAsync(0);
    pending.shift();
    expect(pending.map(({ view }) => view.second)).toEqual(["b"]);
    await answer();
    expect(state.shown).toEqual([{ number: 1, second: "b" }]);
    expect(state.failures).toEqual([]);
  });

  test("is loaded although an older one failed; its own failure is said", async () => {
    const { state, pending, go } = setUp();
    void go({ number: 1, second: "" });
    void go({ number: 2, second: "" });
    pending.shift()?.reject(failure(404));
    await vi.advanceTimersByTimeAsync(0);
    expect(state.failures).toEqual([]);
    pending.shift()?.reject(failure(410));
    await vi.advanceTimersByTimeAsync(0);
    expect(state.failures).toEqual([failure(410)]);
    expect(pending).toEqual([]);
  });

  test("that comes back after it was aborted is loaded again", async () => {
    const { state, pending, answer, go } = setUp();
    void go({ number: 1, second: "a" });
    void go({ number: 1, second: "b" });
    void go({ number: 1, second: "a" });
    await vi.advanceTimersByTimeAsync(0);
    pending.shift();
    await answer();
    expect(state.shown).toEqual([{ number: 1, second: "a" }]);
  });

  test("is not loaded any more once the player is closed", async () => {
    const { state, pending, requests, go } = setUp();
    void go({ number: 1, second: "" });
    requests.close();
    await vi.advanceTimersByTimeAsync(0);
    void go({ number: 2, second: "" });
    expect(pending).toHaveLength(1);
    expect(state.shown).toEqual([]);
    expect(state.failures).toEqual([]);
  });
});
