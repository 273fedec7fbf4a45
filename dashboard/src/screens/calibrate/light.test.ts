import { describe, expect, test } from "vitest";
import type { Frame } from "../../live/messages";
import { judgeLight } from "./light";

type Peak = NonNullable<Frame["peaks"]>[number];

function frame(...peaks: Partial<Peak>[]): Frame {
  const whole = { position_px: 1, sigma_px: 0.02, amplitude: 900, width_px: 2, reduced_chi2: 1, flags: [] };
  return { peaks: peaks.map((peak) => ({ ...whole, sensor: "cam1", ...peak })) } as unknown as Frame;
}

describe("light of a sensor", () => {
  test.each([
    ["good", "good", [frame({}), frame({})]],
    ["no peak", "bad", [frame({ sensor: "cam2" }), frame()]],
    ["saturated", "bad", [frame({ flags: ["saturated"] }), frame({})]],
    ["in few frames", "warn", [frame({}), frame(), frame()]],
    ["dim", "warn", [frame({ sigma_px: 0.5 })]],
    ["narrow", "warn", [frame({ width_px: 0.3 })]],
    ["no frames", "bad", []],
  ])("%s is %s", (_, verdict, frames) => {
    expect(judgeLight(["cam1"], frames as Frame[])[0]?.verdict).toBe(verdict);
  });

  test("medians and shares are of the sensor's own peaks", () => {
    const [light] = judgeLight(["cam1"], [frame({ amplitude: 100 }, { amplitude: 300 }), frame({ amplitude: 200 })]);
    expect(light).toMatchObject({ seen: 1, peaks: 1.5, amplitude: 200 });
  });
});
