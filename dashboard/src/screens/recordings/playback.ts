/** A recording as it is played: which frame is due, and frames as the scene takes them. */

import type { Schemas } from "../../api/client";
import type { Frame } from "../../live/messages";

export type Recording = Schemas["RecordingDocument"];
type RecordedFrame = Schemas["RecordedFrame"];
type Detail = Schemas["RecordingDetail"];

export const SPEEDS = [0.01, 0.1, 0.25, 0.5, 1, 2, 5, 10] as const;
/** Frames that make one picture: a strobed frame shows one marker only. */
export const SPAN = 32;
/** Time from one picture to the next of a playing recording. */
export const PICTURE_MS = 100;
/** Frames from one picture to the next where the server is slow. */
const MAX_STEP = 256;

/** Return the mean rate of a recording's frames [Hz]; 1 where it is not known. */
export function frameRate(recording: Pick<Recording, "frames_written" | "duration_s">): number {
  const gaps = (recording.frames_written ?? 0) - 1;
  return recording.duration_s && gaps > 0 ? gaps / recording.duration_s : 1;
}

/** Return the next position of a playing recording, inside of it.
 *
 * Where the server is slow the recording is played more slowly: it works frames out behind those of before, and begins
 * anew, which is more work, behind too large a step.
 */
export function nextPosition(position: number, frames: number, passedMs: number, speed: number, rateHz: number): number {
  const perMs = (speed * rateHz) / 1000;
  return kept(position + Math.min(passedMs * perMs, Math.max(PICTURE_MS * perMs, MAX_STEP)), frames);
}

/** Return a frame's number that is inside the recording. */
export function kept(position: number, frames: number): number {
  if (!Number.isFinite(position)) return 0;
  return Math.max(0, Math.min(frames - 1, position));
}

/** Return the calibration that a frame's points were made with. */
export function calibrationOf(detail: Pick<Detail, "calibrations">, number: number): string | null {
  const before = detail.calibrations.filter(({ from_frame }) => from_frame !== null && from_frame <= number);
  return before.sort((a, b) => (a.from_frame ?? 0) - (b.from_frame ?? 0)).at(-1)?.calibration_id ?? null;
}

/** Return a recorded frame as the stream would have sent it; without tracks and tools where they were not asked for. */
export function toFrame(recorded: RecordedFrame, device: string, calibration: string | null): Frame {
  return {
    type: "frame",
    n: recorded.number,
    device_id: device,
    sequence: recorded.sequence,
    exposure_ns: recorded.exposure_ns,
    device_ns: recorded.exposure_ns,
    marker: recorded.marker,
    calibration_id: calibration,
    table_id: null,
    radiometric_id: null,
    flags: [],
    points: recorded.points.map((point) => ({ ...point, external_reliability_mm: null })),
    peaks: null,
    tracks: recorded.tracks,
    tools: recorded.tools,
    holds: null,
  } as unknown as Frame;
}
