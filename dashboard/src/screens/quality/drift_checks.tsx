/** Drift checks: still markers read again, and which sensors moved. */

import { useSignal } from "@preact/signals";
import { api, sent } from "../../api/client";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { time } from "../../ui/format";
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { type Against, AgainstSelect } from "./against_select";

const AGAINST: readonly Against[] = ["positions", "calibration"];

export function DriftChecks({ device, calibration }: { device: Device; calibration: string | null }) {
  const of = { params: { query: { device_id: device.id, limit: 20 } } };
  const checks = usePolled(`drift ${device.id}`, () => sent(api.GET("/api/v1/drift-checks", of)));
  const captures = usePolled(`captures ${device.id}`, () => sent(api.GET("/api/v1/captures", of)), 10);
  const chosen = useSignal("");
  const against = useSignal<Against>("positions");
  const capture = chosen.value || captures.value?.items[0]?.id;
  return (
    <Panel title={text.quality.driftChecks}>
      <p class="muted">{text.quality.driftHelp}</p>
      <Failure message={checks.error ?? captures.error} />
      {captures.value?.items.length && calibration ? (
        <div class="row">
          <label>
            {text.quality.capture}{" "}
            <select value={capture} onChange={({ currentTarget }) => (chosen.value = currentTarget.value)}>
              {captures.value.items.map(({ id }) => (
                <option key={id} value={id}>
                  {id}
                </option>
              ))}
            </select>
          </label>
          <AgainstSelect against={against} choices={AGAINST} />
          <Action
            label={text.quality.checkDrift}
            kind="primary"
            operation="POST /api/v1/calibrations/{calibration_id}/drift-checks"
            run={() =>
              sent(
                api.POST("/api/v1/calibrations/{calibration_id}/drift-checks", {
                  params: { path: { calibration_id: calibration } },
                  body: { capture_id: capture ?? null, against: against.value, allow_incomplete: true, position_sigma_mm: 0, note: "" },
                }),
              )
            }
            done={checks.refresh}
          />
        </div>
      ) : null}
      <Table
        caption={text.quality.driftChecks}
        columns={[text.column.time, text.quality.result, text.quality.found, text.column.markers, text.column.calibration]}
        rows={checks.value?.items ?? []}
        identity={({ id }) => id}
        empty={checks.value ? text.quality.noDriftChecks : text.loading}
        row={(check) => [
          time(check.created_at),
          <Badge kind={check.status === "good" ? "good" : "bad"}>{text.quality.drifts[check.status]}</Badge>,
          check.in_words.join(" "),
          check.markers,
          check.calibration_id,
        ]}
      />
    </Panel>
  );
}
