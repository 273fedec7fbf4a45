import { describe, expect, test } from "vitest";
import { kindOf, remoteStations, type Station } from "./stations";

const station = (name: string | null, state: Station["state"]): Station => ({
  name,
  state,
  reason: null,
  changed_at: null,
  host: null,
  devices: 1,
  restarts: 0,
  messages_missed: 0,
  memory_bytes: 0,
  cpu_s: 0,
  round_trip_ms: null,
});

describe("stations", () => {
  test("of other machines are shown, and those that are lost first", () => {
    const all = [station(null, "running"), station("b", "running"), station("a", "running"), station("c", "lost"), station("d", "limited")];
    expect(remoteStations(all).map(({ name }) => name)).toEqual(["c", "d", "a", "b"]);
  });
  test("of a server without a bus are none", () => {
    expect(remoteStations([station(null, "running")])).toEqual([]);
  });
  test("that are lost are bad, and those that run are good", () => {
    expect(kindOf(station("a", "lost"))).toBe("bad");
    expect(kindOf(station("a", "limited"))).toBe("idle");
    expect(kindOf(station("a", "running"))).toBe("good");
  });
});
