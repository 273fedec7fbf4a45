/** The newest data of one device, over a websocket that comes back by itself. */

import { batch, effect, type Signal, signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { key } from "../api/key";
import { decodeMessage, type Frame, type Hello, type HoldSample, type Message } from "./messages";
import { visible } from "./visibility";

export type Content = "points" | "peaks" | "tracks" | "tools" | "holds";
/** `paused`: the page is hidden; `lost`: the connection broke and is being opened again. */
export type Connection = "connecting" | "open" | "lost" | "paused" | "refused";

const FIRST_RETRY_MS = 250;
const MAX_RETRY_MS = 4000;
const CHECK_MS = 200;
/** Without a message for so long, what is shown is old. */
export const STALE_AFTER_MS = 800;

export class DeviceStream {
  readonly connection: Signal<Connection> = signal<Connection>("connecting");
  readonly hello: Signal<Hello | null> = signal<Hello | null>(null);
  readonly frame: Signal<Frame | null> = signal<Frame | null>(null);
  readonly state: Signal<string | null> = signal<string | null>(null);
  readonly reason: Signal<string | null> = signal<string | null>(null);
  readonly holds: Signal<ReadonlyMap<string, HoldSample>> = signal(new Map());
  /** Whether frames ought to come and do not, or the connection is lost. */
  readonly stale: Signal<boolean> = signal(false);
  /** Frames that this page received. */
  received = 0;

  private socket: WebSocket | null = null;
  private retryMs = FIRST_RETRY_MS;
  private retry: ReturnType<typeof setTimeout> | undefined;
  private check: ReturnType<typeof setInterval> | undefined;
  private lastMessageMs = 0;
  private closed = false;
  private readonly dispose: () => void;

  constructor(
    readonly device: string,
    private readonly content: readonly Content[],
    private readonly rateHz: number,
  ) {
    this.dispose = effect(() => {
      // A hidden page ends its stream: messages would arrive all the same.
      const open = visible.value;
      const used = key.value;
      this.disconnect();
      if (open) this.connect(used);
      else this.connection.value = "paused";
    });
  }

  close(): void {
    this.closed = true;
    this.dispose();
    this.disconnect();
  }

  private connect(used: string | null): void {
    const query = new URLSearchParams({ device_id: this.device });
    query.set("content", this.content.length ? this.content.join(",") : "state");
    if (this.content.length) query.set("rate_hz", String(this.rateHz));
    const address = new URL(`/api/v1/stream?${query}`, location.href);
    address.protocol = address.protocol.replace("http", "ws");
    const protocols = ["lumiline.v1", ...(used ? [`lumiline.bearer.${used}`] : [])];
    const socket = new WebSocket(address, protocols);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    let opened = false;
    socket.onopen = () => {
      opened = true;
      this.retryMs = FIRST_RETRY_MS;
      this.lastMessageMs = performance.now();
    };
    socket.onmessage = (event: MessageEvent<ArrayBuffer>) => {
      if (this.socket !== socket) return;
      const message = decodeMessage(event.data);
      if (message) this.take(message);
    };
    socket.onclose = (event) => {
      if (this.socket !== socket || this.closed) return;
      this.socket = null;
      batch(() => {
        this.connection.value = event.code === 1008 ? "refused" : "lost";
        if (event.reason) this.reason.value = event.reason;
        this.stale.value = true;
      });
      if (!opened || event.code !== 1008) this.retry = setTimeout(() => this.connect(used), this.next());
    };
    this.check ??= setInterval(() => this.watch(), CHECK_MS);
  }

  private next(): number {
    const wait = this.retryMs * (0.75 + Math.random() / 2);
    this.retryMs = Math.min(MAX_RETRY_MS, 2 * this.retryMs);
    return wait;
  }

  private disconnect(): void {
    clearTimeout(this.retry);
    clearInterval(this.check);
    this.check = undefined;
    const socket = this.socket;
    this.socket = null;
    socket?.close();
  }

  private watch(): void {
    const waited = performance.now() - this.lastMessageMs;
    const streams = this.content.length > 0 && this.state.value === "running";
    const late = streams && waited > STALE_AFTER_MS;
    this.stale.value = this.connection.value !== "open" || late;
  }

  private take(message: Message): void {
    this.lastMessageMs = performance.now();
    batch(() => {
      this.connection.value = "open";
      this.stale.value = false;
      switch (message.type) {
        case "hello":
          this.hello.value = message;
          this.state.value = message.state;
          this.reason.value = message.reason;
          this.frame.value = null;
          if (message.holds) this.setHolds(message.holds);
          break;
        case "frame":
          this.received += 1;
          this.frame.value = message;
          if (message.holds) this.setHolds(message.holds);
          break;
        case "state":
          this.state.value = message.state;
          this.reason.value = message.reason;
          if (message.state !== "running") this.frame.value = null;
          break;
        case "hold":
          this.holds.value = new Map(this.holds.value).set(message.hold_id, message);
          break;
        case "missed":
          break;
      }
    });
  }

  private setHolds(holds: readonly HoldSample[]): void {
    this.holds.value = new Map(holds.map((hold) => [hold.hold_id, hold]));
  }
}

/** Return a stream of a device that is open as long as the component is shown; another device needs
 * another component (a key). */
export function useDeviceStream(device: string, content: readonly Content[], rateHz: number): DeviceStream {
  const held = useRef<DeviceStream | null>(null);
  held.current ??= new DeviceStream(device, content, rateHz);
  const stream = held.current;
  useEffect(() => () => stream.close(), []);
  return stream;
}
