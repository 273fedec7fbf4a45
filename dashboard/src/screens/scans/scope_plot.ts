/** One scan drawn as an oscilloscope shows it, and below it the residuals of its fits. */

import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { text } from "../../text";
import { colour, onSchemeChange } from "../../ui/colour";
import { significant } from "../../ui/format";
import { fittedLine, type Scan, verticalRange, type Vertical } from "./scan_data";

const RESIDUAL_HEIGHT = 130;
const LEVEL_FONT = "12px system-ui, sans-serif";
/** Below so many pixels in view each has its dot. */
const DOTTED_PX = 200;
const MIN_RESIDUAL = 4;

export class ScopePlot {
  private readonly counts: uPlot;
  private readonly residuals: uPlot;
  private scan: Scan | null = null;
  private vertical: Vertical = "scan";
  private range: [number, number] | null = null;
  private readonly observer: ResizeObserver;
  private readonly endRecolouring = onSchemeChange(() => this.redraw());

  /** `zoomedTo` hears of a range that was chosen with the mouse. */
  constructor(
    private readonly host: HTMLElement,
    private readonly zoomedTo: (range: [number, number]) => void,
  ) {
    this.counts = new uPlot(this.options("counts"), [[], [], []], host);
    this.residuals = new uPlot(this.options("residuals"), [[], []], host);
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(host);
    this.resize();
  }

  close(): void {
    this.observer.disconnect();
    this.endRecolouring();
    this.counts.destroy();
    this.residuals.destroy();
  }

  show(scan: Scan, vertical: Vertical, range: [number, number]): void {
    this.scan = scan;
    this.vertical = vertical;
    this.range = range;
    const pixel = scan.counts.map((_, index) => index);
    const { model, residual } = fittedLine(scan);
    this.counts.setData([pixel, scan.counts, model], false);
    this.residuals.setData([pixel, residual], false);
    this.rescale();
  }

