import { describe, expect, test } from "vitest";
import { changedPoints, type ControlPoint, judgePoints, type Judgement, judgementsOf, type LabelFinding, meaning } from "./label_judgement";

const MARKUP = "<img src=x>";
const POINTS: ControlPoint[] = ["a", "b", "c", MARKUP].map((name, index) => ({
  name,
  position_mm: [index, 0, 0],
  readings: { left: { position_px: 10 * index, sigma_px: 0.1 * index + 0.1 }, ...(index === 3 ? {} : { right: 100 + index }) },
}));

function finding(kind: LabelFinding["kind"], sensor: string | null, ...points: number[]): LabelFinding {
  return { kind, sensor, points, probability: 1, residual_px: [], normalised_residual: [] };
}

function judged(findings: LabelFinding[], ...judgements: Judgement[]) {
  return judgePoints(POINTS, findings, judgements);
}

/** Return a sensor's readings: positions, null without one. */
function of(sensor: string, points: ControlPoint[]) {
  return points.map(({ readings }) => {
    const reading = readings[sensor];
    return reading === undefined ? null : typeof reading === "number" ? reading : reading.position_px;
  });
}

describe("points as judged", () => {
  const exchanged = finding("exchanged", "left", 1, 3);
  test("kept: nothing changes", () => expect(judged([exchanged], "keep")).toEqual(POINTS));
  test("not judged: nothing changes", () => expect(judged([exchanged])).toEqual(POINTS));
  test("an exchange goes back with its standard deviations, in its sensor only", () => {
    const points = judged([exchanged], "repair");
    expect(of("left", points)).toEqual([20, 10, 0, 30]);
    expect(points[0]?.readings["left"]).toEqual(POINTS[2]?.readings["left"]);
    expect(of("right", points)).toEqual(of("right", POINTS));
  });
  test("left out: both readings are", () => expect(of("left", judged([exchanged], "exclude"))).toEqual([null, 10, null, 30]));
  test("a cycle goes back: each reading belongs to the next", () =>
    expect(of("left", judged([finding("exchanged", "left", 1, 2, 4)], "repair"))).toEqual([30, 0, 20, 10]));
  test("a wrong label gives its reading away", () =>
    expect(of("right", judged([finding("wrong-label", "right", 2, 4)], "repair"))).toEqual([100, null, 102, 101]));
  test("an outlier is left out", () => expect(of("right", judged([finding("outlier", "right", 3)], "exclude"))).toEqual([100, 101, null, null]));
  test("an outlier belongs nowhere", () => expect(judgementsOf(finding("outlier", "left", 1))).not.toContain("repair"));
  test("points exchanged in all sensors are, with what is missing", () => {
    const points = judged([finding("exchanged", null, 3, 4)], "repair");
    expect(of("left", points)).toEqual([0, 10, 30, 20]);
    expect(of("right", points)).toEqual([100, 101, null, 102]);
  });
  // As the server's exclude: what a finding of one sensor calls point 2 is posted as point 1.
  test.each<[Judgement, (number | null)[]]>([
    ["repair", [10, null, 20, 30]],
    ["keep", [null, 10, 20, 30]],
    ["exclude", [null, null, 20, 30]],
  ])("a finding of one sensor counts points as all sensors' are repaired, also where those were judged %s", (common, left) =>
    expect(of("left", judged([finding("exchanged", null, 1, 2), finding("outlier", "left", 2)], common, "exclude"))).toEqual(left),
  );
  test("the points given stay", () => {
    const before = structuredClone(POINTS);
    judged([exchanged], "repair");
    expect(POINTS).toEqual(before);
  });
});

test("points with a changed reading are found, whatever the order of the sensors", () => {
  const turned = POINTS.map((point) => ({ ...point, readings: Object.fromEntries(Object.entries(point.readings).reverse()) }));
  expect(changedPoints(POINTS, turned).size).toBe(0);
  expect([...changedPoints(POINTS, judged([finding("exchanged", "left", 1, 3)], "repair"))]).toEqual([0, 2]);
});

describe("meaning", () => {
  test.each([
    [finding("outlier", "left", 1), /^left: the reading of a /],
    [finding("exchanged", null, 2, 4), new RegExp(`^All sensors: the readings of b and ${MARKUP}`)],
    [finding("exchanged", "left", 1, 2, 3), /a → b → c → a/],
    [finding("wrong-label", "right", 2, 4), new RegExp(`labelled b is one of ${MARKUP}`)],
    [finding("outlier", "left", 9), /reading of 9 /],
  ])("%j names points from 1", (one, words) => expect(meaning(one, POINTS)).toMatch(words));
});
