/** The newest data of one device, over a websocket that comes back by itself. */

import { batch, effect, type Signal, signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { key } from "../api/key";
import { serverReached } from "../api/session";
import { decodeMessage, type Frame, type Hello, type HoldSample, type Message } from "./messages";
import { visible } from "./visibility";

export type Content = "points" | "peaks" | "tracks" | "tools" | "holds";
/** `connecting`: not greeted by the server yet; `paused`: the page is hidden; `lost`: the connection broke and is being
 * opened again. */
export type Connection = "connecting" | "open" | "lost" | "paused" | "refused";

const FIRST_RETRY_MS = 250;
const MAX_RETRY_MS = 4000;
/** The code with which the server ends a stream whose key was revoked or has expired. */
const REFUSED = 1008;
const CHECK_MS = 100;
/** Without a message for so long, what is shown is old: with the next check it is said within a second. */
const STALE_AFTER_MS = 800;
/** A connection that is silent, or not open, for so long is given up: one whose other end is gone never closes by itself. */
const SILENT_MS = 5000;
/** A device that exposes more slowly is waited for as many of its exposures. */
const PATIENCE = 2.5;

export class DeviceStream {
  readonly connection: Signal<Connection> = signal<Connection>("connecting");
  readonly hello: Signal<Hello | null> = signal<Hello | null>(null);
  readonly frame: Signal<Frame | null> = signal<Frame | null>(null);
  readonly state: Signal<string | null> = signal<string | null>(null);
  readonly reason: Signal<string | null> = signal<string | null>(null);
  readonly holds: Signal<ReadonlyMap<string, HoldSample>> = signal(new Map());
  /** Whether frames ought to come and do not, or the connection is lost, or may be: without frames, the server's answers to
   * requests alone tell that it is there. */
  readonly stale: Signal<boolean> = signal(false);
  /** Frames that this page received. */
  received = 0;

  private socket: WebSocket | null = null;
  private retryMs = FIRST_RETRY_MS;
  private retry: ReturnType<typeof setTimeout> | undefined;
  private check: ReturnType<typeof setInterval> | undefined;
  private lastFrameMs = 0;
  /** Checks since the last sign of life. They are counted, not timed: while the page is too busy to check, messages that
   * have arrived wait to be read. */
  private silentChecks = 0;
  private exposureMs = 0;
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
      batch(() => {
        this.connection.value = open ? "connecting" : "paused";
        // What was shown before is old until the server greets again; at first nothing is shown.
        this.stale.value = this.hello.peek() !== null;
      });
      if (open) this.connect(used);
    });
  }

  close(): void {
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
    this.silentChecks = 0;
    socket.onopen = () => {
      if (this.socket === socket) this.silentChecks = 0;
    };
    socket.onmessage = (event: MessageEvent<ArrayBuffer>) => {
      if (this.socket !== socket) return;
      const message = decodeMessage(event.data);
      if (message) this.take(message);
    };
    socket.onclose = (event) => {
      if (this.socket !== socket) return;
      if (event.reason) this.reason.value = event.reason;
      if (event.code === REFUSED) this.end("refused");
      else this.reconnect(used);
    };
    this.check ??= setInterval(() => this.watch(used), CHECK_MS);
  }

  /** Say that the connection is lost, and open another after a while. */
  private reconnect(used: string | null): void {
    this.end("lost");
    this.retry = setTimeout(() => this.connect(used), this.next());
  }

  private end(connection: Connection): void {
    const socket = this.socket;
    // First: what it says from now on, its end above all, counts no more.
    this.socket = null;
    socket?.close();
    batch(() => {
      this.connection.value = connection;
      this.stale.value = true;
    });
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

  private watch(used: string | null): void {
    const open = this.connection.value === "open";
    this.stale.value = !open || this.late();
    if (this.socket === null) return;
    if (open && !this.running()) {
      // A device that does not run has nothing to say. Where the server answers nothing else, the connection may be gone,
      // too, and would not come back by itself with the server.
      if (!serverReached.peek()) this.reconnect(used);
      return;
    }
    this.silentChecks += 1;
    if (this.silentChecks * CHECK_MS > Math.max(SILENT_MS, open ? this.exposureMs : 0)) this.reconnect(used);
  }

  private running(): boolean {
    return this.content.length > 0 && this.state.value === "running";
  }

  private late(): boolean {
    if (!this.running()) return !serverReached.peek();
    return performance.now() - this.lastFrameMs > Math.max(STALE_AFTER_MS, this.exposureMs);
  }

  private take(message: Message): void {
    // A greeting that comes again is no frame: what is silent stays so until there is one.
    if (message.type !== "hello" || this.hello.value === null) this.lastFrameMs = performance.now();
    this.silentChecks = 0;
    // Only now: one who accepts connections and says nothing, here or to requests, is not asked more often for that.
    if (serverReached.peek()) this.retryMs = FIRST_RETRY_MS;
    if ((message.type === "hello" || message.type === "state") && message.frame_rate_hz)
      this.exposureMs = (PATIENCE * 1000) / message.frame_rate_hz;
    batch(() => {
      this.connection.value = "open";
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
      this.stale.value = this.late();
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
