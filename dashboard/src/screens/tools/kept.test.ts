import { expect, test } from "vitest";
import { keptByDevice } from "./kept";

test("each device has a signal of its own, the same each time", () => {
  const kept = keptByDevice<readonly number[]>(() => []);
  kept("a").value = [1];
  expect(kept("a").value).toEqual([1]);
  expect(kept("b").value).toEqual([]);
  kept("constructor").value = [2];
  expect(kept("constructor").value).toEqual([2]);
});
