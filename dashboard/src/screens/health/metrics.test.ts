import { describe, expect, test } from "vitest";
import { grown, latencies, parseMetrics, quantile, requests, stages, valueOf } from "./metrics";

const bucket = (device: string, counts: number[]) =>
  ["0.001", "0.01", "+Inf"].map((le, index) => `lumiline_batch_latency_seconds_bucket{device="${device}",le="${le}"} ${counts[index]}`).join("\n");

describe("metrics", () => {
  test("are read with their labels, whatever is in them", () => {
    const metrics = parseMetrics('# HELP a b\na{x="1",y="q\\"}\\\\,z"} 2.5e3 123\nb 7\nnonsense\n\nc{} +Inf');
    expect(metrics.get("a")).toEqual([{ labels: { x: "1", y: 'q"}\\,z' }, value: 2500 }]);
    expect(valueOf(metrics, "b")).toBe(7);
    expect(valueOf(metrics, "c")).toBe(Number.POSITIVE_INFINITY);
    expect(valueOf(metrics, "a", { x: "2" })).toBeNull();
  });
  test("a counter of a server that began anew counts from zero", () => {
    expect(grown(parseMetrics("n 10"), parseMetrics("n 4"), "n")).toBe(4);
    expect(grown(parseMetrics(""), parseMetrics("n 4"), "n")).toBe(4);
  });
});

describe("latencies", () => {
  const classes = latencies(parseMetrics(bucket("sim", [10, 20, 20])), parseMetrics(`${bucket("sim", [60, 120, 120])}\n${bucket("other", [1, 1, 9])}`), "sim");
  test("are those between two readings, class by class", () => {
    expect(classes).toEqual([
      { from: 0, to: 0.001, count: 50 },
      { from: 0.001, to: 0.01, count: 50 },
      { from: 0.01, to: Number.POSITIVE_INFINITY, count: 0 },
    ]);
  });
  test("have quantiles", () => {
    expect(quantile(classes, 0.5)).toBeCloseTo(0.001);
    expect(quantile(classes, 0.75)).toBeCloseTo(0.0055);
    expect(quantile([], 0.5)).toBeNull();
    expect(quantile([{ from: 2, to: Number.POSITIVE_INFINITY, count: 1 }], 0.5)).toBe(Number.POSITIVE_INFINITY);
  });
});

test("requests that take most time come first", () => {
  const line = (route: string, count: number, sum: number) =>
    `lumiline_http_request_duration_seconds_count{method="GET",route="${route}"} ${count}\nlumiline_http_request_duration_seconds_sum{method="GET",route="${route}"} ${sum}`;
  const before = parseMetrics([line("/a", 1, 1), line("/b", 1, 1), line("/c", 1, 1)].join("\n"));
  const after = parseMetrics([line("/a", 11, 1.1), line("/b", 3, 5), line("/c", 1, 1)].join("\n"));
  expect(requests(before, after, 2)).toEqual([
    { route: "GET /b", perSecond: 1, meanMs: 2000 },
    { route: "GET /a", perSecond: 5, meanMs: expect.closeTo(10) as number },
  ]);
});

describe("latency by stage", () => {
  const reading = (count: number, ...sums: number[]) =>
    parseMetrics(
      ["reception", "waiting", "computation", "publication"]
        .map((stage, index) => {
          const labels = `{device="sim",stage="${stage}"}`;
          return `lumiline_frame_stage_seconds_count${labels} ${count}\nlumiline_frame_stage_seconds_sum${labels} ${sums[index]}`;
        })
        .join("\n"),
    );
  test("each stage begins where the one before ends", () => {
    const found = stages(reading(2, 1, 1, 1, 1), reading(6, 5, 3, 1, 2), "sim");
    expect(found.map(({ stage }) => stage)).toEqual(["reception", "waiting", "computation", "publication"]);
    expect(found.map(({ took }) => took)).toEqual([1, 0.5, 0, 0.25]);
    expect(found.map(({ from }) => from)).toEqual([0, 1, 1.5, 1.5]);
  });
  test("without a timed frame there is none", () => {
    expect(stages(reading(2, 1, 1, 1, 1), reading(2, 1, 1, 1, 1), "sim")).toEqual([]);
    expect(stages(parseMetrics(""), parseMetrics(""), "sim")).toEqual([]);
  });
});
