import { beforeEach, expect, test, vi } from "vitest";

const stored = new Map<string, string>();

beforeEach(() => {
  stored.clear();
  vi.resetModules();
  vi.stubGlobal("sessionStorage", {
    getItem: (name: string) => stored.get(name) ?? null,
    setItem: (name: string, value: string) => void stored.set(name, value),
    removeItem: (name: string) => void stored.delete(name),
  });
});

test("a choice is the same signal for all who ask, one for each name", async () => {
  const { keptSignal } = await import("./kept");
  keptSignal("capture sim").value = "c-1";
  expect(keptSignal("capture sim").value).toBe("c-1");
  expect(keptSignal("capture bar").value).toBeNull();
});

test("a page that is loaded again finds it, until it is given up", async () => {
  (await import("./kept")).keptSignal("capture sim").value = "c-1";
  vi.resetModules();
  const again = (await import("./kept")).keptSignal("capture sim");
  expect(again.value).toBe("c-1");
  again.value = null;
  vi.resetModules();
  expect((await import("./kept")).keptSignal("capture sim").value).toBeNull();
});
