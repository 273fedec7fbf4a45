/** What the scene shows of a frame: markers with tails, and tools with the last pose of lost ones. */

import { type Frame, type Point, toMilliseconds, type ToolPose } from "../../live/messages";
import type { DrawnTool, Marker } from "./scene_view";

const TAIL_POSITIONS = 60;
/** A strobed marker is lit in few frames; it is shown until it is this old. */
const STROBED_MS = 300;

/** A point and how it is called. */
export interface NamedPoint {
  readonly id: string;
  readonly point: Point;
}

/** Remembers what a single frame does not say. */
export class SceneState {
  markers: readonly Marker[] = [];
  tools: readonly DrawnTool[] = [];
  /** The newest frame's points, and those of strobed markers in the exposures before. */
  points: readonly NamedPoint[] = [];
  private readonly strobed = new Map<number, { points: readonly Point[]; since: number }>();
  private readonly tails = new Map<string, (readonly number[])[]>();
  private readonly lastPoses = new Map<string, { pose: ToolPose; at: number }>();
  /** Number of the newest frame of a recording. */
  private newest = -1;

  /** Forget what came before: the next frame does not follow it. */
  clear(): void {
    this.markers = [];
    this.tools = [];
    this.points = [];
    this.newest = -1;
    for (const known of [this.strobed, this.tails, this.lastPoses]) known.clear();
  }

  /** Take those frames of a recording that were not taken yet.
   *
   * `first` is the number of the first frame. The last `left` are taken by others, who draw them.
   */
  follow(frames: readonly Frame[], first: number, left = 0): void {
    const before = this.newest;
    frames.forEach((frame, index) => {
      if (first + index > before && index < frames.length - left) this.take(frame);
    });
    this.newest = Math.max(before, first + frames.length - 1);
  }

  /** Take a frame. */
  take(frame: Frame): void {
    const at = toMilliseconds(frame.exposure_ns);
    const points = frame.points ?? [];
    for (const [marker, { since }] of this.strobed) if (Math.abs(at - since) > STROBED_MS) this.strobed.delete(marker);
    for (const { marker } of points)
      if (marker !== null) this.strobed.set(marker, { points: points.filter((one) => one.marker === marker), since: at });
    const unnamed = points.flatMap((point, index) => (point.marker === null ? [{ id: `point ${index}`, point }] : []));
    // In the order of their numbers: rows that change places cannot be read.
    const kept = [...this.strobed]
      .sort(([a], [b]) => a - b)
      .flatMap(([marker, held]) => held.points.map((point, index) => ({ id: `marker ${marker}${index ? `/${index + 1}` : ""}`, point })));
    this.points = [...unnamed, ...kept];
    this.markers = frame.tracks?.length
      ? trackMarkers(frame).map((marker) => this.withTail(marker, true))
      : pointMarkers(this.points).map(({ marker, point }) => this.withTail(marker, points.includes(point)));
    this.forgetTails();
    this.tools = (frame.tools ?? []).flatMap((pose) => this.drawn(pose, at));
  }

  private forgetTails(): void {
    const kept = new Set(this.markers.map(({ id }) => id));
    for (const id of this.tails.keys()) if (!kept.has(id)) this.tails.delete(id);
  }

  /** Return for how many seconds a tool has had no pose; null: it never had one. */
  lostFor(tool: string, frame: Frame): number | null {
    const last = this.lastPoses.get(tool);
    return last ? Math.max(0, (toMilliseconds(frame.exposure_ns) - last.at) / 1000) : null;
  }

  private withTail(marker: Omit<Marker, "tail">, moved: boolean): Marker {
    // Points have no identity from frame to frame, but strobed ones have.
    if (marker.id.startsWith("point ")) return { ...marker, tail: [] };
    const tail = this.tails.get(marker.id) ?? [];
    if (moved) tail.push(marker.position);
    if (tail.length > TAIL_POSITIONS) tail.shift();
    this.tails.set(marker.id, tail);
    return { ...marker, tail };
  }

  private drawn(pose: ToolPose, at: number): DrawnTool[] {
    if (pose.rotation && pose.translation_mm) {
      this.lastPoses.set(pose.tool_id, { pose, at });
      const label = pose.status === "OK" ? pose.tool_id : `${pose.tool_id}: ${pose.reason ?? pose.status}`;
      return [{ id: pose.tool_id, pose, ghost: false, label }];
    }
    const last = this.lastPoses.get(pose.tool_id);
    const label = `${pose.tool_id}: ${pose.reason ?? pose.status}`;
    return last ? [{ id: pose.tool_id, pose: last.pose, ghost: true, label }] : [];
  }
}

function trackMarkers(frame: Frame): Omit<Marker, "tail">[] {
  return (frame.tracks ?? []).map((track) => ({
    id: `track ${track.id}`,
    position: track.position_mm,
    covariance: track.covariance_mm2,
    // A track that coasts is detected by no sensor now, which is no fault: strobed markers do so in most frames.
    kind: track.flags.some((flag) => flag !== "few-sensors" || track.state !== "coasting")
      ? "suspect"
      : track.state === "confirmed" || track.state === "coasting"
        ? track.state
        : "tentative",
  }));
}

function pointMarkers(points: readonly NamedPoint[]): { marker: Omit<Marker, "tail">; point: Point }[] {
  return points.flatMap(({ id, point }) =>
    point.position_mm
      ? [
          {
            point,
            marker: {
              id,
              position: point.position_mm,
              covariance: point.covariance_mm2,
              kind: point.flags.length ? ("suspect" as const) : ("point" as const),
            },
          },
        ]
      : [],
  );
}
