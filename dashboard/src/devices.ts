/** The devices, and the one that the screens show. */

import { computed, signal } from "@preact/signals";
import { api, type Schemas, sent } from "./api/client";

export type Device = Schemas["Device"];

export const devices = signal<readonly Device[]>([]);

const chosen = signal<string | null>(sessionStorage.getItem("lumiline.device"));

/** The device that is shown: the chosen one, or the first. */
export const device = computed(
  () => devices.value.find((one) => one.id === chosen.value) ?? devices.value[0] ?? null,
);

export function choose(id: string): void {
  sessionStorage.setItem("lumiline.device", id);
  chosen.value = id;
}

export async function loadDevices(): Promise<readonly Device[]> {
  const page = await sent(api.GET("/api/v1/devices", { params: { query: { limit: 100 } } }));
  if (JSON.stringify(page.items) !== JSON.stringify(devices.value)) devices.value = page.items;
  return page.items;
}
