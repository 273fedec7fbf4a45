/** Registrations: frames of images and phantoms, from points that are known there and touched with a tool. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { type Polled, usePolled } from "../../live/polling";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { position, significant } from "../../ui/format";
import { IdChoice } from "../../ui/id_choice";
import { Action, Failure, Panel, Table } from "../../ui/parts";
import { parseTargets } from "../../ui/targets";
import { readText } from "../../ui/text_file";
import { type MeasuredPoint, measurePoint, pointers } from "./digitise";
import { keptByDevice } from "./kept";

type Tool = Schemas["Tool"];
type Registration = Schemas["Registration"];

const MIN_POINTS = 3;

export function Registrations({ device, tools }: { device: string; tools: readonly Tool[] }) {
  const polled = usePolled(`registrations ${device}`, () =>
    sent(api.GET("/api/v1/registrations", { params: { query: { device_id: device, limit: 100 } } })),
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
  device: string;
  tools: readonly Tool[];
  registered: Polled<{ items: Registration[] }>;
}

const idOf = keptByDevice(() => "");
const tableOf = keptByDevice(() => "");
const referenceOf = keptByDevice(() => "");
/** By name of the point. */
const measuredOf = keptByDevice<ReadonlyMap<string, MeasuredPoint>>(() => new Map());

function NewRegistration({ device, tools, registered }: NewRegistrationProps) {
  const id = idOf(device);
  const table = tableOf(device);
  const reference = referenceOf(device);
  const measured = measuredOf(device);
  const chosen = useSignal("");
  const able = pointers(tools);
  const tool = able.find((one) => one.id === chosen.value) ?? able[0];
  const read = attempt(() => parseTargets(table.value));
  const points = typeof read === "string" ? [] : read;
  const fiducials = points.flatMap(({ name, position_mm }) => {
    const point = measured.value.get(name);
    return point ? [{ name, frame_mm: position_mm, measured_mm: point.position_mm, measured_covariance_mm2: point.covariance_mm2 }] : [];
  });
  if (!tool)
    return (
      <Panel title={text.registrations.make}>
        <p class="muted">{text.points.noTool}</p>
      </Panel>
    );
  return (
    <Panel title={text.registrations.make}>
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
          choose={(id) => {
            reference.value = id;
            // What was measured is in another frame.
            measured.value = new Map();
          }}
        />
        <IdChoice label={text.points.tool} value={tool.id} among={able} choose={(id) => (chosen.value = id)} />
        <label>
          {text.tools.file}{" "}
          <input
            type="file"
            accept=".csv,.tsv,.txt,text/csv"
            onChange={async ({ currentTarget }) => {
              const file = currentTarget.files?.[0];
              if (file) table.value = await readText(file);
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
            const point = measured.value.get(name);
            return [
              name,
              position(position_mm),
              point ? position(point.position_mm, point.covariance_mm2) : text.missing,
              <Action
                label={point ? text.registrations.again(name) : text.registrations.measure(name)}
                operation="POST /api/v1/tools/{tool_id}/points"
                run={async () => {
                  const asked = reference.value;
                  const point = await measurePoint(tool.id, asked || "tracker", name);
                  if (asked === reference.value) measured.value = new Map(measured.value).set(name, point);
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
            device_id: device,
            reference_id: reference.value || null,
            fiducials,
            targets: points.map(({ name, position_mm }) => ({ name, frame_mm: position_mm })),
            note: "",
          };
          return sent(api.POST("/api/v1/registrations", { body }));
        }}
        done={registered.refresh}
      />
    </Panel>
  );
}
