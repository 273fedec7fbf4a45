import { describe, expect, test } from "vitest";
import type { Frame, ToolPose } from "../../live/messages";
import { SceneState } from "./scene_state";

const POSE: ToolPose = {
  tool_id: "pointer", status: "OK", reason: null, translation_mm: [1, 2, 3],
  rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], quaternion_wxyz: [1, 0, 0, 0], covariance: null,
  tip_mm: null, tip_covariance_mm2: null, residual_sigma: 1, markers_used: 4, readings_used: 16,
  velocity_mm_s: null, angular_velocity_rad_s: null, detectable_sigma: 4, external_tip_mm: 0.1,
  external_rotation_rad: 0.001,
};

function frameOf(members: object, seconds = 0): Frame {
  return { exposure_ns: 1_700_000_000_000_000_000n + BigInt(seconds * 1e9), ...members } as unknown as Frame;
}

describe("SceneState", () => {
  test("a lost tool is a ghost at its last pose, with the reason in words", () => {
    const state = new SceneState();
    state.take(frameOf({ tools: [POSE] }));
    const lost = { ...POSE, status: "MISSING", reason: "3 of 4 markers are hidden", rotation: null, translation_mm: null };
    const frame = frameOf({ tools: [lost] }, 2);
    state.take(frame);
    expect(state.tools).toHaveLength(1);
    expect(state.tools[0]).toMatchObject({ ghost: true, label: "pointer: 3 of 4 markers are hidden" });
    expect(state.tools[0]?.pose.translation_mm).toEqual([1, 2, 3]);
    expect(state.lostFor("pointer", frame)).toBeCloseTo(2, 3);
  });

  test("a tool that never had a pose is not drawn", () => {
    const state = new SceneState();
    const frame = frameOf({ tools: [{ ...POSE, rotation: null, translation_mm: null, status: "MISSING" }] });
    state.take(frame);
    expect(state.tools).toEqual([]);
    expect(state.lostFor("pointer", frame)).toBeNull();
  });

  test("points without a position are not drawn, suspect ones are told apart", () => {
    const state = new SceneState();
    state.take(
      frameOf({
        points: [
          { marker: 0, position_mm: null, covariance_mm2: null, flags: ["too-few-sensors"] },
          { marker: 1, position_mm: [0, 0, 1], covariance_mm2: null, flags: [] },
          { marker: 2, position_mm: [0, 0, 2], covariance_mm2: null, flags: ["inconsistent"] },
        ],
      }),
    );
    expect(state.markers.map(({ id, kind }) => [id, kind])).toEqual([["marker 1", "point"], ["marker 2", "suspect"]]);
  });

  test("a track that no sensor detects now is suspect only where something else is wrong with it", () => {
    const state = new SceneState();
    const kinds = (tracks: readonly (readonly [string, string[]])[]) => {
      const rows = tracks.map(([name, flags], id) => ({ id, position_mm: [0, 0, 0], covariance_mm2: null, state: name, flags }));
      state.take(frameOf({ tracks: rows }));
      return state.markers.map(({ kind }) => kind);
    };
    expect(kinds([["coasting", ["few-sensors"]], ["coasting", ["few-sensors", "ambiguous"]], ["confirmed", ["few-sensors"]]])).toEqual(["coasting", "suspect", "suspect"]);
  });

  test("a track's tail grows to a limit and ends with the track", () => {
    const state = new SceneState();
    const track = { id: 7, position_mm: [0, 0, 0], covariance_mm2: null, state: "confirmed", flags: [] };
    for (let index = 0; index < 100; index++) state.take(frameOf({ tracks: [{ ...track, position_mm: [index, 0, 0] }] }));
    expect(state.markers[0]?.tail).toHaveLength(60);
    expect(state.markers[0]?.tail.at(-1)).toEqual([99, 0, 0]);
    state.take(frameOf({ tracks: [] }));
    state.take(frameOf({ tracks: [track] }));
    expect(state.markers[0]?.tail).toHaveLength(1);
  });

  test("the points listed are those of all strobed markers that are shown, and those without a position", () => {
    const state = new SceneState();
    const point = (marker: number | null, x: number | null) => ({ marker, position_mm: x === null ? null : [x, 0, 0], covariance_mm2: null, flags: [] });
    const listed = () => state.points.map(({ id, point: { position_mm } }) => [id, position_mm?.[0] ?? null]);
    state.take(frameOf({ points: [point(10, 1)] }, 0));
    state.take(frameOf({ points: [point(2, 2), point(null, 5)] }, 0.1));
    expect(listed()).toEqual([["point 1", 5], ["marker 2", 2], ["marker 10", 1]]);
    expect(state.markers.map(({ id }) => id)).toEqual(["point 1", "marker 2", "marker 10"]);
    // Its newest exposure has no position: the one before is not shown as if it were of now.
    state.take(frameOf({ points: [point(10, null)] }, 0.2));
    expect(listed()).toEqual([["marker 2", 2], ["marker 10", null]]);
    expect(state.markers.map(({ id }) => id)).toEqual(["marker 2"]);
    // Tracks are drawn in their place; the list of points stays.
    const track = { id: 7, position_mm: [0, 0, 0], covariance_mm2: null, state: "confirmed", flags: [] };
    state.take(frameOf({ points: [point(3, 1)], tracks: [track] }, 0.25));
    expect(listed()).toEqual([["marker 2", 2], ["marker 3", 1], ["marker 10", null]]);
    expect(state.markers.map(({ id }) => id)).toEqual(["track 7"]);
    // A reflection in the same exposure is listed, too.
    state.take(frameOf({ points: [point(3, 1), point(3, 8)] }, 0.3));
    expect(listed().slice(1, 3)).toEqual([["marker 3", 1], ["marker 3/2", 8]]);
    state.clear();
    expect(state.points).toEqual([]);
  });

  test("strobed markers stay for a while between their exposures, others do not", () => {
    const state = new SceneState();
    const point = (marker: number | null, x: number) => ({ marker, position_mm: [x, 0, 0], covariance_mm2: null, flags: [] });
    state.take(frameOf({ points: [point(0, 1)] }, 0));
    state.take(frameOf({ points: [point(1, 2)] }, 0.1));
    expect(state.markers.map(({ id }) => id)).toEqual(["marker 0", "marker 1"]);
    expect(state.markers[0]?.tail).toHaveLength(1);
    state.take(frameOf({ points: [point(1, 3)] }, 0.35));
    expect(state.markers.map(({ id, position }) => [id, position[0]])).toEqual([["marker 1", 3]]);
    expect(state.markers[0]?.tail).toHaveLength(2);
    state.take(frameOf({ points: [point(null, 4)] }, 1));
    state.take(frameOf({ points: [] }, 1.01));
    expect(state.markers).toEqual([]);
  });

  test("frames of a recording that come again are taken once", () => {
    const state = new SceneState();
    const track = (x: number) => ({ id: 7, position_mm: [x, 0, 0], covariance_mm2: null, state: "confirmed", flags: [] });
    const span = (first: number, last: number) =>
      Array.from({ length: last - first + 1 }, (_, index) => frameOf({ tracks: [track(first + index)] }, first + index));
    state.follow(span(0, 3), 0);
    // A player asks for some frames before each that it shows.
    state.follow(span(2, 5), 2);
    state.follow(span(2, 5), 2);
    expect(state.markers[0]?.tail.map(([x]) => x)).toEqual([0, 1, 2, 3, 4, 5]);
    state.clear();
    // The last one is taken by who draws it.
    state.follow(span(1, 3), 1, 1);
    expect(state.markers[0]?.tail.map(([x]) => x)).toEqual([1, 2]);
  });
});
