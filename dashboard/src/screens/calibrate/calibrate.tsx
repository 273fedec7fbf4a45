/** Calibrate, map, check for drift: light check, targets or wand, capture, run, result, activation, one after the other. */

import { useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { api, type Schemas, sent } from "../../api/client";
import { device, type Device, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { time } from "../../ui/format";
import { keptSignal } from "../../ui/kept";
import { NoDevice } from "../../ui/no_device";
import { useOpener } from "../../ui/opener";
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { parseTargets } from "../../ui/targets";
import { takeText } from "../../ui/text_file";
import { type Capture, CaptureRun, CaptureSession } from "./capture_session";
import { DriftCheckOf } from "./drift_wizard";
import { FormerTargets } from "./former_targets";
import { GridForm } from "./grid_form";
import { LightCheck } from "./light_check";
import { CorrectionTables, MappingRun } from "./mapping";
import { CalibrationResult } from "./result";
import { Sessions } from "./sessions";
import { WandCalibration } from "./wand";

type Summary = Schemas["CalibrationSummary"];

export function Calibrate() {
  const shown = device.value;
  return shown ? <DeviceCalibration key={shown.id} device={shown} /> : <NoDevice />;
}

function DeviceCalibration({ device: shown }: { device: Device }) {
  const calibration = useSignal<string | null>(null);
  const way = keptSignal("way");
  const chosen = WAYS.find((one) => one === way.value) ?? "frame";
  const table = useSignal<string | null>(null);
  /** Of the table; one that is shown since it was computed has none. */
  const tableOpener = useOpener();
  /** Of the calibration; one that is shown since it was computed has none. */
  const opener = useOpener();
  const calibrated = (id: string) => {
    opener.forget();
    calibration.value = id;
  };
  const open = (id: string) => {
    opener.note();
    calibration.value = id;
  };
  const close = () => {
    calibration.value = null;
    opener.giveFocusBack();
  };
  const mapped = (id: string) => {
    tableOpener.forget();
    table.value = id;
  };
  const purposes: Record<Exclude<Way, "wand">, (capture: Capture) => ComponentChildren> = {
    frame: (capture) => <CaptureRun capture={capture} calibrated={calibrated} />,
    mapping: (capture) => <MappingRun capture={capture} mapped={mapped} />,
    drift: (capture) => <DriftCheckOf capture={capture} device={shown} updated={calibrated} />,
  };
  return (
    <>
      <LightCheck device={shown} />
      <Ways chosen={chosen} choose={(one) => (way.value = one)} />
      {chosen === "wand" ? (
        <WandCalibration device={shown} calibrated={calibrated} />
      ) : (
        <Captures device={shown} purpose={purposes[chosen]} />
      )}
      {chosen === "mapping" ? <CorrectionTables device={shown} table={table} opener={tableOpener} /> : null}
      {calibration.value ? (
        <CalibrationResult
          key={calibration.value}
          id={calibration.value}
          device={shown}
          focus={opener.known()}
          // From within it, where the button goes with it: who closes the next one is led back to the row.
          open={(id) => {
            if (!opener.known()) opener.note();
            calibration.value = id;
          }}
          close={close}
        />
      ) : null}
      <Calibrations device={shown} open={open} />
    </>
  );
}

/** What is to be done; one more is one more line. */
const WAYS = ["frame", "wand", "mapping", "drift"] as const;
type Way = (typeof WAYS)[number];

function Ways({ chosen, choose }: { chosen: Way; choose: (way: Way) => void }) {
  return (
    <Panel title={text.calibrate.way}>
      <fieldset class="row">
        <legend class="hidden">{text.calibrate.way}</legend>
        {WAYS.map((way) => (
          <label key={way}>
            <input type="radio" name="way" checked={chosen === way} onChange={() => choose(way)} /> {text.calibrate.ways[way]}
          </label>
        ))}
      </fieldset>
      <p class="muted">{text.way.help[chosen]}</p>
    </Panel>
  );
}

/** The open capture session, or what begins one. */
function Captures({ device: shown, purpose }: { device: Device; purpose: (capture: Capture) => ComponentChildren }) {
  const session = keptSignal(`capture ${shown.id}`);
  const captures = usePolled(`captures ${shown.id}`, () =>
    sent(api.GET("/api/v1/captures", { params: { query: { device_id: shown.id, limit: 20 } } })),
  );
  if (session.value)
    return (
      <CaptureSession
        key={session.value}
        id={session.value}
        device={shown}
        close={() => (session.value = null)}
        purpose={purpose}
      />
    );
  return (
    <>
      <NewSession device={shown} begun={(id) => (session.value = id)} />
      <Sessions
        polled={captures}
        column={text.calibrate.done}
        done={({ captured, targets }) => text.calibrate.progress(captured.length, targets.length)}
        open={(id) => (session.value = id)}
      />
    </>
  );
}

function NewSession({ device: shown, begun }: { device: Device; begun: (id: string) => void }) {
  const table = useSignal("");
  const marker = useSignal("");
  const read = attempt(() => parseTargets(table.value));
  const lit = marker.value === "" ? null : Number(marker.value);
  return (
    <Panel title={text.calibrate.targets}>
      <p>{text.calibrate.targetsHelp}</p>
      <div class="row">
        <label>
          {text.calibrate.file}{" "}
          <input
            type="file"
            accept=".csv,.tsv,.txt,text/csv"
            onChange={async (event) => {
              const content = await takeText(event.currentTarget);
              if (content !== null) table.value = content;
            }}
          />
        </label>
        <label>
          {text.calibrate.marker}{" "}
          <input
            type="number"
            min={0}
            max={65535}
            value={marker.value}
            onInput={(event) => (marker.value = event.currentTarget.value)}
          />
        </label>
      </div>
      <FormerTargets device={shown} take={(content) => (table.value = content)} />
      <GridForm take={(content) => (table.value = content)} />
      <label>
        {text.calibrate.table}
        <textarea rows={5} value={table.value} onInput={(event) => (table.value = event.currentTarget.value)} />
      </label>
      {typeof read === "string" ? <Failure message={table.value.trim() ? read : null} /> : <p>{text.calibrate.read(read.length)}</p>}
      <Action
        label={text.calibrate.begin}
        kind="primary"
        operation="POST /api/v1/captures"
        disabled={typeof read === "string"}
        run={async () => {
          if (typeof read === "string") return;
          const settings = { frames: 50, seen_share: 0.8, timeout_s: 10, still_px: 0.5, marker: lit };
          const body = { device_id: shown.id, targets: read, settings, note: "" };
          begun((await sent(api.POST("/api/v1/captures", { body }))).id);
        }}
      />
    </Panel>
  );
}

/** All calibrations of the device: open, activate, roll back. */
function Calibrations({ device: shown, open }: { device: Device; open: (id: string) => void }) {
  const calibrations = usePolled(`calibrations ${shown.id} ${shown.active_calibration_id}`, () =>
    sent(api.GET("/api/v1/calibrations", { params: { query: { device_id: shown.id, limit: 50 } } })),
  );
  const path = { params: { path: { device_id: shown.id } } };
  return (
    <Panel
      title={text.calibrate.calibrations}
      actions={
        <Action
          label={text.calibrate.rollBack}
          operation="POST /api/v1/devices/{device_id}/roll-back"
          confirm={text.calibrate.rollBackQuestion}
          run={() => sent(api.POST("/api/v1/devices/{device_id}/roll-back", path))}
          done={async () => {
            await loadDevices();
            await calibrations.refresh();
          }}
        />
      }
    >
      <Failure message={calibrations.error} />
      <Table
        caption={text.calibrate.calibrations}
        columns={[text.column.name, text.column.state, text.calibrate.provenance, text.calibrate.points, text.column.created]}
        rows={calibrations.value?.items ?? []}
        identity={({ id }) => id}
        empty={calibrations.value ? text.calibrate.none : text.loading}
        select={(id) => open(String(id))}
        row={(one: Summary) => [
          one.id,
          <Badge kind={one.state === "active" ? "good" : "idle"}>{one.state}</Badge>,
          one.provenance,
          one.point_count,
          time(one.created_at),
        ]}
      />
    </Panel>
  );
}
