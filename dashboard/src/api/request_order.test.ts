import { expect, test } from "vitest";
import { RequestOrder } from "./request_order";

test("a late answer to an older request counts no more", () => {
  const order = new RequestOrder();
  const [first, second, third] = [order.begin(), order.begin(), order.begin()];
  expect(order.isNewest(second)).toBe(true);
  expect(order.isNewest(first)).toBe(false);
  expect(order.isNewest(third)).toBe(true);
  expect(order.isNewest(second)).toBe(false);
});

test("answers in the order of their requests all count", () => {
  const order = new RequestOrder();
  const [first, second] = [order.begin(), order.begin()];
  expect([order.isNewest(first), order.isNewest(second)]).toEqual([true, true]);
});
