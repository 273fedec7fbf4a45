/** A calibration: errors of points or lengths that it did not use first, suspect labels, comparison, activation. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { type Device, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { position, significant } from "../../ui/format";
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { Labels } from "./labels";

type Document = Schemas["CalibrationDocument"];
type Errors = Schemas["PointErrors"] | null | undefined;

interface ResultProps {
  id: string;
  device: Device;
  /** A person opened it. */
  focus: boolean;
  /** Shows another calibration. */
  open: (id: string) => void;
  close: () => void;
}

export function CalibrationResult({ id, device, focus, open, close }: ResultProps) {
  const calibration = usePolled(
    `calibration ${id}`,
    () => sent(api.GET("/api/v1/calibrations/{calibration_id}", { params: { path: { calibration_id: id } } })),
    10,
  );
  const found = calibration.value;
  const path = { params: { path: { calibration_id: id } } };
  const active = device.active_calibration_id === id;
  return (
    <Panel
      title={text.calibrate.resultOf(id)}
      focus={focus}
      actions={
        <>
          {active ? (
            <Badge kind="good">{text.calibrate.active}</Badge>
          ) : (
            <Action
              label={text.calibrate.activate}
              kind="primary"
              operation="POST /api/v1/calibrations/{calibration_id}/activate"
              run={() => sent(api.POST("/api/v1/calibrations/{calibration_id}/activate", path))}
              done={async () => {
                await loadDevices();
                await calibration.refresh();
              }}
            />
          )}
          <button type="button" onClick={close}>
            {text.close}
          </button>
        </>
      }
    >
      <Failure message={calibration.error} />
      {found ? <Details calibration={found} active={active ? null : device.active_calibration_id} open={open} /> : null}
    </Panel>
  );
}

interface DetailsProps {
  calibration: Document;
  active: string | null;
  open: (id: string) => void;
}

function Details({ calibration, active, open }: DetailsProps) {
  const { errors, result } = calibration;
  const rows: [string, Errors][] = [
    [text.calibrate.leaveOneOut, errors.leave_one_out],
    [text.calibrate.blocksLeftOut, errors.blocks_left_out],
    [text.calibrate.fitted, errors.fitted],
  ];
  const lengths = errors.lengths_left_out;
  const waved = calibration.provenance === "self-calibrated";
  return (
    <>
      {calibration.note ? <p class="muted">{calibration.note}</p> : null}
      {waved ? (
        <Table
          caption={text.wand.lengths}
          columns={[text.wand.lengths, text.wand.heldOut, text.wand.rms, text.wand.mean, text.wand.max]}
          rows={lengths ? [lengths] : []}
          identity={() => "lengths"}
          empty={text.wand.noLengths}
          row={(one) => [
            text.wand.lengthsLeftOut,
            one.poses,
            significant(one.rms_mm, 3),
            significant(one.mean_mm, 2),
            significant(one.max_mm, 3),
          ]}
        />
      ) : null}
      {waved
        ? result.diagnosis?.remarks.map((remark) => (
            <p key={remark} class="banner warn" role="alert">
              {remark}
            </p>
          ))
        : null}
      {waved ? null : <ControlPointErrors rows={rows} />}
      <Table
        caption={text.calibrate.fits}
        columns={[text.light.sensor, text.calibrate.points, text.calibrate.rms, text.calibrate.sigma, text.calibrate.chi2]}
        rows={result.sensors}
        identity={({ model }) => model.name}
        empty={text.missing}
        row={(fit) => [
          fit.model.name,
          fit.points,
          significant(fit.rms_px, 3),
          significant(fit.sigma_px, 3),
          significant(fit.chi2_per_dof, 3),
        ]}
      />
      {!waved && result.diagnosis?.remarks.length ? (
        <ul>
          {result.diagnosis.remarks.map((remark) => (
            <li key={remark}>{remark}</li>
          ))}
        </ul>
      ) : null}
      {waved ? null : <Labels calibration={calibration} open={open} />}
      {result.diagnosis?.suggestions.length ? (
        <p>
          {text.calibrate.suggestions}{" "}
          {result.diagnosis.suggestions.map(({ position_mm }) => `(${position(position_mm)})`).join(", ")}
        </p>
      ) : null}
      {active ? <ComparedWith active={active} id={calibration.id} /> : null}
    </>
  );
}

function ControlPointErrors({ rows }: { rows: readonly [string, Errors][] }) {
  return (
    <Table
      caption={text.calibrate.errors}
      columns={[text.calibrate.errors, text.calibrate.points, text.calibrate.meanError, text.calibrate.maxError]}
      rows={rows.filter(([, one]) => one?.statistics)}
      identity={([name]) => name}
      empty={text.calibrate.noErrors}
      row={([name, one]) => [
        name,
        one?.statistics?.points ?? 0,
        one?.statistics?.mean_absolute_mm.map((value) => significant(value, 2)).join(", ") ?? "",
        one?.statistics?.max_absolute_mm.map((value) => significant(value, 2)).join(", ") ?? "",
      ]}
    />
  );
}

function ComparedWith({ active, id }: { active: string; id: string }) {
  const open = useSignal(false);
  const path = { params: { path: { calibration_id: active, other_calibration_id: id } } };
  const comparison = usePolled(
    `compare ${active} ${id} ${open.value}`,
    async () =>
      open.value
        ? await sent(api.GET("/api/v1/calibrations/{calibration_id}/compare/{other_calibration_id}", path))
        : null,
    3600,
  );
  const positions = comparison.value?.comparison.positions;
  return (
    <details onToggle={(event) => (open.value = event.currentTarget.open)}>
      <summary>{text.calibrate.compare(active)}</summary>
      <Failure message={comparison.error} />
      {positions ? (
        <p>
          {text.calibrate.differences(
            significant(positions.rms_mm, 3),
            significant(positions.max_mm, 3),
            significant(positions.aligned_rms_mm, 3),
          )}
        </p>
      ) : null}
      {comparison.value && !positions ? <p>{text.calibrate.noDifferences}</p> : null}
    </details>
  );
}
