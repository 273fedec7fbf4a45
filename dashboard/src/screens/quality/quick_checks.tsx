/** Quick checks: a still marker, or the known distance of two, measured for some seconds. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { time } from "../../ui/format";
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { found, markerNumbers } from "./quality_data";

type Kind = Schemas["QualityCheck"]["kind"];

export function QuickChecks({ device, made }: { device: Device; made: () => Promise<void> }) {
  const checks = usePolled(`checks ${device.id}`, () =>
    sent(api.GET("/api/v1/quality-checks", { params: { query: { device_id: device.id, limit: 20 } } })),
  );
  const done = async () => {
    await checks.refresh();
    await made();
  };
  return (
    <Panel title={text.quality.quickChecks}>
      <Form device={device} done={done} />
      <Failure message={checks.error} />
      <Table
        caption={text.quality.quickChecks}
        columns={[text.column.time, text.column.kind, text.quality.result, text.quality.found, text.column.points, text.column.calibration, text.column.action]}
        rows={checks.value?.items ?? []}
        identity={({ id }) => id}
        empty={checks.value ? text.quality.noChecks : text.loading}
        row={(check) => [
          time(check.created_at),
          text.quality.kinds[check.kind],
          check.passed === null ? text.missing : <Badge kind={check.passed ? "good" : "bad"}>{check.passed ? text.quality.passed : text.quality.failed}</Badge>,
          found(check),
          check.left_out ? text.quality.pointsOf(check.points, check.left_out) : check.points,
          check.calibration_id,
          <Action
            label={text.tools.remove}
            kind="danger"
            operation="DELETE /api/v1/quality-checks/{quality_check_id}"
            confirm={text.confirm.remove(check.id)}
            run={() => sent(api.DELETE("/api/v1/quality-checks/{quality_check_id}", { params: { path: { quality_check_id: check.id } } }))}
            done={done}
          />,
        ]}
      />
    </Panel>
  );
}

function Form({ device, done }: { device: Device; done: () => Promise<void> }) {
  const kind = useSignal<Kind>("single-point");
  const markers = useSignal("");
  const reference = useSignal("");
  const tolerance = useSignal("1");
  const seconds = useSignal("5");
  const two = kind.value === "point-to-point";
  const field = (label: string, value: { value: string }, size = 6) => (
    <label>
      {label} <input inputMode="decimal" size={size} value={value.value} onInput={({ currentTarget }) => (value.value = currentTarget.value)} />
    </label>
  );
  const read = attempt(() => markerNumbers(markers.value));
  const numbers = typeof read === "string" ? undefined : read;
  const right =
    numbers !== undefined &&
    (numbers === null || numbers.length === (two ? 2 : 1)) &&
    Number(seconds.value) >= 0.5 &&
    (tolerance.value === "" || Number(tolerance.value) > 0) &&
    (!two || Number(reference.value) > 0);
  const measure = () => {
    const common = { duration_s: Number(seconds.value), tolerance_mm: tolerance.value === "" ? null : Number(tolerance.value), note: "" };
    const body: Schemas["NewQualityCheck"] = two
      ? { ...common, kind: "point-to-point", markers: (numbers ?? null) as [number, number] | null, reference_mm: Number(reference.value), reference_sigma_mm: 0 }
      : { ...common, kind: "single-point", marker: numbers?.[0] ?? null };
    return sent(api.POST("/api/v1/devices/{device_id}/quality-checks", { params: { path: { device_id: device.id } }, body }));
  };
  return (
    <>
      <p class="muted">{two ? text.quality.distanceHelp : text.quality.stillHelp}</p>
      <div class="row">
        <label>
          {text.column.kind}{" "}
          <select value={kind.value} onChange={({ currentTarget }) => (kind.value = currentTarget.value as Kind)}>
            {(Object.keys(text.quality.kinds) as Kind[]).map((one) => (
              <option key={one} value={one}>
                {text.quality.kinds[one]}
              </option>
            ))}
          </select>
        </label>
        {field(two ? text.quality.twoMarkers : text.quality.oneMarker, markers)}
        {two ? field(text.quality.distanceMm, reference) : null}
        {field(text.quality.tolerance, tolerance)}
        {field(text.quality.seconds, seconds, 4)}
        <Action
          label={text.quality.measure}
          kind="primary"
          operation="POST /api/v1/devices/{device_id}/quality-checks"
          disabled={!right}
          run={measure}
          done={done}
        />
      </div>
      <Failure message={typeof read === "string" ? read : null} />
    </>
  );
}
