/** The newest scans of a device, asked for one after another while they are looked at. */

import { useSignal, useSignalEffect, type Signal } from "@preact/signals";
import { useRef } from "preact/hooks";
import { api, RequestFailed, sent } from "../../api/client";
import { openSession } from "../../api/session";
import { visible } from "../../live/visibility";
import type { Scans } from "./scan_data";

/** The server waits for an exposure, so a slow device is not asked more often than it exposes. */
const INTERVAL_MS = 200;
const RETRY_MS = 1000;
const BUSY = 503;

export interface LiveScans {
  readonly scans: Signal<Scans | null>;
  /** Why there is nothing newer: what is shown is old. */
  readonly error: Signal<string | null>;
  readonly frozen: Signal<boolean>;
  /** The sensor whose fits are asked for. */
  readonly sensor: Signal<string>;
  /** Only exposures of this strobed marker; null: of any. */
  readonly marker: Signal<number | null>;
  /** Ask for one exposure more, though frozen. */
  readonly next: () => Promise<void>;
}

/** Another device needs another component (a key). */
export function useLiveScans(device: string, firstSensor: string): LiveScans {
  const scans = useSignal<Scans | null>(null);
  const error = useSignal<string | null>(null);
  const frozen = useSignal(false);
  const sensor = useSignal(firstSensor);
  const marker = useSignal<number | null>(null);
  const newest = useRef(0);

  const load = async (signal?: AbortSignal): Promise<boolean> => {
    const turn = ++newest.current;
    const query = { detail_sensor: sensor.value, ...(marker.value === null ? {} : { marker: marker.value }) };
    try {
      const found = await sent(
        api.GET("/api/v1/devices/{device_id}/scans", {
          params: { path: { device_id: device }, query },
          ...(signal ? { signal } : {}),
        }),
      );
      if (signal?.aborted || turn !== newest.current) return true;
      scans.value = found;
      error.value = null;
      return true;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      if (signal?.aborted || turn !== newest.current) return true;
      if (failure.status === BUSY) return false; // others look, too: a moment later then
      error.value = failure.message;
      if (failure.status === 401) await openSession();
      return false;
    }
  };

  useSignalEffect(() => {
    // Read here: another sensor or marker begins anew, without waiting for the answer before.
    void sensor.value;
    void marker.value;
    if (!visible.value || frozen.value) return undefined;
    const ending = new AbortController();
    const follow = async () => {
      while (!ending.signal.aborted) {
        const begin = performance.now();
        const good = await load(ending.signal);
        const pause = good ? INTERVAL_MS - (performance.now() - begin) : RETRY_MS;
        await new Promise((resolve) => setTimeout(resolve, Math.max(0, pause)));
      }
    };
    void follow();
    return () => ending.abort();
  });
  return { scans, error, frozen, sensor, marker, next: async () => void (await load()) };
}
