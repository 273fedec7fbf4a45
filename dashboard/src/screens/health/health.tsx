/** Health: readiness, devices and links, losses by where, load, runs, log. */

import { api, type Schemas, sent } from "../../api/client";
import { devices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { bytes, significant, time } from "../../ui/format";
import { Action, Badge, Failure, Panel, Table, Why } from "../../ui/parts";
import { Load } from "./load";
import { LogLines } from "./log_lines";
import { kindOf, remoteStations } from "./stations";

type DeviceStatus = Schemas["DeviceStateDocument"];

interface Row {
  readonly id: string;
  readonly status: DeviceStatus;
  /** Frames per second since the last look; null at the first. */
  readonly rateHz: number | null;
}

export function Health() {
  return (
    <>
      <ServerState />
      <Stations />
      <Devices />
      <Load />
      <Runs />
      <LogLines />
    </>
  );
}

function ServerState() {
  const ready = usePolled("readyz", () => sent(api.GET("/readyz")), 3);
  // While it fails, the last answer is of before.
  const now = ready.error === null ? ready.value : null;
  return (
    <Panel title={text.health.server}>
      {now ? <Badge kind="good">{text.health.ready}</Badge> : null}
      {ready.error === null ? null : <Badge kind="bad">{text.health.notReady}</Badge>}
      <Failure message={ready.error} />
      {now?.limits.length ? (
        <ul>
          {now.limits.map((limit) => (
            <li key={limit}>{limit}</li>
          ))}
        </ul>
      ) : null}
    </Panel>
  );
}

/** Nothing where all devices are this server's own. */
function Stations() {
  const stations = usePolled("stations", () => sent(api.GET("/api/v1/stations", { params: { query: { limit: 100 } } })), 2);
  const rows = remoteStations(stations.value?.items ?? []);
  if (!rows.length) return null;
  return (
    <Panel title={text.health.stations}>
      <Failure message={stations.error} />
      <p class="muted">{text.health.stationsHelp}</p>
      <Table
        caption={text.health.stations}
        columns={[text.health.station, text.column.state, text.column.reason, text.health.sinceWhen, text.health.machine, text.health.devicesOf, text.health.roundTrip, text.health.memory, text.health.notes]}
        rows={rows}
        identity={({ name }) => name ?? ""}
        empty={text.missing}
        row={(station) => [
          station.name,
          <Badge kind={kindOf(station)}>{station.state}</Badge>,
          station.reason ?? "",
          time(station.changed_at),
          station.host ?? text.missing,
          station.devices,
          significant(station.round_trip_ms, 2),
          bytes(station.memory_bytes),
          `${text.health.restarts(station.restarts)}, ${text.health.busMissed(station.messages_missed)}`,
        ]}
      />
    </Panel>
  );
}

const last = new Map<string, { frames: number; at: number }>();

/** Null: it is not known yet which devices there are. */
async function statuses(): Promise<readonly Row[] | null> {
  if (devices.value === null) return null;
  return Promise.all(
    devices.value.map(async ({ id }) => {
      const status = await sent(
        api.GET("/api/v1/devices/{device_id}/state", { params: { path: { device_id: id } } }),
      );
      const now = performance.now();
      const before = last.get(id);
      last.set(id, { frames: status.frames_received, at: now });
      const rateHz = before && now > before.at ? ((status.frames_received - before.frames) * 1000) / (now - before.at) : null;
      return { id, status, rateHz: rateHz === null || rateHz < 0 ? null : rateHz };
    }),
  );
}

function Devices() {
  const rows = usePolled(`statuses ${devices.value?.map(({ id }) => id).join()}`, statuses, 2);
  return (
    <Panel title={text.health.devices}>
      <Failure message={rows.error} />
      <Table
        caption={text.health.devices}
        columns={[text.column.device, text.column.state, text.column.reason, text.column.rate, text.column.frames, text.column.lostDevice, text.column.dropped, text.column.subscribers, text.column.link, text.column.clock, text.health.clockRate, text.health.temperature, text.column.calibration]}
        rows={rows.value ?? []}
        identity={({ id }) => id}
        empty={rows.value ? text.device.none : text.loading}
        row={({ id, status, rateHz }) => [
          id,
          <Badge kind={status.state === "running" ? "good" : ["failed", "disconnected"].includes(status.state) ? "bad" : "idle"}>
            {status.state}
          </Badge>,
          status.reason ?? status.link?.reason ?? "",
          significant(rateHz, 3),
          status.frames_received,
          status.frames_lost,
          status.frames_dropped_compute,
          status.subscribers,
          status.link?.state ?? text.missing,
          significant(status.link?.clock_uncertainty_us, 2),
          significant(status.link?.clock_rate_ppm, 3),
          significant(status.link?.temperature_c, 3),
          status.calibration_id ?? text.missing,
        ]}
      />
      <p class="muted">{text.health.clockHelp}</p>
    </Panel>
  );
}

function Runs() {
  const runs = usePolled("runs", () => sent(api.GET("/api/v1/runs", { params: { query: { limit: 20 } } })), 2);
  return (
    <Panel title={text.health.runs}>
      <Failure message={runs.error} />
      <Table
        caption={text.health.runs}
        columns={[text.column.run, text.column.kind, text.column.device, text.column.state, text.column.progress, text.column.created, text.column.action]}
        rows={runs.value?.items ?? []}
        identity={({ id }) => id}
        empty={runs.value ? text.health.noRuns : text.loading}
        row={(run) => [
          run.id,
          run.kind,
          run.device_id,
          <>
            <Badge kind={run.state === "succeeded" ? "good" : run.state === "failed" ? "bad" : "idle"}>{run.state}</Badge>
            <Why reason={run.problem?.detail} />
          </>,
          <progress max={1} value={run.progress} aria-label={text.column.progress} />,
          time(run.created_at),
          run.state === "queued" || run.state === "running" ? (
            <Action
              label={text.health.cancel}
              operation="POST /api/v1/runs/{run_id}/cancel"
              run={() => sent(api.POST("/api/v1/runs/{run_id}/cancel", { params: { path: { run_id: run.id } } }))}
              done={runs.refresh}
            />
          ) : null,
        ]}
      />
    </Panel>
  );
}
