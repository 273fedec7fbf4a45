import { describe, expect, test } from "vitest";
import { parseTargets, targetsTable } from "./targets";

describe("table of targets", () => {
  test("comma, decimal points", () => {
    expect(parseTargets("name,X_mm,Y_mm,Z_mm\na,1.5,-2,1e3\n")).toEqual([
      { name: "a", position_mm: [1.5, -2, 1000], marker: null },
    ]);
  });

  test("semicolon, decimal commas, centimetres, markers, comments, no names", () => {
    const table = "# by machine\r\nX [cm];Y [cm];Z [cm];marker\r\n1,5;0;10;3\r\n\r\n2;0;10;4\r\n";
    expect(parseTargets(table)).toEqual([
      { name: "1", position_mm: [15, 0, 100], marker: 3 },
      { name: "2", position_mm: [20, 0, 100], marker: 4 },
    ]);
  });

  test("tabs and quotes", () => {
    expect(parseTargets('"x"\t"y"\t"z"\n"1"\t"2"\t"3"')[0]?.position_mm).toEqual([1, 2, 3]);
  });

  test.each([
    ["", "empty"],
    ["X Y Z\n1 2 3", "separated"],
    ["X,Y\n1,2", "no column Z"],
    ["X,Y,Z\n1,2,three", 'row 2: "three"'],
    ["X,Y,Z\n1,2,", 'row 2: ""'],
    ["X,Y,Z,marker\n1,2,3,a", 'row 2: "a"'],
    ["name,X,Y,Z\na,1,2,3\na,4,5,6", '"a" twice'],
    ["X,Y,Z", "empty"],
  ])("%j is refused with %j", (table, words) => {
    expect(() => parseTargets(table)).toThrow(words);
  });
});

test.each([
  [[{ name: "a, b; c", position_mm: [1.5, -2e-7, 3] as [number, number, number], marker: 4 }]],
  [[{ name: "<b>", position_mm: [1, 2, 3] as [number, number, number], marker: null }]],
])("targets are read as they were written", (targets) => {
  expect(parseTargets(targetsTable(targets))).toEqual(targets);
});

test("a tab in a name would be a column", () => {
  expect(parseTargets(targetsTable([{ name: "a\tb", position_mm: [1, 2, 3], marker: null }]))[0]?.name).toBe("a b");
});
