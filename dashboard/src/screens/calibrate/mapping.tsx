/** Correction tables: made from captured targets, judged by measurements that they never saw, activated. */

import { type Signal, useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { api, type Schemas, sent } from "../../api/client";
import { type Device, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { significant, time } from "../../ui/format";
import type { Opener } from "../../ui/opener";
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { RunAction } from "../../ui/run_action";
import type { Capture } from "./capture_session";
import { mappedSensors, mappingVerdict, sharesPoints } from "./mapping_figures";

type CorrectionTable = Schemas["CorrectionTableDocument"];

/** Computes a table of what is captured, for the active calibration. */
export function MappingRun({ capture, mapped }: { capture: Capture; mapped: (table: string) => void }) {
  const sigma = useSignal(0);
  return (
    <Panel title={text.mapping.compute}>
      <SigmaInput sigma={sigma} />
      <RunAction
        label={text.mapping.computeAction}
        operation="POST /api/v1/runs/mapping"
        session={capture.id}
        disabled={capture.captured.length === 0}
        start={() => {
          const body = {
            device_id: capture.device_id,
            capture_id: capture.id,
            method: "b-spline" as const,
            min_neighbours: 4,
            position_sigma_mm: sigma.value,
            allow_incomplete: capture.left > 0,
            note: "",
          };
          return sent(api.POST("/api/v1/runs/mapping", { body }));
        }}
        done={mapped}
      />
      {capture.left > 0 ? <p class="muted">{text.mapping.incomplete(capture.left)}</p> : null}
    </Panel>
  );
}

/** Asks for the standard deviation of the targets' coordinates. */
export function SigmaInput({ sigma }: { sigma: Signal<number> }) {
  return (
    <label>
      {text.way.sigma}{" "}
      <input
        type="number"
        min={0}
        max={1000}
        step="any"
        value={sigma.value}
        onInput={({ currentTarget }) => (sigma.value = Math.min(1000, Math.max(0, Number(currentTarget.value) || 0)))}
      />
    </label>
  );
}

/** The tables of the device, and the one that is looked at. */
interface CorrectionTablesProps {
  device: Device;
  /** That whose result is shown. */
  table: Signal<string | null>;
  opener: Opener;
}

export function CorrectionTables({ device, table, opener }: CorrectionTablesProps) {
  const query = { device_id: device.id, limit: 50 };
  const tables = usePolled(`tables ${device.id}`, () =>
    sent(api.GET("/api/v1/correction-tables", { params: { query } })),
  );
  const items = tables.value?.items ?? [];
  const shown = items.find(({ id }) => id === table.value);
  // One that was just computed is not among them.
  useEffect(() => {
    if (table.value !== null && !shown) void tables.refresh();
  }, [table.value]);
  const close = () => {
    table.value = null;
    opener.giveFocusBack();
  };
  const changed = async () => {
    await loadDevices();
    await tables.refresh();
  };
  return (
    <>
      {shown ? <TableResult key={shown.id} table={shown} device={device} focus={opener.known()} changed={changed} close={close} /> : null}
      <Panel title={text.mapping.tables}>
        <Failure message={tables.error} />
        <Table
          caption={text.mapping.tables}
          columns={[text.column.name, text.column.state, text.column.calibration, text.mapping.supported, text.column.created]}
          rows={items}
          identity={({ id }) => id}
          empty={tables.value ? text.mapping.none : text.loading}
          selected={table.value}
          select={(id) => {
            opener.note();
            table.value = String(id);
          }}
          row={(one) => [
            one.id,
            <Badge kind={one.active ? "good" : "idle"}>{one.active ? text.mapping.active : text.mapping.inactive}</Badge>,
            one.calibration_id,
            one.valid_share.map(percent).join(", "),
            time(one.created_at),
          ]}
        />
      </Panel>
    </>
  );
}

function percent(share: number): string {
  return `${Math.round(100 * share)} %`;
}

interface TableResultProps {
  table: CorrectionTable;
  device: Device;
  /** A person opened it. */
  focus: boolean;
  changed: () => Promise<void>;
  close: () => void;
}

const KINDS = { better: "good", mixed: "warn", worse: "bad", unknown: "idle" } as const;

function TableResult({ table, device, focus, changed, close }: TableResultProps) {
  const sensors = mappedSensors(table);
  const verdict = mappingVerdict(sensors);
  const path = { params: { path: { table_id: table.id } } };
  const foreign = table.calibration_id !== device.active_calibration_id;
  const suspects = sensors.filter((one) => one.suspects.length);
  return (
    <Panel
      title={text.mapping.resultOf(table.id)}
      focus={focus}
      actions={
        <>
          {table.active ? (
            <>
              <Badge kind="good">{text.mapping.active}</Badge>
              <Action
                label={text.mapping.deactivate}
                operation="POST /api/v1/correction-tables/{table_id}/deactivate"
                run={() => sent(api.POST("/api/v1/correction-tables/{table_id}/deactivate", path))}
                done={changed}
              />
            </>
          ) : (
            <Action
              label={text.mapping.activate}
              kind="primary"
              operation="POST /api/v1/correction-tables/{table_id}/activate"
              disabled={foreign}
              run={() => sent(api.POST("/api/v1/correction-tables/{table_id}/activate", path))}
              done={changed}
            />
          )}
          <button type="button" onClick={close}>
            {text.close}
          </button>
        </>
      }
    >
      <p class="verdict">
        <Badge kind={KINDS[verdict]}>{text.mapping.verdicts[verdict]}</Badge> {text.mapping.advice[verdict]}
      </p>
      {foreign ? <p>{text.mapping.foreign(table.calibration_id)}</p> : null}
      {sharesPoints(table) ? <p>{text.mapping.shared}</p> : null}
      <Table
        caption={text.mapping.errors}
        columns={[text.light.sensor, text.mapping.leftOut, text.mapping.without, text.mapping.fitted, text.calibrate.points, text.mapping.correction]}
        rows={sensors}
        identity={({ sensor }) => sensor}
        empty={text.missing}
        row={(one) => [
          one.sensor,
          significant(one.leftOut_px, 3),
          significant(one.without_px, 3),
          significant(one.fitted_px, 3),
          one.points ?? text.missing,
          significant(one.correction_px, 3),
        ]}
      />
      <h3>{text.mapping.where}</h3>
      <Table
        caption={text.mapping.where}
        columns={[text.light.sensor, text.mapping.supported, text.mapping.resolution, text.mapping.coverage]}
        rows={sensors}
        identity={({ sensor }) => sensor}
        empty={text.missing}
        row={(one) => [
          one.sensor,
          <meter min={0} max={1} value={one.supported} aria-label={text.mapping.supported}>
            {percent(one.supported)}
          </meter>,
          significant(one.resolution_mm, 3),
          one.coverage || percent(one.supported),
        ]}
      />
      {suspects.length ? (
        <>
          <p>{text.mapping.suspects}</p>
          <ul>
            {suspects.map((one) => (
              <li key={one.sensor}>{text.mapping.suspect(one.sensor, one.suspects.map((point) => point + 1).join(", "))}</li>
            ))}
          </ul>
        </>
      ) : null}
    </Panel>
  );
}
