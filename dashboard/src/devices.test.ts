import { beforeEach, expect, test, vi } from "vitest";
import type { Device } from "./devices";

const stored = new Map<string, string>();
const [sim, bar] = [{ id: "sim" } as Device, { id: "bar" } as Device];

async function load(): Promise<typeof import("./devices")> {
  vi.resetModules();
  return import("./devices");
}

beforeEach(() => {
  stored.clear();
  vi.stubGlobal("sessionStorage", {
    getItem: (name: string) => stored.get(name) ?? null,
    setItem: (name: string, value: string) => void stored.set(name, value),
  });
});

test("before the server has said which devices there are none is shown, and none is missing", async () => {
  stored.set("lumiline.device", "bar");
  const { device, devices, missing, setDevices } = await load();
  expect([devices.value, device.value, missing.value]).toEqual([null, null, null]);
  setDevices([sim, bar]);
  expect([device.value, missing.value]).toEqual([bar, null]);
}, 60_000);

test("where none was chosen the first is, and stays it when another comes before it", async () => {
  const { device, setDevices } = await load();
  setDevices([sim]);
  setDevices([bar, sim]);
  expect(device.value).toEqual(sim);
}, 60_000);

test("no other device takes the place of a chosen one that is gone, until a person chooses", async () => {
  const { choose, device, missing, setDevices } = await load();
  setDevices([sim, bar]);
  choose("bar");
  setDevices([sim]);
  expect([device.value, missing.value]).toEqual([null, "bar"]);
  choose("sim");
  expect([device.value, missing.value]).toEqual([sim, null]);
}, 60_000);

test("where there are no devices at all none is missing", async () => {
  const { device, missing, setDevices } = await load();
  setDevices([sim]);
  setDevices([]);
  expect([device.value, missing.value]).toEqual([null, null]);
}, 60_000);
