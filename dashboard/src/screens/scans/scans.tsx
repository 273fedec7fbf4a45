/** Scans: each sensor's pixels live, with levels, peaks and fits; freeze, zoom, save. */

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { allowed, scopeOf } from "../../api/session";
import { device, type Device } from "../../devices";
import { text } from "../../text";
import { download, toCsv } from "../../ui/download";
import { significant, timeOfDay, withSigma } from "../../ui/format";
import { NoDevice } from "../../ui/no_device";
import { Badge, Panel, Table } from "../../ui/parts";
import { useLiveScans } from "./live_scans";
import { aroundPeak, csvRows, fileName, type Scan, type Scans, type Vertical, zoomed } from "./scan_data";
import { ScopePlot } from "./scope_plot";
import { Thumbnail } from "./thumbnail";

const VERTICALS: readonly Vertical[] = ["scan", "full", "background"];
const OPERATION = "GET /api/v1/devices/{device_id}/scans";

export function ScansScreen() {
  const shown = device.value;
  if (!shown) return <NoDevice />;
  if (!allowed(OPERATION)) return <p class="muted">{text.access.notAllowed(scopeOf(OPERATION))}</p>;
  return <DeviceScans key={shown.id} shown={shown} />;
}

function DeviceScans({ shown }: { shown: Device }) {
  const live = useLiveScans(shown.id, shown.sensors[0]?.name ?? "");
  const scans = live.scans.value;
  const scan = scans?.scans.find(({ sensor }) => sensor === live.sensor.value) ?? scans?.scans[0] ?? null;
  const markers = useRef(new Set<number>());
  if (scans?.marker != null) markers.current.add(scans.marker);
  return (
    <>
      <Panel
        title={text.screens.scans}
        actions={
          <>
            <label>
              {text.scans.trigger}{" "}
              <select
                value={live.marker.value ?? ""}
                onChange={({ currentTarget: { value } }) => (live.marker.value = value === "" ? null : Number(value))}
              >
                <option value="">{text.scans.anyExposure}</option>
                {[...markers.current].sort((a, b) => a - b).map((marker) => (
                  <option key={marker} value={marker}>
                    {text.scans.marker(marker)}
                  </option>
                ))}
              </select>
            </label>
            <button
              type="button"
              class="primary"
              aria-pressed={live.frozen.value}
              onClick={() => (live.frozen.value = !live.frozen.value)}
            >
              {live.frozen.value ? text.scans.run : text.scans.freeze}
            </button>
            <button type="button" disabled={!live.frozen.value} onClick={() => void live.next()}>
              {text.scans.next}
            </button>
          </>
        }
      >
        <div class="under">
          {live.error.value ? (
            <p class="banner bad over" role="alert">
              {`${live.error.value} ${scans ? text.scans.old : ""}`}
            </p>
          ) : null}
          {scans ? (
            <ScansPicture scans={scans} sensor={live.sensor.value} pick={(sensor) => (live.sensor.value = sensor)} />
          ) : (
            <p class="muted tall">{text.loading}</p>
          )}
        </div>
        {live.frozen.value && scans?.method === "fit" && scan && !scan.windows ? (
          // The exposure is gone by now: the fits of another sensor cannot be had any more.
          <p class="muted">{text.scans.noFit}</p>
        ) : null}
      </Panel>
    </>
  );
}

/** An exposure: all sensors small, the picked one large with its numbers. */
export function ScansPicture(props: { scans: Scans; sensor: string; pick: (sensor: string) => void }) {
  const { scans } = props;
  const scan = scans.scans.find(({ sensor }) => sensor === props.sensor) ?? scans.scans[0];
  if (!scan) return null;
  return (
    <>
      <div class="thumbnails" role="group" aria-label={text.column.sensors}>
        {scans.scans.map((one) => (
          <Thumbnail key={one.sensor} scan={one} picked={one === scan} pick={() => props.pick(one.sensor)} />
        ))}
      </div>
      <Scope scans={scans} scan={scan} />
    </>
  );
}

