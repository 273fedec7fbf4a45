/** Drift check by captured still markers: the verdict, what to do, and the calibration brought up to date. */

import { type Signal, useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { significant } from "../../ui/format";
import { keptSignal } from "../../ui/kept";
import { whileKnown } from "../../ui/kept_document";
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { RunAction } from "../../ui/run_action";
import { type Against, AgainstSelect } from "../quality/against_select";
import type { Capture } from "./capture_session";
import { SigmaInput } from "./mapping";

type Check = Schemas["DriftCheckDocument"];
const AGAINST = Object.keys(text.quality.againsts) as Against[];

interface DriftCheckProps {
  capture: Capture;
  device: Device;
  /** Shows the calibration that was brought up to date. */
  updated: (calibration: string) => void;
}

export function DriftCheckOf({ capture, device, updated }: DriftCheckProps) {
  const against = useSignal<Against>("positions");
  const earlier = useSignal("");
  const sigma = useSignal(0);
  const checked = keptSignal(`drift check ${capture.id}`);
  const check = useCheck(checked);
  const query = { device_id: device.id, limit: 20 };
  const captures = usePolled(`captures ${device.id}`, () => sent(api.GET("/api/v1/captures", { params: { query } })), 10);
  const others = (captures.value?.items ?? []).filter(({ id }) => id !== capture.id);
  const compared = against.value === "capture" ? earlier.value || others[0]?.id : undefined;
  const calibration = device.active_calibration_id;
  const found = check.value;
  return (
    <Panel title={text.drift.title}>
      {calibration ? null : <p>{text.drift.noCalibration}</p>}
      <div class="row">
        <AgainstSelect against={against} choices={AGAINST} />
        {against.value === "capture" ? (
          <label>
            {text.drift.earlier}{" "}
            <select value={compared} onChange={({ currentTarget }) => (earlier.value = currentTarget.value)}>
              {others.map(({ id }) => (
                <option key={id} value={id}>
                  {id}
                </option>
              ))}
            </select>
          </label>
        ) : null}
        {against.value === "positions" ? <SigmaInput sigma={sigma} /> : null}
        <Action
          label={text.quality.checkDrift}
          kind="primary"
          operation="POST /api/v1/calibrations/{calibration_id}/drift-checks"
          disabled={calibration === null || capture.captured.length === 0 || (against.value === "capture" && !compared)}
          run={async () => {
            if (calibration === null) return;
            const { id } = await sent(
              api.POST("/api/v1/calibrations/{calibration_id}/drift-checks", {
                params: { path: { calibration_id: calibration } },
                body: {
                  capture_id: capture.id,
                  against: against.value,
                  earlier_capture_id: compared ?? null,
                  allow_incomplete: true,
                  position_sigma_mm: against.value === "positions" ? sigma.value : 0,
                  note: "",
                },
              }),
            );
            checked.value = id;
          }}
        />
      </div>
      <Failure message={check.error} />
      {found ? <Verdict key={found.id} check={found} table={device.active_table_id} updated={updated} /> : null}
    </Panel>
  );
}

/** The last check of a capture, by its id: who leaves finds it again, and the run that brings the calibration up to date. */
function useCheck(id: Signal<string | null>) {
  return usePolled<Check | null>(
    `drift check ${id.value}`,
    () => whileKnown(id, (asked) => sent(api.GET("/api/v1/drift-checks/{drift_check_id}", { params: { path: { drift_check_id: asked } } }))),
    60,
  );
}

interface VerdictProps {
  check: Check;
  table: string | null;
  updated: (calibration: string) => void;
}

function Verdict({ check, table, updated }: VerdictProps) {
  const { status } = check;
  return (
    <div role="status">
      <p class="verdict">
        <Badge kind={status === "good" ? "good" : "bad"}>{text.quality.drifts[status]}</Badge> {check.in_words.join(" ")}
      </p>
      <p>{text.drift.advice[status]}</p>
      <Table
        caption={text.drift.sensors}
        columns={[text.light.sensor, text.drift.moved, text.drift.rms, text.quality.found]}
        rows={check.check.sensors}
        identity={({ sensor }) => sensor}
        empty={text.missing}
        row={(one) => [
          one.sensor,
          <Badge kind={check.moved.includes(one.sensor) ? "bad" : "idle"}>{check.moved.includes(one.sensor) ? text.drift.yes : text.drift.no}</Badge>,
          significant(one.rms_px, 3),
          one.description,
        ]}
      />
      {status === "sensors-moved" ? (
        <>
          {table ? <p>{text.drift.tableLost(table)}</p> : null}
          <RunAction
            label={text.drift.update(check.moved.join(", "))}
            operation="POST /api/v1/runs/update"
            session={check.id}
            start={() => {
              const body = {
                device_id: check.device_id,
                drift_check_id: check.id,
                sensors: check.moved,
                note: text.drift.note(check.id),
              };
              // The check has its markers: members that say where others come from are refused.
              return sent(api.POST("/api/v1/runs/update", { body } as never));
            }}
            done={updated}
          />
        </>
      ) : null}
    </div>
  );
}
