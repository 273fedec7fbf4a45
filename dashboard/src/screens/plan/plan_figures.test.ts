import { describe, expect, test } from "vitest";
import { contributions, difference, type Figure, length } from "./plan_figures";

const figure = (value: number | null, less = true, unit = "mm"): Figure => ({ name: "x", value, unit, less });

describe("difference", () => {
  test.each([
    ["smaller error", figure(1), figure(0.5), "good", "−50.0 %"],
    ["larger error", figure(1), figure(2), "bad", "+100 %"],
    ["more coverage", figure(50, false, "%"), figure(80, false, "%"), "good", "+30.0 %"],
    ["from nothing", figure(0), figure(2), "bad", "+2.00 mm"],
    ["the same", figure(1), figure(1), "idle", "same"],
    ["less than chance", { ...figure(10), sigma: 3 }, { ...figure(12), sigma: 3 }, "idle", "within the error"],
    ["no positions any more", figure(1), figure(null), "bad", "–"],
    ["none before or after", figure(null), figure(null), "idle", "same"],
  ])("%s", (_, before, after, kind, words) => {
    const found = difference(before, after);
    expect(found.kind).toBe(kind);
    expect(found.words.replace(/\.0+ /, " ").replace(/2\.00/, "2")).toBe(words.replace(/\.0+ /, " ").replace(/2\.00/, "2"));
  });
});

test("length of nothing is nothing", () => {
  expect(length(null)).toBeNull();
  expect(length([3, 4, 0])).toBe(5);
});

test("contributions that do not count are left out, the largest comes first", () => {
  const one = (name: string, counted: boolean, share: number) => ({ name, kind: "random", counted, share, rms_mm: 1, assumed: false });
  const plan = { budget: { contributions: [one("small", true, 0.1), one("large", true, 0.9), one("other", false, 0.5)] } } as never;
  expect(contributions(plan).map(({ name }) => name)).toEqual(["large", "small"]);
  expect(contributions({ budget: null } as never)).toEqual([]);
});
