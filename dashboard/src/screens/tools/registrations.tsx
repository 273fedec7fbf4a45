/** Registrations: frames of images and phantoms, from points that are known there and touched with a tool. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import type { Device } from "../../devices";
import { type Polled, usePolled } from "../../live/polling";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { position, significant } from "../../ui/format";
import { IdChoice } from "../../ui/id_choice";
import { Action, Failure, Panel, Table } from "../../ui/parts";
import { parseTargets } from "../../ui/targets";
import { takeText } from "../../ui/text_file";
import { measurePoint, pointers } from "./digitise";
import { keptByDevice } from "./kept";
import { measuredFor, type MeasuredRow, remeasured, type Row, TRACKER } from "./registration_points";

type Tool = Schemas["Tool"];
type Registration = Schemas["Registration"];

const MIN_POINTS = 3;

export function Registrations({ device, tools }: { device: Device; tools: readonly Tool[] }) {
  const polled = usePolled(`registrations ${device.id}`, () =>
    sent(api.GET("/api/v1/registrations", { params: { query: { device_id: device.id, limit: 100 } } })),
  );
  const chosen = useSignal<string | null>(null);
  const found = polled.value?.items ?? [];
  const shown = found.find(({ id }) => id === chosen.value);
  return (
    <>
      <Panel title={text.registrations.title}>
        <Failure message={polled.error} />
        <Table
          caption={text.registrations.title}
          columns={[text.column.name, text.column.kind, text.registrations.reference, text.registrations.fre, text.registrations.fle, text.registrations.worst, text.registrations.warnings, text.column.action]}
          rows={found}
          identity={({ id }) => id}
          selected={chosen.value}
          select={(id) => (chosen.value = chosen.value === id ? null : String(id))}
          empty={polled.value ? text.registrations.none : text.loading}
          row={(one) => [
            one.id,
            one.kind,
            one.reference_id ?? text.tools.tracker,
            significant(one.fre_mm, 2),
            significant(one.fle_mm, 2),
            one.targets.length ? significant(Math.max(...one.targets.map(({ error_mm }) => error_mm)), 2) : text.missing,
            one.warnings.join("; "),
            <Action
              label={text.tools.remove}
              kind="danger"
              operation="DELETE /api/v1/registrations/{registration_id}"
              confirm={text.confirm.remove(one.id)}
              run={() => sent(api.DELETE("/api/v1/registrations/{registration_id}", { params: { path: { registration_id: one.id } } }))}
              done={polled.refresh}
            />,
          ]}
        />
        {shown?.fiducials?.length ? (
          <Table
            caption={text.registrations.fiducials(shown.id)}
            columns={[text.column.name, text.registrations.error]}
            rows={shown.fiducials}
            identity={({ name }) => name}
            empty={text.missing}
            row={({ name, error_mm }) => [name, significant(error_mm, 2)]}
          />
        ) : null}
      </Panel>
      <NewRegistration device={device} tools={tools} registered={polled} />
    </>
  );
}

interface NewRegistrationProps {
  device: Device;
  tools: readonly Tool[];
  registered: Polled<{ items: Registration[] }>;
}

const idOf = keptByDevice(() => "");
const tableOf = keptByDevice(() => "");
const referenceOf = keptByDevice(() => "");
const measuredOf = keptByDevice<readonly MeasuredRow[]>(() => []);
/** How often the measured points were emptied: what is being measured meanwhile is not added. */
const emptiedOf = keptByDevice(() => 0);

function NewRegistration({ device, tools, registered }: NewRegistrationProps) {
  const id = idOf(device.id);
  const table = tableOf(device.id);
  const reference = referenceOf(device.id);
  const measured = measuredOf(device.id);
  const emptied = emptiedOf(device.id);
  const clear = () => {
    measured.value = [];
    emptied.value += 1;
  };
  const pointOf = (row: Row) => measuredFor(measured.value, row, device, reference.value || TRACKER);
  const chosen = useSignal("");
  const able = pointers(tools);
  const tool = able.find((one) => one.id === chosen.value) ?? able[0];
  const read = attempt(() => parseTargets(table.value));
  const points = typeof read === "string" ? [] : read;
  const fiducials = points.flatMap(({ name, position_mm }) => {
    const point = pointOf({ name, position_mm });
    return point ? [{ name, frame_mm: position_mm, measured_mm: point.position_mm, measured_covariance_mm2: point.covariance_mm2 }] : [];
  });
  if (!tool)
    return (
      <Panel title={text.registrations.make}>
        <p class="muted">{text.points.noTool}</p>
      </Panel>
    );
  return (
    <Panel
      title={text.registrations.make}
      actions={
        <button type="button" disabled={!measured.value.length} onClick={clear}>
          {text.registrations.clear}
        </button>
      }
    >
      <p>{text.registrations.help}</p>
      <div class="row">
        <label>
          {text.registrations.id} <input value={id.value} onInput={({ currentTarget }) => (id.value = currentTarget.value.trim())} />
        </label>
        <IdChoice
          label={text.registrations.relativeTo}
          value={reference.value}
          among={tools}
          none={text.tools.tracker}
          without={tool.id}
          choose={(id) => (reference.value = id)}
        />
        <IdChoice label={text.points.tool} value={tool.id} among={able} choose={(id) => (chosen.value = id)} />
        <label>
          {text.tools.file}{" "}
          <input
            type="file"
            accept=".csv,.tsv,.txt,text/csv"
            onChange={async ({ currentTarget }) => {
              const content = await takeText(currentTarget);
              if (content === null) return;
              table.value = content;
              // Another file is another object, even where its points have the same names and positions.
              clear();
            }}
          />
        </label>
      </div>
      <label>
        {text.registrations.table}
        <textarea rows={4} value={table.value} onInput={({ currentTarget }) => (table.value = currentTarget.value)} />
      </label>
      {typeof read === "string" && table.value.trim() ? <Failure message={read} /> : null}
      {points.length ? (
        <Table
          caption={text.registrations.make}
          columns={[text.registrations.point, text.registrations.inFrame, text.registrations.measured, text.column.action]}
          rows={points}
          identity={({ name }) => name}
          empty={text.missing}
          row={({ name, position_mm }) => {
            const point = pointOf({ name, position_mm });
            return [
              name,
              position(position_mm),
              point ? position(point.position_mm, point.covariance_mm2) : text.missing,
              <Action
                label={point ? text.registrations.again(name) : text.registrations.measure(name)}
                operation="POST /api/v1/tools/{tool_id}/points"
                run={async () => {
                  const asked = emptied.value;
                  const point = await measurePoint(tool.id, reference.value || TRACKER, name);
                  if (asked === emptied.value) measured.value = remeasured(measured.value, { name, position_mm }, point);
                }}
              />,
            ];
          }}
        />
      ) : null}
      {points.length && fiducials.length < MIN_POINTS ? <p class="muted">{text.registrations.needed(fiducials.length)}</p> : null}
      <Action
        label={text.registrations.register}
        kind="primary"
        operation="POST /api/v1/registrations"
        disabled={!id.value || fiducials.length < MIN_POINTS}
        run={() => {
          const body = {
            kind: "paired-points" as const,
            id: id.value,
            device_id: device.id,
            reference_id: reference.value || null,
            fiducials,
            targets: points.map(({ name, position_mm }) => ({ name, frame_mm: position_mm })),
            note: "",
          };
          return sent(api.POST("/api/v1/registrations", { body }));
        }}
        done={async () => {
          clear();
          await registered.refresh();
        }}
      />
    </Panel>
  );
}
