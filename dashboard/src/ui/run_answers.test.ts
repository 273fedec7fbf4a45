import { expect, test } from "vitest";
import type { Schemas } from "../api/client";
import { untilEnded } from "./run_answers";

type Run = Schemas["Run"];

test("a run is asked for until it has ended, another one anew", async () => {
  const states: Record<string, Run["state"][]> = { a: ["queued", "running", "failed"], b: ["succeeded"] };
  const asked: string[] = [];
  const get = untilEnded((id) => {
    asked.push(id);
    return Promise.resolve({ id, state: states[id]?.shift() } as Run);
  });
  const seen: Run["state"][] = [];
  for (const id of ["a", "a", "a", "a", "a", "b", "b"]) seen.push((await get(id)).state);
  expect(seen).toEqual(["queued", "running", "failed", "failed", "failed", "succeeded", "succeeded"]);
  expect(asked).toEqual(["a", "a", "a", "b"]);
});

test("what could not be asked is asked for again", async () => {
  let fails = true;
  const get = untilEnded((id) => (fails ? Promise.reject(new Error("busy")) : Promise.resolve({ id, state: "running" } as Run)));
  await expect(get("a")).rejects.toThrow("busy");
  fails = false;
  expect((await get("a")).state).toBe("running");
});
