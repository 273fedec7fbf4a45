/** The stream's messages. */

import { decode } from "@msgpack/msgpack";
import type { Schemas } from "../api/client";

export type Hello = Schemas["StreamHello"] & { type: "hello" };
export type Frame = Schemas["StreamFrame"] & { type: "frame" };
export type DeviceState = Schemas["StreamDeviceState"] & { type: "state" };
export type HoldEvent = Schemas["StreamBeamHoldEvent"] & { type: "hold" };
export type Missed = Schemas["StreamMissed"] & { type: "missed" };
export type Message = Hello | Frame | DeviceState | HoldEvent | Missed;
export type Point = Schemas["StreamPoint"];
export type Track = Schemas["StreamTrack"];
export type ToolPose = Schemas["StreamToolPose"];
export type HoldSample = Schemas["StreamBeamHoldSample"];

/** Times in ns since 1970 need 61 bits; a number would lose the last 200 ns. */
export type Nanoseconds = number | bigint;

const KNOWN = new Set(["hello", "frame", "state", "hold", "missed"]);

/** Return the message of a payload; null where it is of a type that this page does not know. */
export function decodeMessage(payload: ArrayBuffer): Message | null {
  const message = decode(new Uint8Array(payload), { useBigInt64: true }) as { type?: unknown };
  return typeof message.type === "string" && KNOWN.has(message.type) ? (message as Message) : null;
}

/** Return a time in ms since 1970. */
export function toMilliseconds(time: Nanoseconds): number {
  return typeof time === "bigint" ? Number(time / 1000n) / 1000 : time / 1e6;
}
