import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { encode } from "@msgpack/msgpack";
import type { Signal } from "@preact/signals";
import type { DeviceStream } from "./device_stream";

/** A socket whose other end is the test. */
class FakeSocket {
  static made: FakeSocket[] = [];
  onopen: (() => void) | null = null;
  onmessage: ((event: { data: Uint8Array }) => void) | null = null;
  onclose: ((event: { code: number; reason: string }) => void) | null = null;
  binaryType = "";
  closed = false;

  constructor(readonly address: URL) {
    FakeSocket.made.push(this);
  }

  /** As of a half-open connection: its end is not heard of. */
  close(): void {
    this.closed = true;
  }

  send(message: object): void {
    this.onmessage?.({ data: encode(message) });
  }

  greet(state = "running", frame_rate_hz = 100): void {
    this.onopen?.();
    this.send({ type: "hello", state, reason: null, frame_rate_hz, holds: null });
  }
}

const page = Object.assign(new EventTarget(), { visibilityState: "visible" });
let stream: DeviceStream;
let serverReached: Signal<boolean>;

function newest(): FakeSocket {
  const socket = FakeSocket.made.at(-1);
  if (!socket) throw new Error("no socket was opened");
  return socket;
}

function show(state: "visible" | "hidden"): void {
  page.visibilityState = state;
  page.dispatchEvent(new Event("visibilitychange"));
}

/** Let time pass in which frames come. */
function sendFrames(milliseconds: number): void {
  for (let passed = 0; passed < milliseconds; passed += 50) {
    newest().send({ type: "frame", sequence: passed, holds: null });
    vi.advanceTimersByTime(50);
  }
}

beforeEach(async () => {
  vi.useFakeTimers();
  vi.stubGlobal("WebSocket", FakeSocket);
  vi.stubGlobal("document", page);
  vi.stubGlobal("location", { href: "http://server/" });
  vi.stubGlobal("sessionStorage", { getItem: () => null });
  FakeSocket.made = [];
  show("visible");
  const { DeviceStream } = await import("./device_stream");
  serverReached = (await import("../api/session")).serverReached;
  serverReached.value = true;
  stream = new DeviceStream("sim", ["points"], 30);
}, 60_000);

afterEach(() => {
  stream.close();
  vi.useRealTimers();
});

