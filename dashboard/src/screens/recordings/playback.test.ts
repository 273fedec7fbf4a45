import { describe, expect, test } from "vitest";
import { SceneState } from "../scene/scene_state";
import { advanced, calibrationOf, frameRate, kept, toFrame } from "./playback";

describe("position", () => {
  test("goes on by the recording's own rate and the chosen speed", () => {
    expect(advanced(100, 10_000, 500, 2, 1000)).toBe(1100);
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
        },
        "sim",
        null,
      ),
    );
  expect(state.markers.map(({ id }) => id).sort()).toEqual(["marker 0", "marker 1", "marker 2"]);
});
