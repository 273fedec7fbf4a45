/** A sensor's scan, small: a button that picks the sensor. */

import { useEffect, useRef } from "preact/hooks";
import { text } from "../../text";
import { colour } from "../../ui/colour";
import { Badge } from "../../ui/parts";
import type { Scan } from "./scan_data";

const WIDTH = 220;
const HEIGHT = 56;

export function Thumbnail(props: { scan: Scan; picked: boolean; pick: () => void }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const { scan } = props;
  useEffect(() => {
    if (canvas.current) draw(canvas.current, scan);
  }, [scan, props.picked]);
  return (
    <button type="button" class="thumbnail" aria-pressed={props.picked} onClick={props.pick}>
      <span class="row">
        <strong>{scan.sensor}</strong>
        <span>{text.scans.peakCount(scan.peaks.length)}</span>
        {scan.saturated_pixels ? <Badge kind="bad">{text.scans.saturated}</Badge> : null}
      </span>
      <canvas ref={canvas} width={WIDTH} height={HEIGHT} aria-hidden="true" />
    </button>
  );
}

/** Draw each column's lowest and highest count: no peak falls between two columns. */
function draw(canvas: HTMLCanvasElement, scan: Scan): void {
  const context = canvas.getContext("2d");
  if (!context) return;
  context.clearRect(0, 0, WIDTH, HEIGHT);
  const columns = Array.from({ length: WIDTH }, (_, column) => {
    const from = Math.floor((column * scan.counts.length) / WIDTH);
    const until = Math.max(from + 1, Math.floor(((column + 1) * scan.counts.length) / WIDTH));
    const part = scan.counts.slice(from, until);
    return [Math.min(...part), Math.max(...part)] as const;
  });
  const low = Math.min(scan.background_counts, ...columns.map(([lowest]) => lowest));
  const high = Math.max(scan.threshold_counts ?? 0, low + 1, ...columns.map(([, highest]) => highest));
  const y = (value: number) => HEIGHT - 2 - ((value - low) / (high - low)) * (HEIGHT - 4);
  context.strokeStyle = getComputedStyle(canvas).color;
  context.beginPath();
  columns.forEach(([lowest, highest], column) => {
    context.moveTo(column + 0.5, y(lowest) + 0.5);
    context.lineTo(column + 0.5, y(highest) - 0.5);
  });
  context.stroke();
  context.fillStyle = colour("good");
  for (const peak of scan.peaks) context.fillRect((peak.position_px * WIDTH) / scan.counts.length - 1, 0, 2, 5);
}