function Scope({ scans, scan }: { scans: Scans; scan: Scan }) {
  const host = useRef<HTMLDivElement>(null);
  const plot = useRef<ScopePlot | null>(null);
  const vertical = useSignal<Vertical>("scan");
  const pixels = scan.counts.length;
  const range = useSignal<[number, number]>([0, pixels - 1]);
  /** A peak that is zoomed to is followed: its marker may move. */
  const followed = useSignal<number | null>(null);
  const choose = (chosen: [number, number]) => {
    followed.value = null;
    range.value = chosen;
  };
  useEffect(() => {
    if (!host.current) return undefined;
    plot.current = new ScopePlot(host.current, (chosen) => choose(zoomed(chosen, 1, 0, pixels)));
    return () => {
      plot.current?.close();
      plot.current = null;
    };
  }, []);
  useEffect(() => choose([0, pixels - 1]), [scan.sensor, pixels]);
  useEffect(() => {
    const peak = followed.value === null ? undefined : scan.peaks[followed.value];
    if (peak) range.value = aroundPeak(peak.position_px, peak.width_px, pixels);
  }, [scan, followed.value]);
  useEffect(() => plot.current?.show(scan, vertical.value, range.value), [scan, vertical.value, range.value]);
  const move = (factor: number, shift: number) => choose(zoomed(range.value, factor, shift, pixels));
  const heading = `${scans.device_id}, ${scan.sensor}: ${text.scans.exposure(scans.sequence)}`;
  return (
    <>
      <div ref={host} class="scope" role="img" aria-label={`${scan.sensor}: ${text.scans.peakCount(scan.peaks.length)}`} />
      <div class="row controls">
        <div class="row" role="group" aria-label={text.scans.zoom}>
          <button type="button" onClick={() => move(0.5, 0)} aria-label={text.scans.zoomIn}>+</button>
          <button type="button" onClick={() => move(2, 0)} aria-label={text.scans.zoomOut}>−</button>
          <button type="button" onClick={() => move(1, -0.25)} aria-label={text.scans.left}>◀</button>
          <button type="button" onClick={() => move(1, 0.25)} aria-label={text.scans.right}>▶</button>
          <button type="button" onClick={() => choose([0, pixels - 1])}>{text.scans.whole}</button>
        </div>
        <label>
          {text.scans.vertical}{" "}
          <select value={vertical.value} onChange={({ currentTarget }) => (vertical.value = currentTarget.value as Vertical)}>
            {VERTICALS.map((one) => (
              <option key={one} value={one}>
                {text.scans.verticals[one]}
              </option>
            ))}
          </select>
        </label>
        <button type="button" onClick={() => download(new Blob([toCsv(csvRows(scans))], { type: "text/csv" }), fileName(scans, "csv"))}>
          {text.scans.saveCsv}
        </button>
        <button
          type="button"
          onClick={async () => {
            const picture = await plot.current?.picture(heading);
            if (picture) download(picture, fileName(scans, "png"));
          }}
        >
          {text.scans.savePng}
        </button>
      </div>
      <Levels scans={scans} scan={scan} />
      <Peaks scan={scan} pick={(peak) => (followed.value = peak)} />
    </>
  );
}

function Levels({ scans, scan }: { scans: Scans; scan: Scan }) {
  const rows: [string, string][] = [
    [text.scans.background, `${significant(scan.background_counts, 4)} ± ${significant(scan.noise_counts, 2)}`],
    [text.scans.threshold, significant(scan.threshold_counts, 4)],
    [text.scans.saturatedPixels, text.scans.ofFullScale(scan.saturated_pixels, scan.full_scale_counts)],
    [text.scans.masked, String(scan.masked_pixels.length)],
    [text.scans.methodName, scans.method ? text.scans.methods[scans.method] : text.scans.noMethod],
    [text.scans.exposureName, `${scans.sequence}${scans.marker === null ? "" : `, ${text.scans.marker(scans.marker)}`}, ${timeOfDay(scans.exposure_ns / 1e6)}`],
  ];
  return (
    <dl class="numbers">
      {rows.map(([name, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}

function Peaks({ scan, pick }: { scan: Scan; pick: (peak: number) => void }) {
  const rows = scan.peaks.map((peak, index) => ({ peak, number: index + 1 }));
  return (
    <Table
      caption={text.scans.peaks}
      columns={[text.scans.peak, text.scans.position, text.light.sigma, text.light.amplitude, text.scans.width, text.calibrate.chi2, text.column.flags]}
      rows={rows}
      identity={({ number }) => number}
      select={(number) => pick(Number(number) - 1)}
      empty={text.scans.noPeaks}
      row={({ peak, number }) => [
        text.scans.zoomTo(number),
        withSigma(peak.position_px, peak.sigma_px),
        significant(peak.sigma_px, 2),
        significant(peak.amplitude, 4),
        significant(peak.width_px, 3),
        significant(peak.reduced_chi2, 2),
        peak.flags.map((flag) => <Badge kind={flag === "joint" ? "idle" : "warn"}>{flag}</Badge>),
      ]}
    />
  );
}
