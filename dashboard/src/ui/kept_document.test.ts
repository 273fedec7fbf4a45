import { signal } from "@preact/signals";
import { expect, test, vi } from "vitest";

vi.stubGlobal("sessionStorage", { getItem: () => null });
vi.stubGlobal("location", new URL("http://localhost/"));

const { RequestFailed } = await import("../api/client");
const { whileKnown } = await import("./kept_document");

const gone = () => Promise.reject(new RequestFailed(404, null, "there is none"));

test("without an id nothing is asked for", async () => {
  const get = vi.fn();
  expect(await whileKnown(signal<string | null>(null), get)).toBeNull();
  expect(get).not.toHaveBeenCalled();
});

test("an id that the server knows no more is forgotten", async () => {
  const id = signal<string | null>("old");
  expect(await whileKnown(id, gone)).toBeNull();
  expect(id.value).toBeNull();
});

test("what was begun meanwhile is kept", async () => {
  const id = signal<string | null>("old");
  const answer = whileKnown(id, gone);
  id.value = "new";
  expect(await answer).toBeNull();
  expect(id.value).toBe("new");
});

test("another failure is the caller's", async () => {
  const id = signal<string | null>("old");
  await expect(whileKnown(id, () => Promise.reject(new RequestFailed(503, null, "busy")))).rejects.toThrow("busy");
  expect(id.value).toBe("old");
});
