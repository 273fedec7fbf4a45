import { expect, test } from "vitest";
import { following, slotsOf } from "./entries";

test.each([
  ["0, 1, 2, 3", [0, 1, 2, 3]],
  ["4;7;9", [4, 7, 9]],
  ["10 11\t12", [10, 11, 12]],
])("strobe slots %j", (entered, slots) => {
  expect(slotsOf(entered)).toEqual(slots);
});

test.each(["", "0, 1", "0, 1, x", "0, 1, -2", "0, 1, 2.5"])("strobe slots %j are refused in words", (entered) => {
  expect(() => slotsOf(entered)).toThrow("strobe slots, such as");
});

test.each([["1", "2"], ["P9", "P10"], ["left 3", "left 4"], ["nose", ""], ["", ""]])("after the name %j comes %j", (name, next) => {
  expect(following(name)).toBe(next);
});
