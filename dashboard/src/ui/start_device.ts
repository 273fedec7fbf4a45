/** Starting a device that others may use already. */

import { api, sent } from "../api/client";

const STOPPED: readonly string[] = ["stopped", "failed", "ended"];

/** Start a device, unless it runs or is about to: a start would break the recordings and captures of others. */
export async function startUnlessRunning(id: string): Promise<void> {
  const params = { path: { device_id: id } };
  const { state } = await sent(api.GET("/api/v1/devices/{device_id}/state", { params }));
  if (STOPPED.includes(state)) await sent(api.POST("/api/v1/devices/{device_id}/start", { params }));
}
