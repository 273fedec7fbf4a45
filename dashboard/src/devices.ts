/** The devices, and the one that the screens show. */

import { batch, computed, signal } from "@preact/signals";
import { api, type Schemas, sent } from "./api/client";
import { RequestOrder } from "./api/request_order";

export type Device = Schemas["Device"];

/** Null: the server has not said yet. */
export const devices = signal<readonly Device[] | null>(null);

const chosen = signal<string | null>(sessionStorage.getItem("lumiline.device"));

/** The device that is shown: the chosen one, and no other in its place, on which a person would act unaware. */
export const device = computed(() => devices.value?.find((one) => one.id === chosen.value) ?? null);

/** The chosen device where it is no longer there but others are: a person chooses one of them. */
export const missing = computed(() => (devices.value?.length && !device.value ? chosen.value : null));

export function choose(id: string): void {
  sessionStorage.setItem("lumiline.device", id);
  chosen.value = id;
}

const order = new RequestOrder();

export async function loadDevices(): Promise<readonly Device[]> {
  const number = order.begin();
  const page = await sent(api.GET("/api/v1/devices", { params: { query: { limit: 100 } } }));
  // An older answer lacks the device that was made, and chosen, meanwhile.
  if (order.isNewest(number)) setDevices(page.items);
  return page.items;
}

/** Take the devices that there are. Until one is chosen, the first is. */
export function setDevices(found: readonly Device[]): void {
  batch(() => {
    if (JSON.stringify(found) !== JSON.stringify(devices.value)) devices.value = found;
    chosen.value ??= found[0]?.id ?? null;
  });
}
