import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";

vi.mock("./key", () => ({ key: { value: null } }));

const { RequestFailed } = await import("./client");
const { RETRY_MS, serverFailed, whenFree } = await import("./busy_server");

const failure = (status: number) => new RequestFailed(status, null, `answered ${status}`);

beforeEach(() => void vi.useFakeTimers());
afterEach(() => void vi.useRealTimers());

describe("a busy server", () => {
  test("is asked again after a second until it answers", async () => {
    const send = vi.fn<() => Promise<string>>().mockRejectedValueOnce(failure(503)).mockRejectedValueOnce(failure(503)).mockResolvedValue("frames");
    const said: [string | null, boolean][] = [];
    const answer = whenFree(send, new AbortController().signal, (one, waits) => said.push([one?.message ?? null, waits]));
    await vi.advanceTimersByTimeAsync(RETRY_MS - 1);
    expect(send).toHaveBeenCalledTimes(1);
    await vi.advanceTimersByTimeAsync(RETRY_MS + 1);
    expect(await answer).toBe("frames");
    // Its words stay from the first to the last: a line that comes and goes moves the page.
    expect(said).toEqual([
      ["answered 503", true],
      ["answered 503", false],
      ["answered 503", true],
      ["answered 503", false],
      [null, false],
    ]);
  });

  test("is not asked again when the answer is not wanted any more", async () => {
    const send = vi.fn().mockRejectedValue(failure(503));
    const controller = new AbortController();
    const answer = whenFree(send, controller.signal).catch(() => "aborted");
    await vi.advanceTimersByTimeAsync(10);
    controller.abort();
    expect(await answer).toBe("aborted");
    expect(send).toHaveBeenCalledTimes(1);
  });

  test("is not asked while the page is hidden", async () => {
    const page = { visibilityState: "hidden" };
    vi.stubGlobal("document", page);
    const send = vi.fn<() => Promise<string>>().mockRejectedValueOnce(failure(503)).mockResolvedValue("frames");
    const answer = whenFree(send, new AbortController().signal);
    await vi.advanceTimersByTimeAsync(10 * RETRY_MS);
    expect(send).toHaveBeenCalledTimes(1);
    page.visibilityState = "visible";
    await vi.advanceTimersByTimeAsync(RETRY_MS);
    expect(await answer).toBe("frames");
    vi.unstubAllGlobals();
  });

  test("leaves nothing said when it fails otherwise", async () => {
    const send = vi.fn().mockRejectedValueOnce(failure(503)).mockRejectedValue(failure(404));
    const said: unknown[] = [];
    const answer = whenFree(send, new AbortController().signal, (one) => said.push(one)).catch(() => "failed");
    await vi.advanceTimersByTimeAsync(RETRY_MS);
    expect(await answer).toBe("failed");
    expect(said.at(-1)).toBeNull();
  });

  test.each([0, 404, 500])("status %i is no busy server", async (status) => {
    await expect(whenFree(() => Promise.reject(failure(status)), new AbortController().signal)).rejects.toThrow(`answered ${status}`);
  });
});

test.each([
  [500, true],
  [502, true],
  [503, false],
  [422, false],
  [0, false],
])("status %i is a failure of the server: %s", (status, expected) => expect(serverFailed(failure(status))).toBe(expected));
