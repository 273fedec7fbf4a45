/** The newest scans of a device, asked for one after another while they are looked at. */

import { effect, signal, type Signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, sent } from "../../api/client";
import { RequestOrder } from "../../api/request_order";
import { openSession } from "../../api/session";
import { visible } from "../../live/visibility";
import { text } from "../../text";
import type { Scans } from "./scan_data";

/** The server waits for an exposure, so a slow device is not asked more often than it exposes. */
const INTERVAL_MS = 200;
const RETRY_MS = 1000;
/** Others look, too: a moment later there is room. */
const BUSY_RETRY_MS = 250;
const BUSY = 503;
/** Longer than the server waits for an exposure (5 s): then it says why there was none. */
const LIMIT_MS = 7000;
const CHECK_MS = 100;
/** Without a newer answer for so long, what is shown is old: with the next check it is said after a second. */
const OLD_AFTER_MS = 900;

export interface ScansQuery {
  readonly detail_sensor: string;
  readonly marker?: number;
}

export class LiveScans {
  readonly scans: Signal<Scans | null> = signal<Scans | null>(null);
  /** Why there is nothing newer: what is shown is old. */
  readonly error: Signal<string | null> = signal<string | null>(null);
  readonly frozen: Signal<boolean> = signal(false);
  /** The sensor whose fits are asked for. */
  readonly sensor: Signal<string>;
  /** Only exposures of this strobed marker; null: of any. */
  readonly marker: Signal<number | null> = signal<number | null>(null);
  private readonly order = new RequestOrder();
  private answeredMs = performance.now();
  /** The newest failure, in the server's words. */
  private reason: string | null = null;
  readonly close: () => void;

  constructor(
    firstSensor: string,
    private readonly load: (query: ScansQuery, signal: AbortSignal) => Promise<Scans>,
  ) {
    this.sensor = signal(firstSensor);
    this.close = effect(() => {
      // Another sensor or marker begins anew, without waiting for the answer before.
      void this.sensor.value;
      void this.marker.value;
      if (!visible.value || this.frozen.value) return undefined;
      const ending = new AbortController();
      const check = setInterval(() => this.check(), CHECK_MS);
      void this.follow(ending.signal);
      return () => {
        clearInterval(check);
        ending.abort();
      };
    });
  }

  /** Ask for one exposure more, though frozen. */
  async next(): Promise<void> {
    await this.ask(AbortSignal.timeout(LIMIT_MS), () => false);
    this.error.value = this.reason;
  }

  private async follow(ending: AbortSignal): Promise<void> {
    // The effect that calls this is not to depend on what is read here.
    await Promise.resolve();
    while (!ending.aborted) {
      const begin = performance.now();
      const retry = await this.ask(AbortSignal.any([ending, AbortSignal.timeout(LIMIT_MS)]), () => ending.aborted);
      const pause = retry ?? INTERVAL_MS - (performance.now() - begin);
      await new Promise((resolve) => setTimeout(resolve, Math.max(0, pause)));
    }
  }

  /** Ask once. Return after what time to ask again [ms]; null: it was answered. */
  private async ask(signal: AbortSignal, ended: () => boolean): Promise<number | null> {
    const number = this.order.begin();
    const marker = this.marker.value;
    try {
      const found = await this.load({ detail_sensor: this.sensor.value, ...(marker === null ? {} : { marker }) }, signal);
      if (ended() || !this.order.isNewest(number)) return null;
      this.scans.value = found;
      this.answeredMs = performance.now();
      this.reason = this.error.value = null;
      return null;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      if (ended() || !this.order.isNewest(number)) return null;
      this.reason = failure.message;
      if (failure.status === BUSY) return BUSY_RETRY_MS;
      this.error.value = failure.message;
      if (failure.status === 401) await openSession();
      return RETRY_MS;
    }
  }

  private check(): void {
    if (performance.now() - this.answeredMs > OLD_AFTER_MS) this.error.value = this.reason ?? text.scans.silent;
  }
}

/** Another device needs another component (a key). */
export function useLiveScans(device: string, firstSensor: string): LiveScans {
  const held = useRef<LiveScans | null>(null);
  held.current ??= new LiveScans(firstSensor, (query, signal) =>
    sent(api.GET("/api/v1/devices/{device_id}/scans", { params: { path: { device_id: device }, query }, signal })),
  );
  const live = held.current;
  useEffect(() => live.close, []);
  return live;
}
