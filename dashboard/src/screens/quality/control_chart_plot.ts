/** One control chart: values, their weighted average, the limits, and the signals. */

import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import type { Schemas } from "../../api/client";
import { colour, onSchemeChange } from "../../ui/colour";
import { text } from "../../text";
import { chartRange, toSeconds } from "./quality_data";

export type Chart = Schemas["Chart"];
const HEIGHT = 170;
const FONT = "12px system-ui, sans-serif";

export class ControlChartPlot {
  private readonly plot: uPlot;
  private chart: Chart;
  private readonly observer: ResizeObserver;
  private readonly endRecolouring = onSchemeChange(() => this.plot.redraw(false));

  constructor(host: HTMLElement, chart: Chart) {
    this.chart = chart;
    const axis = (size: number): uPlot.Axis => ({
      size,
      font: FONT,
      stroke: () => colour("muted"),
      grid: { stroke: () => colour("line"), width: 1 },
      ticks: { stroke: () => colour("line"), width: 1, size: 4 },
    });
    this.plot = new uPlot(
      {
        width: 300,
        height: HEIGHT,
        // A single value has no range of times of its own.
        scales: {
          x: { time: true, range: (_, min, max) => (max > min ? [min, max] : [min - 60, max + 60]) },
          y: { range: () => chartRange(this.chart) },
        },
        axes: [axis(46), axis(56)],
        series: [
          {},
          { label: text.quality.value, stroke: () => colour("text"), width: 0, points: { show: true, size: 5 } },
          { label: text.quality.average, stroke: () => colour("accent"), width: 2, points: { show: false } },
        ],
        legend: { show: false },
        cursor: { drag: { x: false, y: false } },
        hooks: { drawClear: [() => this.drawLimits()], draw: [() => this.drawSignals()] },
      },
      [[], [], []],
      host,
    );
    this.observer = new ResizeObserver(() => this.plot.setSize({ width: Math.max(200, host.clientWidth), height: HEIGHT }));
    this.observer.observe(host);
    this.show(chart);
  }

  show(chart: Chart): void {
    // By time: a clock that was set back would break the picture.
    const points = [...chart.points].sort((a, b) => toSeconds(a.measured_at) - toSeconds(b.measured_at));
    this.chart = chart;
    const of = (read: (point: Chart["points"][number]) => number) => points.map(read);
    this.plot.setData([of((point) => toSeconds(point.measured_at)), of((point) => point.value), of((point) => point.average)]);
  }

  close(): void {
    this.observer.disconnect();
    this.endRecolouring();
    this.plot.destroy();
  }

  private drawLimits(): void {
    const { lower, upper, centre } = this.chart;
    if (lower === null || upper === null || centre === null) return;
    const { ctx, bbox } = this.plot;
    const y = (value: number) => this.plot.valToPos(value, "y", true);
    ctx.save();
    ctx.fillStyle = ctx.strokeStyle = colour("good");
    ctx.globalAlpha = 0.12;
    ctx.fillRect(bbox.left, y(upper), bbox.width, y(lower) - y(upper));
    ctx.globalAlpha = 0.8;
    ctx.setLineDash([6, 4]);
    for (const level of [lower, centre, upper]) {
      ctx.beginPath();
      ctx.moveTo(bbox.left, y(level));
      ctx.lineTo(bbox.left + bbox.width, y(level));
      ctx.stroke();
    }
    ctx.restore();
  }

  private drawSignals(): void {
    const { ctx } = this.plot;
    ctx.save();
    ctx.lineWidth = 2 * devicePixelRatio;
    for (const point of this.chart.points) {
      if (point.signal === "none") continue;
      ctx.strokeStyle = colour(point.signal === "jump" ? "bad" : "warn");
      ctx.beginPath();
      ctx.arc(this.plot.valToPos(toSeconds(point.measured_at), "x", true), this.plot.valToPos(point.value, "y", true), 7 * devicePixelRatio, 0, 2 * Math.PI);
      ctx.stroke();
    }
    ctx.restore();
  }
}