describe("a stream", () => {
  test("with frames is open and not stale", () => {
    expect(stream.connection.value).toBe("connecting");
    newest().greet();
    sendFrames(10_000);
    expect(stream.connection.value).toBe("open");
    expect(stream.stale.value).toBe(false);
    expect(FakeSocket.made).toHaveLength(1);
  });

  test("that breaks says so at once, keeps the old frame apart, and comes back by itself", () => {
    newest().greet();
    sendFrames(100);
    newest().onclose?.({ code: 1006, reason: "" });
    expect([stream.connection.value, stream.stale.value]).toEqual(["lost", true]);
    vi.advanceTimersByTime(400);
    expect(FakeSocket.made).toHaveLength(2);
    expect(stream.connection.value).toBe("lost");
    newest().greet();
    expect(stream.connection.value).toBe("open");
    expect(stream.frame.value).toBeNull();
    sendFrames(50);
    expect(stream.stale.value).toBe(false);
  });

  test("that falls silent says so within a second, and is opened again after five", () => {
    newest().greet();
    sendFrames(100);
    vi.advanceTimersByTime(1000);
    expect([stream.connection.value, stream.stale.value]).toEqual(["open", true]);
    const silent = newest();
    vi.advanceTimersByTime(3900);
    expect(FakeSocket.made).toHaveLength(1);
    vi.advanceTimersByTime(700);
    expect(silent.closed).toBe(true);
    expect([stream.connection.value, FakeSocket.made.length]).toEqual(["lost", 2]);
    // What the given up connection still says counts no more.
    silent.send({ type: "frame", sequence: 1, holds: null });
    silent.onclose?.({ code: 1006, reason: "" });
    expect([stream.connection.value, FakeSocket.made.length]).toEqual(["lost", 2]);
    // A greeting alone is no data.
    newest().greet();
    vi.advanceTimersByTime(200);
    expect([stream.connection.value, stream.stale.value]).toEqual(["open", true]);
    sendFrames(50);
    expect(stream.stale.value).toBe(false);
  });

  test("of a device that does not run may be silent", () => {
    newest().greet("stopped");
    vi.advanceTimersByTime(60_000);
    expect([stream.connection.value, stream.stale.value, FakeSocket.made.length]).toEqual(["open", false, 1]);
  });

  test("of a device that does not run is old while the server answers nothing, and until it greets again", () => {
    newest().greet("stopped");
    vi.advanceTimersByTime(1000);
    serverReached.value = false;
    vi.advanceTimersByTime(100);
    expect([stream.connection.value, stream.stale.value]).toEqual(["lost", true]);
    vi.advanceTimersByTime(400);
    expect(FakeSocket.made).toHaveLength(2);
    // The old connection may be dead: that the server is back does not make it alive.
    serverReached.value = true;
    vi.advanceTimersByTime(1000);
    expect([stream.connection.value, stream.stale.value]).toEqual(["lost", true]);
    newest().greet("stopped");
    expect([stream.connection.value, stream.stale.value]).toEqual(["open", false]);
  });

  test("of a device that does not run is asked for less and less often where only streams are answered", () => {
    newest().greet("stopped");
    serverReached.value = false;
    for (let seconds = 0; seconds < 60; seconds += 0.1) {
      vi.advanceTimersByTime(100);
      if (!newest().closed) newest().greet("stopped");
      expect(stream.stale.value).toBe(true);
    }
    expect(FakeSocket.made.length).toBeLessThan(30);
  });

  test("of a device that runs is judged by its frames alone", () => {
    newest().greet();
    serverReached.value = false;
    sendFrames(10_000);
    expect([stream.connection.value, stream.stale.value, FakeSocket.made.length]).toEqual(["open", false, 1]);
  });

  test("of a device that exposes rarely is given time for it", () => {
    newest().greet("running", 0.2);
    vi.advanceTimersByTime(6000);
    expect([stream.connection.value, stream.stale.value]).toEqual(["open", false]);
    vi.advanceTimersByTime(7000);
    expect(FakeSocket.made.length).toBe(2);
  });

  test("whose connection hangs is tried again, less and less often", () => {
    vi.advanceTimersByTime(5000);
    expect(FakeSocket.made).toHaveLength(1);
    vi.advanceTimersByTime(500);
    expect([stream.connection.value, FakeSocket.made.length]).toEqual(["lost", 2]);
    expect(FakeSocket.made[0]?.closed).toBe(true);
    // Accepted and never greeted: given up, too.
    newest().onopen?.();
    vi.advanceTimersByTime(6000);
    expect(FakeSocket.made).toHaveLength(3);
    vi.advanceTimersByTime(60_000);
    expect(FakeSocket.made.length).toBeLessThan(12);
  });

  test("that the server ended is not opened again", () => {
    newest().greet();
    newest().onclose?.({ code: 1008, reason: "the key was revoked" });
    expect([stream.connection.value, stream.reason.value]).toEqual(["refused", "the key was revoked"]);
    vi.advanceTimersByTime(60_000);
    expect(FakeSocket.made).toHaveLength(1);
  });

  test("of a hidden page ends, and of one shown again is old until the server greets", () => {
    newest().greet();
    sendFrames(100);
    show("hidden");
    expect([stream.connection.value, stream.stale.value, newest().closed]).toEqual(["paused", true, true]);
    vi.advanceTimersByTime(60_000);
    expect(FakeSocket.made).toHaveLength(1);
    show("visible");
    expect([stream.connection.value, stream.stale.value, FakeSocket.made.length]).toEqual(["connecting", true, 2]);
    newest().greet();
    expect(stream.frame.value).toBeNull();
    sendFrames(50);
    expect([stream.connection.value, stream.stale.value]).toEqual(["open", false]);
  });
});
