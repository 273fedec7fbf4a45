import { describe, expect, test } from "vitest";
import { parseTools } from "./tool_file";

const TABLE = "name;X [cm];Y;Z;marker\nA;1,5;0;0;3\ntip;-15;0;0;\nB;8;0;0;4\nC;0;6;0;5\n";

describe("parseTools", () => {
  test("takes a table of strobed markers with a tip, in its own order", () => {
    expect(parseTools(TABLE, "sim", "pointer")).toEqual([
      {
        id: "pointer",
        title: "pointer",
        device_id: "sim",
        markers_mm: [[15, 0, 0], [80, 0, 0], [0, 6, 0]],
        strobe_markers: [3, 4, 5],
        tip_mm: [-150, 0, 0],
      },
    ]);
  });

  test("takes a table of markers that are lit together", () => {
    const [tool] = parseTools("X,Y,Z\n0,0,0\n80,0,0\n0,60,0\n", "sim", "clamp");
    expect(tool).toMatchObject({ strobe_markers: null, markers_mm: [[0, 0, 0], [80, 0, 0], [0, 60, 0]] });
    expect(tool).not.toHaveProperty("tip_mm");
  });

  test("takes what the server sends, without what it does not take", () => {
    const sent = {
      id: "pointer", device_id: "elsewhere", title: "Pointer", markers_mm: [[0, 0, 0], [80, 0, 0], [0, 60, 0]],
      tip: { position_mm: [1, 2, 3], covariance_mm2: null }, origin: { kind: "given" }, created_at: "", updated_at: "",
    };
    const wanted = { id: "pointer", device_id: "sim", title: "Pointer", markers_mm: sent.markers_mm, tip_mm: [1, 2, 3] };
    for (const document of [sent, [sent], { items: [sent], next_cursor: null }])
      expect(parseTools(JSON.stringify(document), "sim", "")).toEqual([wanted]);
  });

  test.each([
    ["{", "x", "no JSON"],
    ["[]", "x", "no tools"],
    ["[1]", "x", "no tools"],
    ['[{"id": "a"}, {"id": "b"}]', "x", "2 tools"],
    ['{"markers_mm": []}', "", "id"],
    ['{"id": "a"}', "", '"a" has no markers_mm'],
    ["X,Y\n1,2\n", "x", "no column Z"],
    ["X,Y,Z,marker\n1,2,3,\n", "x", "no marker's number"],
    ["", "x", "empty"],
  ])("refuses %j with what to change", (content, id, words) => {
    expect(() => parseTools(content, "sim", id)).toThrow(words);
  });
});
