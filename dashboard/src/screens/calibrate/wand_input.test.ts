import { expect, test } from "vitest";
import { directions, wand } from "./wand_input";

test("positions and strobe numbers are read with any separator", () => {
  expect(wand("0, 300", "0,1")).toEqual({ position_mm: [0, 300], markers: [0, 1] });
  expect(wand("-150; 10.5 150", "4 5 6")).toEqual({ position_mm: [-150, 10.5, 150], markers: [4, 5, 6] });
});

test("what makes no wand is refused with what to change", () => {
  expect(() => wand("300", "0")).toThrow("two markers");
  expect(() => wand("0 300", "0")).toThrow("2 markers and 1 strobe numbers");
  expect(() => wand("0 300", "0 1.5")).toThrow('"1.5"');
  expect(() => wand("0 long", "0 1")).toThrow('"long"');
});

test("directions are of all sensors or of none", () => {
  const sensors = ["one", "two"];
  expect(directions({}, sensors)).toBeNull();
  expect(directions({ one: " 90", two: "-45" }, sensors)).toEqual({ one: 90, two: -45 });
  expect(() => directions({ one: "90" }, sensors)).toThrow("two");
});