  /** Return the picture, on the page's own ground, with a heading. */
  picture(heading: string): Promise<Blob> {
    const parts = [this.counts, this.residuals].map((plot) => plot.ctx.canvas);
    const canvas = document.createElement("canvas");
    const ratio = devicePixelRatio;
    const top = 34 * ratio;
    canvas.width = Math.max(...parts.map((part) => part.width));
    canvas.height = top + parts.reduce((sum, part) => sum + part.height, 0);
    const context = canvas.getContext("2d") as CanvasRenderingContext2D;
    context.fillStyle = colour("panel");
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = colour("text");
    context.font = `${15 * ratio}px system-ui, sans-serif`;
    context.fillText(heading, 12 * ratio, 22 * ratio);
    let y = top;
    for (const part of parts) {
      context.drawImage(part, 0, y);
      y += part.height;
    }
    return new Promise((resolve, reject) =>
      canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("no picture"))), "image/png"),
    );
  }

  private redraw(): void {
    this.counts.redraw(false);
    this.residuals.redraw(false);
  }

  private rescale(): void {
    if (!this.scan || !this.range) return;
    const [min, max] = this.range;
    const [low, high] = verticalRange(this.scan, this.vertical);
    this.counts.batch(() => {
      this.counts.setScale("x", { min, max });
      this.counts.setScale("y", { min: low, max: high });
    });
    const shown = this.residuals.data[1] as (number | null)[];
    const largest = shown.reduce((most: number, value) => Math.max(most, Math.abs(value ?? 0)), MIN_RESIDUAL);
    this.residuals.batch(() => {
      this.residuals.setScale("x", { min, max });
      this.residuals.setScale("y", { min: -1.1 * largest, max: 1.1 * largest });
    });
    this.redraw();
  }

  private resize(): void {
    const width = Math.max(200, this.host.clientWidth);
    const height = Math.max(160, Math.min(360, 0.42 * innerHeight));
    this.counts.setSize({ width, height });
    this.residuals.setSize({ width, height: RESIDUAL_HEIGHT });
    this.rescale();
  }

  private options(kind: "counts" | "residuals"): uPlot.Options {
    const axis = (label: string, size: number): uPlot.Axis => ({
      label,
      labelSize: 18,
      size,
      labelFont: LEVEL_FONT,
      font: LEVEL_FONT,
      stroke: () => colour("muted"),
      grid: { stroke: () => colour("line"), width: 1 },
      ticks: { stroke: () => colour("line"), width: 1, size: 4 },
    });
    const dots = (plot: uPlot): boolean => this.scan !== null && (plot.scales["x"]?.max ?? 0) - (plot.scales["x"]?.min ?? 0) < DOTTED_PX;
    const pixels: uPlot.Series = { label: text.scans.pixel };
    const counts = kind === "counts";
    return {
      width: 400,
      height: 200,
      scales: { x: { time: false, auto: false }, y: { auto: false } },
      axes: [axis(counts ? "" : text.scans.pixel, counts ? 24 : 26), axis(counts ? text.scans.counts : text.scans.residual, 44)],
      series: counts
        ? [
            pixels,
            { label: text.scans.counts, stroke: () => colour("text"), width: 1, points: { show: dots, size: 4 } },
            { label: text.scans.model, stroke: () => colour("accent"), width: 2, points: { show: false } },
          ]
        : [pixels, { label: text.scans.residual, stroke: () => colour("accent"), width: 1, points: { show: true, size: 4 } }],
      legend: { show: counts },
      cursor: { drag: { x: true, y: false, setScale: false }, sync: { key: "scans" } },
      hooks: {
        setSelect: [(plot) => this.select(plot)],
        drawClear: counts ? [(plot) => this.drawLevels(plot)] : [(plot) => this.drawBand(plot)],
        draw: counts ? [(plot) => this.drawPeaks(plot)] : [],
      },
    };
  }

  private select(plot: uPlot): void {
    if (plot.select.width < 4) return;
    const ends = [plot.posToVal(plot.select.left, "x"), plot.posToVal(plot.select.left + plot.select.width, "x")] as const;
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.zoomedTo([ends[0], ends[1]]);
  }

  private drawLevels(plot: uPlot): void {
    const scan = this.scan;
    if (!scan) return;
    const levels: [number | null, string, "muted" | "warn" | "bad", number[]][] = [
      [scan.background_counts, text.scans.background, "muted", []],
      [scan.threshold_counts, text.scans.threshold, "warn", [6, 4]],
      [scan.full_scale_counts, text.scans.fullScale, "bad", [2, 3]],
    ];
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    for (const [level, name, kind, dash] of levels) {
      if (level === null || level < (plot.scales["y"]?.min ?? 0) || level > (plot.scales["y"]?.max ?? 0)) continue;
      const y = plot.valToPos(level, "y", true);
      ctx.strokeStyle = ctx.fillStyle = colour(kind);
      ctx.lineWidth = devicePixelRatio;
      ctx.setLineDash(dash.map((part) => part * devicePixelRatio));
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
      // The background's name goes to the other end of its line: the threshold's may be close above.
      ctx.textAlign = kind === "muted" ? "left" : "right";
      const x = kind === "muted" ? bbox.left + 4 : bbox.left + bbox.width - 4;
      ctx.fillText(`${name} ${significant(level, 4)}`, x, y - 4 * devicePixelRatio);
    }
    ctx.restore();
  }

  /** Peaks with a band of their standard deviation, saturated and masked pixels. */
  private drawPeaks(plot: uPlot): void {
    const scan = this.scan;
    if (!scan) return;
    const { ctx, bbox } = plot;
    const at = (pixel: number) => plot.valToPos(pixel, "x", true);
    const inside = (pixel: number) => pixel >= (plot.scales["x"]?.min ?? 0) && pixel <= (plot.scales["x"]?.max ?? 0);
    ctx.save();
    ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "center";
    scan.peaks.forEach((peak, number) => {
      if (!inside(peak.position_px)) return;
      const kind = peak.flags.some((flag) => flag !== "joint") ? "bad" : "good";
      ctx.strokeStyle = ctx.fillStyle = colour(kind);
      ctx.lineWidth = devicePixelRatio;
      const x = at(peak.position_px);
      const sigma = peak.sigma_px ?? 0;
      ctx.globalAlpha = 0.25;
      ctx.fillRect(at(peak.position_px - sigma), bbox.top, at(peak.position_px + sigma) - at(peak.position_px - sigma), bbox.height);
      ctx.globalAlpha = 1;
      ctx.beginPath();
      ctx.moveTo(x, bbox.top + 14 * devicePixelRatio);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      ctx.fillText(String(number + 1), x, bbox.top + 11 * devicePixelRatio);
    });
    ctx.fillStyle = colour("bad");
    const size = 5 * devicePixelRatio;
    scan.counts.forEach((value, pixel) => {
      if (value < scan.full_scale_counts || !inside(pixel)) return;
      ctx.fillRect(at(pixel) - size / 2, plot.valToPos(value, "y", true) - size / 2, size, size);
    });
    for (const pixel of scan.masked_pixels)
      if (inside(pixel)) ctx.fillText("×", at(pixel), bbox.top + bbox.height - 3 * devicePixelRatio);
    ctx.restore();
  }

  /** One standard deviation to both sides: two thirds of the residuals lie in it. */
  private drawBand(plot: uPlot): void {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.fillStyle = colour("line");
    ctx.globalAlpha = 0.5;
    const top = plot.valToPos(1, "y", true);
    ctx.fillRect(bbox.left, top, bbox.width, plot.valToPos(-1, "y", true) - top);
    ctx.restore();
  }
}
