/** The nominal calibration of a device that is simulated from a profile: stored once, and activated. */

import { api, RequestFailed, sent } from "../api/client";
import type { Operation } from "../api/session";

/** What the button does: both must be allowed. */
export const NOMINAL_OPERATIONS: readonly Operation[] = ["POST /api/v1/nominal-calibrations", "POST /api/v1/calibrations/{calibration_id}/activate"];

/** Make the calibration of the device's profile as its file is now, where there is none yet, and activate it. */
export async function useNominal(device: string, profile: string): Promise<void> {
  const [{ content_hash: hash }, known] = await Promise.all([
    sent(api.GET("/api/v1/device-profiles/{profile_id}", { params: { path: { profile_id: profile } } })),
    sent(api.GET("/api/v1/calibrations", { params: { query: { device_id: device, limit: 100 } } })),
  ]);
  const before = known.items.find((one) => one.state !== "retired" && one.profile?.profile_id === profile && one.profile.content_hash === hash);
  const id = before?.id ?? (await sent(api.POST("/api/v1/nominal-calibrations", { body: { device_id: device } }))).id;
  await sent(api.POST("/api/v1/calibrations/{calibration_id}/activate", { params: { path: { calibration_id: id } } }));
}

/** Do the same where it can be; else return the server's words why not: the device runs all the same. */
export async function tryNominal(device: string, profile: string): Promise<string | null> {
  try {
    await useNominal(device, profile);
    return null;
  } catch (failure) {
    if (failure instanceof RequestFailed) return failure.message;
    throw failure;
  }
}
