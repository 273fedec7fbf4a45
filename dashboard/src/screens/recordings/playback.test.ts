import { describe, expect, test } from "vitest";
import { SceneState } from "../scene/scene_state";
import { calibrationOf, frameRate, kept, nextPosition, toFrame } from "./playback";

describe("position", () => {
  test("goes on by the recording's own rate and the chosen speed", () => {
    expect(nextPosition(100, 10_000, 100, 2, 1000)).toBe(300);
  });
  test("behind a late answer goes on by no more than the server need begin anew for", () => {
    expect(nextPosition(100, 10_000, 200, 1, 1000)).toBe(300);
    expect(nextPosition(100, 10_000, 5000, 1, 1000)).toBe(356);
    expect(nextPosition(100, 10_000, 5000, 10, 1000)).toBe(1100);
  });
  test.each([
    [-5, 0],
    [99.5, 99],
    [Number.NaN, 0],
  ])("%s is kept inside as %s", (position, inside) => {
    expect(kept(position, 100)).toBe(inside);
  });
});

describe("frame rate", () => {
  test("is that of the gaps", () => expect(frameRate({ frames_written: 101, duration_s: 0.1 })).toBe(1000));
  test.each([
    [{ frames_written: 1, duration_s: 0 }],
    [{ frames_written: null, duration_s: null }],
  ])("of a recording that tells none is 1", (recording) => expect(frameRate(recording)).toBe(1));
});

test("a frame's calibration is the last that came before it", () => {
  const calibrations = [
    { calibration_id: "second", from_frame: 50 },
    { calibration_id: "first", from_frame: 0 },
    { calibration_id: "never", from_frame: null },
  ] as never;
  expect(calibrationOf({ calibrations }, 49)).toBe("first");
  expect(calibrationOf({ calibrations }, 50)).toBe("second");
  expect(calibrationOf({ calibrations: [] }, 50)).toBeNull();
});

test("strobed frames of one span show all their markers in the scene", () => {
  const state = new SceneState();
  for (const number of [0, 1, 2])
    state.take(
      toFrame(
        {
          number,
          sequence: number,
          exposure_ns: number * 1_000_000,
          marker: number,
          points: [
            { marker: number, position_mm: [number, 0, 0], covariance_mm2: null, residual_sigma: null, sensors: [], flags: [] },
          ],
          tracks: null,
          tools: null,
        },
        "sim",
        null,
      ),
    );
  expect(state.markers.map(({ id }) => id).sort()).toEqual(["marker 0", "marker 1", "marker 2"]);
});

test("tracks and tools that were asked for are shown in the scene", () => {
  const state = new SceneState();
  const track = { id: 7, state: "confirmed", flags: [], position_mm: [1, 2, 3], covariance_mm2: null };
  const tool = { tool_id: "pointer", status: "OK", reason: null, translation_mm: [1, 2, 3], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] };
  const recorded = { number: 0, sequence: 0, exposure_ns: 0, marker: null, points: [], tracks: [track], tools: [tool] } as never;
  state.take(toFrame(recorded, "sim", null));
  expect(state.markers.map(({ id }) => id)).toEqual(["track 7"]);
  expect(state.tools.map(({ id, ghost }) => [id, ghost])).toEqual([["pointer", false]]);
});
