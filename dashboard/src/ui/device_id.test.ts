import { describe, expect, test } from "vitest";
import { newDeviceId } from "./device_id";

/** What the server takes as an id. */
const SLUG = /^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$/;

describe("id of a new device", () => {
  test("is made of the name", () => {
    expect(newDeviceId("replay-Bar_2031.05/run.h5", new Set())).toBe("replay-bar-2031-05-run-h5");
  });

  test("names that become the same id get different ones", () => {
    const taken = new Set<string>();
    for (const name of ["a_b", "a-b", "A b", "a__b"]) taken.add(newDeviceId(name, taken));
    expect([...taken]).toEqual(["a-b", "a-b-2", "a-b-3", "a-b-4"]);
  });

  test.each(["x".repeat(200), `${"x".repeat(62)}_y`, `${"x".repeat(60)}_y`, "_", "", "-a-", "éé", "<b>"])("of %j is valid, the twelfth too", (name) => {
    const taken = new Set<string>();
    for (let count = 0; count < 12; count += 1) {
      const id = newDeviceId(name, taken);
      expect(id).toMatch(SLUG);
      expect(taken).not.toContain(id);
      taken.add(id);
    }
  });
});
