/** How long frames and requests take, who receives them, and what room is left. */

import { useRef } from "preact/hooks";
import { api, fetchBlob, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import { devices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { bytes, significant, time } from "../../ui/format";
import { Badge, Failure, Panel, Table } from "../../ui/parts";
import { grown, latencies, type LatencyClass, type Metrics, parseMetrics, quantile, requests, type StageTime, stages, valueOf } from "./metrics";

const EVERY_S = 3;
/** What is shown is of about so many readings back. */
const READINGS = 5;

interface Reading {
  readonly at: number;
  readonly metrics: Metrics;
}

export function Load() {
  const readings = useRef<Reading[]>([]);
  const polled = usePolled(
    "metrics",
    async () => {
      const metrics = parseMetrics(await (await fetchBlob("/metrics")).text());
      readings.current = [...readings.current.slice(-READINGS), { at: performance.now(), metrics }];
      return performance.now();
    },
    EVERY_S,
  );
  if (!allowed("GET /metrics")) return <p class="muted">{text.access.notAllowed(scopeOf("GET /metrics"))}</p>;
  const [first, last] = [readings.current[0], readings.current.at(-1)];
  if (!first || !last || first === last)
    return (
      <Panel title={text.health.latency}>
        <Failure message={polled.error} />
        <p class="muted">{text.loading}</p>
      </Panel>
    );
  const seconds = (last.at - first.at) / 1000;
  return (
    <>
      <Panel title={text.health.latency}>
        <Failure message={polled.error} />
        <p class="muted">{text.health.latencyHelp(significant(seconds, 2))}</p>
        <div class="charts">
          {devices.value?.map(({ id }) => (
            <div key={id}>
              <Latency device={id} classes={latencies(first.metrics, last.metrics, id)} />
              <Waterfall device={id} stages={stages(first.metrics, last.metrics, id)} />
            </div>
          ))}
        </div>
      </Panel>
      <Losses before={first.metrics} after={last.metrics} seconds={seconds} />
      <Clients before={first.metrics} after={last.metrics} seconds={seconds} />
      <Processes before={first.metrics} after={last.metrics} seconds={seconds} />
      <Resources metrics={last.metrics} />
    </>
  );
}

function milliseconds(duration: number | null): string {
  if (duration === null) return text.missing;
  return Number.isFinite(duration) ? `${significant(1000 * duration, 2)} ms` : text.health.longer;
}

function Latency({ device, classes }: { device: string; classes: readonly LatencyClass[] }) {
  const total = classes.reduce((sum, { count }) => sum + count, 0);
  if (!total) return null;
  return (
    <figure>
      <figcaption>
        <strong>{device}</strong>{" "}
        {text.health.quantiles(...([0.5, 0.95, 0.99] as const).map((share) => milliseconds(quantile(classes, share))) as [string, string, string])}
      </figcaption>
      <Table
        caption={text.health.latencyOf(device)}
        columns={[text.health.upTo, text.health.share]}
        rows={classes.filter(({ count }, index) => count > 0 || (index < 8 && index > 0))}
        identity={({ to }) => String(to)}
        empty={text.missing}
        row={({ to, count }) => [
          milliseconds(to),
          <span class="row">
            <meter min={0} max={1} value={count / total} aria-label={milliseconds(to)} />
            {`${significant((100 * count) / total, 2)} %`}
          </span>,
        ]}
      />
    </figure>
  );
}

/** Where the time from exposure to stream goes: each stage begins where the one before ends. */
function Waterfall({ device, stages: found }: { device: string; stages: readonly StageTime[] }) {
  const total = found.reduce((sum, { took }) => sum + took, 0);
  if (!found.length) return null;
  const share = (value: number) => `${total > 0 ? (100 * value) / total : 0}%`;
  return (
    <Table
      caption={text.health.stagesOf(device)}
      columns={[text.health.stage, text.health.stageMean, text.health.stageWhen]}
      rows={found}
      identity={({ stage }) => stage}
      empty={text.missing}
      row={({ stage, from, took }) => [
        text.health.stages[stage],
        milliseconds(took),
        <span class="waterfall">
          <span style={{ marginLeft: share(from), width: share(took) }} />
        </span>,
      ]}
    />
  );
}

interface BetweenProps {
  before: Metrics;
  after: Metrics;
  seconds: number;
}

/** What is lost on a frame's way, in its order; link_... only of devices that are linked. */
const LOSSES = [
  "link_frames_garbled",
  "link_frames_incomplete",
  "frames_lost",
  "frames_dropped_compute",
  "frames_not_tracked",
  "recording_frames_dropped_writer",
  "stream_messages_missed",
] as const;

/** Where frames are lost: since the device started, and now. */
function Losses({ before, after, seconds }: BetweenProps) {
  const shown = (devices.value ?? []).filter(({ id }) => valueOf(after, "lumiline_frames_received_total", { device: id }) !== null);
  return (
    <Panel title={text.health.losses}>
      <p class="muted">{text.health.lossesHelp}</p>
      <Table
        caption={text.health.losses}
        columns={[text.column.device, ...LOSSES.map((name) => text.health.loss[name])]}
        rows={shown}
        identity={({ id }) => id}
        empty={devices.value === null ? text.loading : text.device.none}
        row={({ id }) => [
          id,
          ...LOSSES.map((name) => {
            const metric = `lumiline_${name}_total`;
            const count = valueOf(after, metric, { device: id });
            const rate = grown(before, after, metric, { device: id }) / seconds;
            return (
              <>
                {count ?? text.missing} {rate > 0 ? <Badge kind="bad">{text.health.behind(significant(rate, 2))}</Badge> : null}
              </>
            );
          }),
        ]}
      />
    </Panel>
  );
}

function Clients({ before, after, seconds }: BetweenProps) {
  return (
    <Panel title={text.health.clients}>
      <p class="muted">{text.health.clientsHelp}</p>
      <Table
        caption={text.health.clients}
        columns={[text.column.device, text.column.subscribers, text.health.messages, text.health.missed]}
        rows={(devices.value ?? []).filter(({ id }) => valueOf(after, "lumiline_stream_clients", { device: id }) !== null)}
        identity={({ id }) => id}
        empty={devices.value === null ? text.loading : text.device.none}
        row={({ id }) => {
          const missed = grown(before, after, "lumiline_stream_messages_missed_total", { device: id }) / seconds;
          return [
            id,
            valueOf(after, "lumiline_stream_clients", { device: id }),
            significant(grown(before, after, "lumiline_stream_messages_total", { device: id }) / seconds, 3),
            <Badge kind={missed > 0 ? "bad" : "good"}>{missed > 0 ? text.health.behind(significant(missed, 2)) : text.health.none}</Badge>,
          ];
        }}
      />
      <StreamClients />
      <Table
        caption={text.health.requests}
        columns={[text.health.requests, text.column.rate, text.health.mean]}
        rows={requests(before, after, seconds).slice(0, 8)}
        identity={({ route }) => route}
        empty={text.health.noRequests}
        row={({ route, perSecond, meanMs }) => [route, significant(perSecond, 2), `${significant(meanMs, 2)} ms`]}
      />
    </Panel>
  );
}

/** Who has the streams; a key without that scope sees the sums above only. */
function StreamClients() {
  const can = allowed("GET /api/v1/stream-clients");
  const clients = usePolled(
    `stream clients ${can}`,
    async () => (can ? await sent(api.GET("/api/v1/stream-clients", { params: { query: { limit: 200 } } })) : null),
    EVERY_S,
  );
  if (!can) return <p class="muted">{text.access.notAllowed(scopeOf("GET /api/v1/stream-clients"))}</p>;
  return (
    <>
      <Failure message={clients.error} />
      <Table
        caption={text.health.streamClients}
        columns={[text.health.client, text.column.device, text.health.content, text.column.rate, text.health.waiting, text.health.missed, text.column.started]}
        rows={clients.value?.items ?? []}
        identity={({ id }) => id}
        empty={clients.value ? text.health.noClients : text.loading}
        row={(one) => [
          one.client,
          one.device_id,
          `${one.content.join(", ")} (${one.mode}, ${one.encoding})`,
          one.rate_hz === null ? text.health.every : significant(one.rate_hz, 3),
          one.messages_waiting,
          <Badge kind={one.messages_missed ? "bad" : "good"}>{one.messages_missed || text.health.none}</Badge>,
          time(one.opened_at),
        ]}
      />
    </>
  );
}

interface Process {
  readonly name: string;
  readonly memory: number | null;
  readonly cpu: string;
  readonly notes: readonly string[];
  readonly bad: boolean;
}

/** The gateway, which is the process that answers, and the station, if devices have a process of their own. */
function Processes({ before, after, seconds }: BetweenProps) {
  const value = (name: string) => valueOf(after, name);
  const started = value("process_start_time_seconds");
  const restarts = value("lumiline_station_restarts_total") ?? 0;
  const missed = value("lumiline_station_messages_missed_total") ?? 0;
  const rows: Process[] = [
    {
      name: text.health.gateway,
      memory: value("process_resident_memory_bytes"),
      cpu: "process_cpu_seconds_total",
      notes: [text.health.files(value("process_open_fds")), text.health.since(started ? time(new Date(1000 * started).toISOString()) : text.missing)],
      bad: false,
    },
  ];
  if (value("lumiline_station_memory_bytes") !== null)
    rows.push({
      name: text.health.station,
      memory: value("lumiline_station_memory_bytes"),
      cpu: "lumiline_station_cpu_seconds_total",
      notes: [text.health.restarts(restarts), text.health.busMissed(missed)],
      bad: restarts > 0 || missed > 0,
    });
  return (
    <Panel title={text.health.processes}>
      <p class="muted">{rows.length > 1 ? text.health.processesHelp : text.health.oneProcess}</p>
      <Table
        caption={text.health.processes}
        columns={[text.health.process, text.health.memory, text.health.cores, text.health.notes]}
        rows={rows}
        identity={({ name }) => name}
        empty={text.missing}
        row={({ name, memory, cpu, notes, bad }) => [
          name,
          memory === null ? text.missing : bytes(memory),
          significant(grown(before, after, cpu) / seconds, 2),
          <Badge kind={bad ? "bad" : "idle"}>{notes.join(", ")}</Badge>,
        ]}
      />
    </Panel>
  );
}

function Resources({ metrics }: { metrics: Metrics }) {
  const room = valueOf(metrics, "lumiline_recordings_free_bytes");
  const backup = valueOf(metrics, "lumiline_last_backup_timestamp_seconds");
  const rows: [string, string][] = [
    [text.health.room, room === null ? text.missing : bytes(room)],
    [text.health.backup, backup ? time(new Date(1000 * backup).toISOString()) : text.health.noBackup],
  ];
  return (
    <Panel title={text.health.resources}>
      <dl class="numbers">
        {rows.map(([name, shown]) => (
          <div key={name}>
            <dt>{name}</dt>
            <dd>{shown}</dd>
          </div>
        ))}
      </dl>
    </Panel>
  );
}
