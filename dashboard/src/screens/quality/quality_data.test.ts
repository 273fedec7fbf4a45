import { describe, expect, test } from "vitest";
import { chartRange, found, lastSignal, markerNumbers, oneMarker } from "./quality_data";

const point = (value: number, signal = "none") => ({ measured_at: "2026-01-01T00:00:00Z", value, average: value, signal }) as never;

describe("range of a chart", () => {
  test("holds values and limits", () => {
    const [low, high] = chartRange({ points: [point(3), point(5)], lower: 1, upper: 4 });
    expect(low).toBeLessThan(1);
    expect(high).toBeGreaterThan(5);
  });
  test.each([
    ["no values", []],
    ["one value", [point(0)]],
    ["no number", [point(Number.NaN)]],
  ])("of %s is one", (_, points) => {
    const [low, high] = chartRange({ points, lower: null, upper: null });
    expect(high).toBeGreaterThan(low);
  });
});

test("the last signal is the newest value's", () => {
  expect(lastSignal({ points: [point(1, "jump"), point(2)] })).toBeNull();
  expect(lastSignal({ points: [point(1), point(2, "drift")] })).toBe("drift");
  expect(lastSignal({ points: [] })).toBeNull();
});

describe("a check's result", () => {
  test("of a distance says error and scatter", () => {
    expect(found({ kind: "point-to-point", result: { errors: { mean: 0.1234, rms: 0.2, percentile_95: 0.4 } } } as never)).toContain("0.123");
  });
  test("of a still marker says its scatter", () => {
    const result = { scatter: { rms: 0.05 }, stated_mm: 0.04, bias: null };
    expect(found({ kind: "single-point", result } as never)).toContain("0.0500");
  });
});

describe("marker numbers", () => {
  test.each([
    ["", null],
    ["3", [3]],
    ["3, 4;5", [3, 4, 5]],
  ])("%s", (entered, numbers) => expect(markerNumbers(entered)).toEqual(numbers));
  test.each(["a", "3, 123456"])("%j is refused", (entered) => expect(() => markerNumbers(entered)).toThrow(/is no marker's number/));
  test("one is a number, none or empty is none, two are refused", () => {
    expect(oneMarker(" 7 ")).toBe(7);
    expect(oneMarker("0")).toBe(0);
    expect(oneMarker(" ")).toBeNull();
    expect(() => oneMarker("1, 2")).toThrow('"1, 2"');
  });
});
