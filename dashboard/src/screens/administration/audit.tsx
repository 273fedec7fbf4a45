/** The audit log: who changed what, by filters, page by page. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { time } from "../../ui/format";
import { Badge, Failure, Panel, Table } from "../../ui/parts";
import { type AuditFilter, auditQuery, EMPTY_FILTER } from "./audit_filter";

type Entry = Schemas["AuditEntry"];
const PAGE = 50;
const FIELDS = ["actor_id", "operation", "object_kind", "object_id"] as const;
const MOMENTS = ["since", "until"] as const;

export function Audit() {
  const filter = useSignal<AuditFilter>(EMPTY_FILTER);
  /** Where the pages before this one began; the last is this one's. */
  const cursors = useSignal<readonly string[]>([]);
  const opened = useSignal<number | null>(null);
  const cursor = cursors.value.at(-1);
  const query = { ...auditQuery(filter.value), limit: PAGE, ...(cursor ? { cursor } : {}) };
  const entries = usePolled(`audit ${JSON.stringify(query)}`, () => sent(api.GET("/api/v1/audit", { params: { query } })), 5);
  const change = (members: Partial<AuditFilter>) => {
    filter.value = { ...filter.value, ...members };
    cursors.value = [];
  };
  const next = entries.value?.next_cursor;
  const shown = entries.value?.items.find(({ id }) => id === opened.value);
  return (
    <Panel
      title={text.administration.audit}
      actions={
        <>
          <button type="button" disabled={!cursors.value.length} onClick={() => (cursors.value = cursors.value.slice(0, -1))}>
            {text.administration.newer}
          </button>
          <button type="button" disabled={!next} onClick={() => (cursors.value = next ? [...cursors.value, next] : cursors.value)}>
            {text.administration.older}
          </button>
        </>
      }
    >
      <div class="row" role="search" aria-label={text.administration.filters}>
        {FIELDS.map((name) => (
          <label key={name}>
            {text.administration.filter[name]}{" "}
            <input value={filter.value[name]} onChange={({ currentTarget }) => change({ [name]: currentTarget.value })} />
          </label>
        ))}
        {MOMENTS.map((name) => (
          <label key={name}>
            {text.administration.filter[name]}{" "}
            <input type="datetime-local" value={filter.value[name]} onChange={({ currentTarget }) => change({ [name]: currentTarget.value })} />
          </label>
        ))}
        <label>
          {text.column.outcome}{" "}
          <select value={filter.value.outcome} onChange={({ currentTarget }) => change({ outcome: currentTarget.value as AuditFilter["outcome"] })}>
            <option value="">{text.administration.anyOutcome}</option>
            <option value="done">{text.administration.outcomes.done}</option>
            <option value="refused">{text.administration.outcomes.refused}</option>
          </select>
        </label>
        <button type="button" onClick={() => change(EMPTY_FILTER)}>
          {text.administration.noFilter}
        </button>
      </div>
      <Failure message={entries.error} />
      <Table
        caption={text.administration.audit}
        columns={[text.column.time, text.column.actor, text.column.operation, text.column.object, text.column.outcome, text.column.reason]}
        rows={entries.value?.items ?? []}
        identity={({ id }) => id}
        empty={entries.value ? text.administration.noEntry : text.loading}
        selected={opened.value}
        select={(id) => (opened.value = opened.value === id ? null : Number(id))}
        row={(entry) => [
          time(entry.created_at),
          entry.actor.name || entry.actor.id,
          entry.operation,
          [entry.object_kind, entry.object_id].filter(Boolean).join(" "),
          <Badge kind={entry.outcome === "done" ? "idle" : "warn"}>{text.administration.outcomes[entry.outcome]}</Badge>,
          entry.detail ?? "",
        ]}
      />
      {shown ? <Opened entry={shown} /> : null}
    </Panel>
  );
}

function Opened({ entry }: { entry: Entry }) {
  const parts = [
    [text.administration.before, entry.before],
    [text.administration.after, entry.after],
  ] as const;
  return (
    <section aria-label={text.administration.entry(entry.id)}>
      <dl class="numbers">
        <div>
          <dt>{text.column.actor}</dt>
          <dd>{[entry.actor.kind, entry.actor.id, entry.actor.name].filter(Boolean).join(" ")}</dd>
        </div>
        <div>
          <dt>{text.administration.address}</dt>
          <dd>{entry.address ?? text.missing}</dd>
        </div>
        <div>
          <dt>{text.administration.request}</dt>
          <dd>{entry.request_id ?? text.missing}</dd>
        </div>
      </dl>
      {parts.map(([title, values]) =>
        values ? (
          <div key={title}>
            <h3>{title}</h3>
            <pre>{JSON.stringify(values, null, 2)}</pre>
          </div>
        ) : null,
      )}
    </section>
  );
}
