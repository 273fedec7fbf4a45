import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import type { LiveScans, ScansQuery } from "./live_scans";
import type { Scans } from "./scan_data";

vi.mock("../../api/key", () => ({ key: { value: null }, setKey: vi.fn() }));
vi.stubGlobal("document", Object.assign(new EventTarget(), { visibilityState: "visible" }));
const modules = await Promise.all([import("./live_scans"), import("../../api/client"), import("../../text")]);
const [{ LiveScans: Followed }, { RequestFailed }, { text }] = modules;

let sequence = 0;
let asked: { query: ScansQuery; signal: AbortSignal }[] = [];
let answer: () => Promise<Scans>;
let live: LiveScans;

const good = async () => ({ sequence: ++sequence }) as unknown as Scans;
const hangs = () => new Promise<Scans>(() => undefined);
const fails = (status: number) => () => Promise.reject(new RequestFailed(status, null, `failed ${status}`));

beforeEach(() => {
  vi.useFakeTimers();
  asked = [];
  answer = good;
  live = new Followed("left", (query, signal) => {
    asked.push({ query, signal });
    return answer();
  });
});

afterEach(() => {
  live.close();
  vi.useRealTimers();
});

describe("live scans", () => {
  test("come one after another", async () => {
    await vi.advanceTimersByTimeAsync(3000);
    expect(asked.length).toBeGreaterThan(10);
    expect(asked.length).toBeLessThan(18);
    expect(live.error.value).toBeNull();
  });

  test("of a server that does not answer are marked old after a second", async () => {
    await vi.advanceTimersByTimeAsync(1000);
    answer = hangs;
    await vi.advanceTimersByTimeAsync(1300);
    expect(live.scans.value).not.toBeNull();
    expect(live.error.value).toBe(text.scans.silent);
  });

  test("of a server that is busy now and then are not old, of one that stays busy are, in its words", async () => {
    answer = fails(503);
    await vi.advanceTimersByTimeAsync(500);
    answer = good;
    await vi.advanceTimersByTimeAsync(500);
    expect(live.error.value).toBeNull();
    answer = fails(503);
    await vi.advanceTimersByTimeAsync(500);
    expect(live.error.value).toBeNull();
    await vi.advanceTimersByTimeAsync(700);
    expect(live.error.value).toBe("failed 503");
    answer = good;
    await vi.advanceTimersByTimeAsync(500);
    expect(live.error.value).toBeNull();
  });

  test("that fail say why at once", async () => {
    await vi.advanceTimersByTimeAsync(500);
    answer = fails(409);
    await vi.advanceTimersByTimeAsync(250);
    expect(live.error.value).toBe("failed 409");
  });

  test("of another sensor are asked for at once, and the request before is given up", async () => {
    answer = hangs;
    await vi.advanceTimersByTimeAsync(300);
    live.sensor.value = "right";
    await vi.advanceTimersByTimeAsync(0);
    expect(asked.at(-1)?.query).toEqual({ detail_sensor: "right" });
    expect(asked.at(-2)?.signal.aborted).toBe(true);
  });

  test("that are frozen stay, and are not old for that; one more is taken when asked for", async () => {
    await vi.advanceTimersByTimeAsync(500);
    live.frozen.value = true;
    const before = live.scans.value;
    await vi.advanceTimersByTimeAsync(5000);
    expect([live.scans.value, live.error.value]).toEqual([before, null]);
    await live.next();
    expect(live.scans.value).not.toEqual(before);
    answer = fails(503);
    await live.next();
    expect(live.error.value).toBe("failed 503");
  });
});
