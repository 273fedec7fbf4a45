import { describe, expect, test } from "vitest";
import { toCsv } from "../../ui/download";
import { aroundPeak, csvRows, fittedLine, type Scan, type Scans, verticalRange, zoomed } from "./scan_data";

function scan(changes: Partial<Scan> = {}): Scan {
  return {
    sensor: "left",
    counts: [10, 11, 40, 90, 42, 10, 9, 10],
    background_counts: 10,
    noise_counts: 2,
    threshold_counts: 22,
    full_scale_counts: 4095,
    saturated_pixels: 0,
    masked_pixels: [],
    peaks: [],
    windows: null,
    ...changes,
  };
}

const window = { first_px: 2, model: [41, 89, null], used: [true, false, true], residual_sigma: [-0.5, 9, null] };
const fitted = scan({ windows: [window] as unknown as Scan["windows"] });

describe("fitted line", () => {
  test("lies at the pixels of its window, and a pixel that was left out has no residual", () => {
    const { model, residual } = fittedLine(fitted);
    expect(model).toEqual([null, null, 41, 89, null, null, null, null]);
    expect(residual).toEqual([null, null, -0.5, null, null, null, null, null]);
  });
  test("is empty without fits", () => {
    expect(fittedLine(scan()).model.every((value) => value === null)).toBe(true);
  });
});

describe("vertical range", () => {
  test.each(["scan", "full", "background"] as const)("%s holds background and threshold", (vertical) => {
    const [low, high] = verticalRange(scan(), vertical);
    expect(low).toBeLessThanOrEqual(10);
    expect(high).toBeGreaterThan(22);
  });
  test("is a range where all counts are the same", () => {
    const [low, high] = verticalRange(scan({ counts: [5, 5], background_counts: 5, threshold_counts: 5 }), "scan");
    expect(high).toBeGreaterThan(low);
  });
  test("takes the longest scans", () => {
    const counts = new Array<number>(65536).fill(100);
    expect(verticalRange(scan({ counts }), "scan")[1]).toBeGreaterThan(100);
  });
});

describe("zoom", () => {
  test("stays inside the sensor", () => {
    expect(zoomed([0, 2047], 2, 0, 2048)).toEqual([0, 2047]);
    expect(zoomed([2000, 2040], 1, 1, 2048)).toEqual([2007, 2047]);
  });
  test("shows some pixels at least", () => {
    const [first, last] = zoomed([100, 101], 0.1, 0, 2048);
    expect(last - first).toBe(8);
  });
  test("of a peak has it in the middle", () => {
    const [first, last] = aroundPeak(1000.5, 6, 2048);
    expect((first + last) / 2).toBeCloseTo(1000.5);
  });
});

describe("CSV", () => {
  const scans = { device_id: "sim", sequence: 7, scans: [fitted, scan({ sensor: '=cmd "x"', counts: [1, 2] })] } as unknown as Scans;
  test("has every sensor's counts, and the fit of the fitted one", () => {
    const rows = csvRows(scans);
    expect(rows[0]).toEqual(["pixel", "left [counts]", '=cmd "x" [counts]', "left model [counts]", "left residual [sigma]"]);
    expect(rows[3]).toEqual([2, 40, null, 41, -0.5]);
    expect(rows).toHaveLength(9);
  });
  test("names cannot be formulas", () => {
    expect(toCsv(csvRows(scans))).toContain(`"'=cmd ""x"" [counts]"`);
  });
  test("leaves out what is no number", () => {
    expect(toCsv([[Number.NaN, null, 1]])).toBe(",,1\r\n");
  });
});
