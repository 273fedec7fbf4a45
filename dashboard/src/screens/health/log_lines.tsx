/** The newest lines of the server's log. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { time } from "../../ui/format";
import { Badge, Failure, Panel, Table } from "../../ui/parts";

type Level = Schemas["LogRecord"]["level"];
const LEVELS = ["info", "warning", "error"] as const satisfies readonly Level[];
const OPERATION = "GET /api/v1/log-records";
const SHOWN = 100;

export function LogLines() {
  return allowed(OPERATION) ? (
    <Lines />
  ) : (
    <Panel title={text.health.log}>
      <p class="muted">{text.access.notAllowed(scopeOf(OPERATION))}</p>
    </Panel>
  );
}

function Lines() {
  const level = useSignal<Level>("info");
  const lines = usePolled(`log ${level.value}`, () =>
    sent(api.GET("/api/v1/log-records", { params: { query: { level: level.value, limit: SHOWN } } })),
  );
  return (
    <Panel
      title={text.health.log}
      actions={
        <label>
          {text.health.level}{" "}
          <select value={level.value} onChange={({ currentTarget }) => (level.value = currentTarget.value as Level)}>
            {LEVELS.map((one) => (
              <option key={one} value={one}>
                {text.health.levels[one]}
              </option>
            ))}
          </select>
        </label>
      }
    >
      <Failure message={lines.error} />
      <Table
        caption={text.health.log}
        columns={[text.column.time, text.health.level, text.health.message, text.column.device, text.health.part]}
        rows={lines.value?.items ?? []}
        identity={({ id }) => id}
        empty={lines.value ? text.health.noLines : text.loading}
        row={(line) => [
          time(line.created_at),
          <Badge kind={line.level === "warning" ? "warn" : line.level === "error" || line.level === "critical" ? "bad" : "idle"}>{line.level}</Badge>,
          line.traceback ? (
            <details>
              <summary>{line.message}</summary>
              <pre>{line.traceback}</pre>
            </details>
          ) : (
            line.message
          ),
          line.device_id ?? "",
          line.logger,
        ]}
      />
    </Panel>
  );
}
