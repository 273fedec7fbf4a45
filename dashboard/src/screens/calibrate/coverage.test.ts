import { expect, test } from "vitest";
import { coverage } from "./coverage";

function capture(...pixels: number[]) {
  const sensors = (px: number) => [
    { sensor: "cam1", mean_px: px, frames: 9, spread_px: 0, stated_px: null, sigma_px: 0.01 },
  ];
  return { captured: pixels.map((px, index) => ({ target: `${index}`, frames: 9, sensors: sensors(px), captured_at: "" })) };
}

const SENSORS = [
  { name: "cam1", pixels: 800, pitch_um: 10 },
  { name: "cam2", pixels: 80, pitch_um: 10 },
];

test("parts without a reading are named, neighbours together", () => {
  const [first, second] = coverage(capture(-0.5, 50, 250, 799.4), SENSORS);
  expect(first).toEqual({
    sensor: "cam1",
    readings: 4,
    share: 3 / 8,
    gaps: [
      [100, 199],
      [300, 699],
    ],
  });
  expect(second).toEqual({ sensor: "cam2", readings: 0, share: 0, gaps: [[0, 79]] });
});

test("readings everywhere leave no gap", () => {
  const [first] = coverage(capture(...Array.from({ length: 8 }, (_, part) => 100 * part + 50)), SENSORS);
  expect(first).toMatchObject({ share: 1, gaps: [] });
});
