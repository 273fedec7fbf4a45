import { expect, test } from "vitest";
import { sinceTime } from "./format";

test("a time has its date where that is not today's", () => {
  const now = new Date(2031, 4, 6, 0, 10);
  const ago = (minutes: number) => now.getTime() - 60_000 * minutes;
  expect(sinceTime(ago(5), now)).toBe(new Date(ago(5)).toLocaleTimeString());
  expect(sinceTime(ago(15), now)).toContain("2031");
  expect(sinceTime(ago(24 * 60), now)).toContain("2031");
});
