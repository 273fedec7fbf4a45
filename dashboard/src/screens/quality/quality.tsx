/** Quality: is the device as good as it was? Charts, checks, drift, and what to do. */

import { useEffect, useRef } from "preact/hooks";
import { api, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import { device, type Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { significant } from "../../ui/format";
import { NoDevice } from "../../ui/no_device";
import { Badge, Failure, Panel } from "../../ui/parts";
import { type Chart, ControlChartPlot } from "./control_chart_plot";
import { DriftChecks } from "./drift_checks";
import { QuickChecks } from "./quick_checks";
import { KINDS, lastSignal } from "./quality_data";
import { Watch } from "./watch";

const OPERATION = "GET /api/v1/devices/{device_id}/quality";

export function QualityScreen() {
  const shown = device.value;
  if (!shown) return <NoDevice />;
  if (!allowed(OPERATION)) return <p class="muted">{text.access.notAllowed(scopeOf(OPERATION))}</p>;
  return <DeviceQuality key={shown.id} shown={shown} />;
}

function DeviceQuality({ shown }: { shown: Device }) {
  const path = { path: { device_id: shown.id } };
  const polled = usePolled(`quality ${shown.id}`, () => sent(api.GET("/api/v1/devices/{device_id}/quality", { params: path })), 5);
  const quality = polled.value;
  return (
    <>
      <Panel title={text.quality.verdict}>
        <Failure message={polled.error} />
        {quality ? (
          <>
            <p class="verdict">
              <Badge kind={KINDS[quality.recommendation]}>{text.quality.recommendations[quality.recommendation]}</Badge>{" "}
              {text.quality.advice[quality.recommendation]}
            </p>
            <ul>
              {quality.reasons.map((reason) => (
                <li key={reason}>{reason}</li>
              ))}
            </ul>
            <p class="muted">{text.quality.with(quality.calibration_id ?? text.missing, quality.table_id)}</p>
          </>
        ) : (
          <p class="muted">{text.loading}</p>
        )}
      </Panel>
      <Panel title={text.quality.charts}>
        {quality?.charts.length ? (
          <div class="charts">
            {quality.charts.map((chart) => (
              <ChartPicture key={chart.series} chart={chart} />
            ))}
          </div>
        ) : (
          <p class="muted">{quality ? text.quality.noCharts : text.loading}</p>
        )}
      </Panel>
      <Watch device={shown} changed={polled.refresh} />
      <QuickChecks device={shown} made={polled.refresh} />
      <DriftChecks device={shown} calibration={quality?.calibration_id ?? null} />
    </>
  );
}

function ChartPicture({ chart }: { chart: Chart }) {
  const host = useRef<HTMLDivElement>(null);
  const plot = useRef<ControlChartPlot | null>(null);
  useEffect(() => {
    if (!host.current) return undefined;
    plot.current = new ControlChartPlot(host.current, chart);
    return () => plot.current?.close();
  }, []);
  useEffect(() => plot.current?.show(chart), [chart]);
  const last = chart.points.at(-1);
  const signal = lastSignal(chart);
  return (
    <figure>
      <figcaption>
        <strong>{chart.meaning}</strong> {`[${chart.unit}]: ${significant(last?.value, 3)} `}
        {signal ? <Badge kind={signal === "jump" ? "bad" : "warn"}>{text.quality.signals[signal]}</Badge> : null}
        {chart.ready ? (
          <span class="muted">{text.quality.limits(significant(chart.lower, 3), significant(chart.upper, 3))}</span>
        ) : (
          <span class="muted">{text.quality.notReady(chart.points.length, chart.baseline)}</span>
        )}
      </figcaption>
      <div ref={host} role="img" aria-label={`${chart.meaning}: ${significant(last?.value, 3)} ${chart.unit}`} />
    </figure>
  );
}
