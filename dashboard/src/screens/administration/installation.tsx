/** The server's backups, and its settings in force. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { bytes, time } from "../../ui/format";
import { Badge, Failure, Panel, Table } from "../../ui/parts";

type Setting = Schemas["Setting"];
const MINUTE = 60;

export function Backups() {
  const backups = usePolled("backups", () => sent(api.GET("/api/v1/backups", { params: { query: { limit: 50 } } })), MINUTE);
  return (
    <Panel title={text.administration.backups}>
      <Failure message={backups.error} />
      <p class="muted">{text.administration.backupsHelp}</p>
      <Table
        caption={text.administration.backups}
        columns={[text.column.created, text.administration.folder, text.administration.database]}
        rows={backups.value?.items ?? []}
        identity={({ id }) => id}
        empty={backups.value ? text.administration.noBackups : text.loading}
        row={({ created_at, path, database_bytes }) => [time(created_at), <code>{path}</code>, bytes(database_bytes)]}
      />
    </Panel>
  );
}

export function SettingsInForce() {
  const settings = usePolled("settings", allSettings, MINUTE);
  const changed = useSignal(false);
  const shown = (settings.value ?? []).filter(({ is_default }) => !changed.value || !is_default);
  return (
    <Panel
      title={text.administration.settings}
      actions={
        <label>
          <input type="checkbox" checked={changed.value} onChange={({ currentTarget }) => (changed.value = currentTarget.checked)} />{" "}
          {text.administration.changedOnly}
        </label>
      }
    >
      <Failure message={settings.error} />
      <p class="muted">{text.administration.settingsHelp}</p>
      <Table
        caption={text.administration.settings}
        columns={[text.column.name, text.administration.value, text.administration.meaning]}
        rows={shown}
        identity={({ name }) => name}
        empty={settings.value ? text.administration.allDefault : text.loading}
        row={({ name, value, is_default, description }) => [
          <code>{name}</code>,
          <>
            {shownValue(value)} {is_default ? null : <Badge kind="warn">{text.administration.changed}</Badge>}
          </>,
          description,
        ]}
      />
    </Panel>
  );
}

function shownValue(value: Setting["value"]): string {
  if (value === null) return text.missing;
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

async function allSettings(): Promise<Setting[]> {
  const found: Setting[] = [];
  let cursor: string | null = null;
  do {
    const query: { limit: number; cursor?: string } = { limit: 200, ...(cursor ? { cursor } : {}) };
    const page: Schemas["Page_Setting_"] = await sent(api.GET("/api/v1/settings", { params: { query } }));
    found.push(...page.items);
    cursor = page.next_cursor;
  } while (cursor);
  return found;
}
