/** Administration: who this page acts as, keys, the audit trail. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../api/client";
import { key } from "../api/key";
import { allowed, logOut, scopeOf, session } from "../api/session";
import { usePolled } from "../live/polling";
import { text } from "../text";
import { time } from "../ui/format";
import { Action, Badge, Copy, Failure, Panel, Table, Why } from "../ui/parts";

type Scope = Schemas["NewApiKey"]["scopes"][number];

export function Administration() {
  const now = session.value;
  const may = allowed("GET /api/v1/keys");
  return (
    <>
      <Panel
        title={text.administration.you}
        actions={
          key.value ? (
            <button type="button" onClick={() => void logOut()}>
              {text.access.logOut}
            </button>
          ) : null
        }
      >
        <p>
          <strong>{now?.kind === "local" ? text.access.local : text.access.key}</strong>
        </p>
        <p class="muted">{now?.scopes.join(", ")}</p>
      </Panel>
      {may ? (
        <>
          <Keys />
          <Audit />
        </>
      ) : (
        <p class="muted">{text.access.notAllowed(scopeOf("GET /api/v1/keys"))}</p>
      )}
    </>
  );
}

function Keys() {
  const keys = usePolled("keys", () => sent(api.GET("/api/v1/keys", { params: { query: { limit: 100 } } })));
  const name = useSignal("");
  const scopes = useSignal<readonly Scope[]>([]);
  const made = useSignal<string | null>(null);
  const all = (session.value?.scopes ?? []) as Scope[];
  const toggle = (scope: Scope) => {
    scopes.value = scopes.value.includes(scope)
      ? scopes.value.filter((one) => one !== scope)
      : [...scopes.value, scope];
  };
  return (
    <Panel title={text.administration.keys}>
      <Failure message={keys.error} />
      <Table
        caption={text.administration.keys}
        columns={[text.column.name, text.column.state, text.column.scopes, text.column.created, text.column.used, text.column.action]}
        rows={keys.value?.items ?? []}
        identity={({ id }) => id}
        empty={keys.value ? text.missing : text.loading}
        row={(one) => [
          `${one.name} (${one.id})`,
          <Badge kind={one.state === "valid" ? "good" : "idle"}>{one.state}</Badge>,
          one.scopes.join(", "),
          time(one.created_at),
          time(one.last_used_at),
          one.revoked_at ? null : (
            <Action
              label={text.administration.revoke}
              kind="danger"
              operation="POST /api/v1/keys/{key_id}/revoke"
              confirm={text.confirm.revoke(one.name)}
              run={() => sent(api.POST("/api/v1/keys/{key_id}/revoke", { params: { path: { key_id: one.id } } }))}
              done={keys.refresh}
            />
          ),
        ]}
      />
      <h3>{text.administration.create}</h3>
      <div class="row">
        <label>
          {text.administration.name}{" "}
          <input value={name.value} onInput={(event) => (name.value = event.currentTarget.value)} />
        </label>
        <fieldset class="row">
          <legend>{text.administration.scopes}</legend>
          {all.map((scope) => (
            <label key={scope}>
              <input type="checkbox" checked={scopes.value.includes(scope)} onChange={() => toggle(scope)} /> {scope}
            </label>
          ))}
        </fieldset>
        <Action
          label={text.administration.create}
          kind="primary"
          operation="POST /api/v1/keys"
          disabled={!name.value || !scopes.value.length}
          run={async () => {
            const created = await sent(
              api.POST("/api/v1/keys", { body: { name: name.value, scopes: [...scopes.value] } }),
            );
            made.value = created.key;
            name.value = "";
          }}
          done={keys.refresh}
        />
      </div>
      {made.value ? (
        <p class="banner" role="status">
          {text.administration.once} <code>{made.value}</code> <Copy value={made.value} />
        </p>
      ) : null}
    </Panel>
  );
}

function Audit() {
  const refused = useSignal(false);
  const entries = usePolled(
    `audit ${refused.value}`,
    () =>
      sent(
        api.GET("/api/v1/audit", {
          params: { query: { limit: 50, ...(refused.value ? { outcome: "refused" as const } : {}) } },
        }),
      ),
    5,
  );
  return (
    <Panel
      title={text.administration.audit}
      actions={
        <label>
          <input
            type="checkbox"
            checked={refused.value}
            onChange={(event) => (refused.value = event.currentTarget.checked)}
          />{" "}
          {text.administration.everything}
        </label>
      }
    >
      <Failure message={entries.error} />
      <Table
        caption={text.administration.audit}
        columns={[text.column.time, text.column.actor, text.column.operation, text.column.object, text.column.outcome]}
        rows={entries.value?.items ?? []}
        identity={({ id }) => id}
        empty={entries.value ? text.missing : text.loading}
        row={(entry) => [
          time(entry.created_at),
          entry.actor.name || entry.actor.id,
          entry.operation,
          [entry.object_kind, entry.object_id].filter(Boolean).join(" "),
          <>
            {entry.outcome}
            <Why reason={entry.detail} />
          </>,
        ]}
      />
    </Panel>
  );
}
