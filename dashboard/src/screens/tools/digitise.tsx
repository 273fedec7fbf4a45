/** Points measured with a tool's tip, to look at and to save. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { text } from "../../text";
import { download, toCsv } from "../../ui/download";
import { meanSigma, position, significant } from "../../ui/format";
import { IdChoice } from "../../ui/id_choice";
import { Action, Panel, Table } from "../../ui/parts";
import { tone } from "../../ui/tone";
import { following } from "./entries";
import { keptByDevice } from "./kept";

type Tool = Schemas["Tool"];
export type MeasuredPoint = Schemas["MeasuredPoint"];

/** Measure a point with a tool's tip: a high tone when it is, a low one when it could not be. */
export async function measurePoint(tool: string, frame: string | null, name: string): Promise<MeasuredPoint> {
  const body = { name: name || null, frame_id: frame, duration_s: 0.5, max_sigma_mm: 0.5, max_drift_mm: 0.3, timeout_s: 30 };
  try {
    const point = await sent(api.POST("/api/v1/tools/{tool_id}/points", { params: { path: { tool_id: tool } }, body }));
    tone(880, 0.2);
    return point;
  } catch (error) {
    tone(220, 0.4);
    throw error;
  }
}

/** Tools that have a tip to touch with. */
export function pointers(tools: readonly Tool[]): readonly Tool[] {
  return tools.filter(({ tip }) => tip.position_mm !== null);
}

const pointsOf = keptByDevice<readonly MeasuredPoint[]>(() => []);
/** Of the next point. */
const nameOf = keptByDevice(() => "1");

export function DigitisePoints({ device, tools, frames }: { device: string; tools: readonly Tool[]; frames: readonly Schemas["FrameState"][] }) {
  const able = pointers(tools);
  const chosen = useSignal("");
  const frame = useSignal("");
  const name = nameOf(device);
  const points = pointsOf(device);
  const tool = able.find(({ id }) => id === chosen.value) ?? able[0];
  const shown = points.value;
  const save = () => {
    const rows = shown.map((point) => {
      const sigma = [0, 1, 2].map((axis) => Math.sqrt(point.covariance_mm2[axis]?.[axis] ?? Number.NaN));
      return [point.name ?? "", ...point.position_mm, ...sigma, point.frame_id, point.tool_id];
    });
    download(new Blob([toCsv([text.points.csvColumns, ...rows])], { type: "text/csv" }), text.points.csvName);
  };
  return (
    <Panel
      title={text.points.title}
      actions={
        <>
          <button type="button" disabled={!shown.length} onClick={save}>
            {text.points.save}
          </button>
          <button type="button" disabled={!shown.length} onClick={() => (points.value = [])}>
            {text.points.clear}
          </button>
        </>
      }
    >
      {tool ? (
        <>
          <p>{text.points.help}</p>
          <div class="row">
            <IdChoice label={text.points.tool} value={tool.id} among={able} choose={(id) => (chosen.value = id)} />
            <IdChoice
              label={text.points.frame}
              value={frame.value}
              among={frames}
              none={text.points.byTool}
              without={tool.id}
              choose={(id) => (frame.value = id)}
            />
            <label>
              {text.points.name} <input value={name.value} onInput={({ currentTarget }) => (name.value = currentTarget.value)} />
            </label>
            <Action
              label={text.points.measure}
              kind="primary"
              operation="POST /api/v1/tools/{tool_id}/points"
              run={async () => {
                points.value = [...points.value, await measurePoint(tool.id, frame.value || null, name.value)];
                name.value = following(name.value);
              }}
            />
          </div>
        </>
      ) : (
        <p class="muted">{text.points.noTool}</p>
      )}
      <Table
        caption={text.points.title}
        columns={[text.column.name, text.column.position, text.column.sigma, text.points.drift, text.points.frames, text.points.frame, text.column.tool]}
        rows={shown}
        identity={(point) => shown.indexOf(point)}
        empty={text.points.none}
        row={(point) => [
          point.name ?? "",
          position(point.position_mm, point.covariance_mm2),
          significant(meanSigma(point.covariance_mm2), 2),
          significant(point.drift_mm, 2),
          point.frames,
          point.frame_id,
          point.tool_id,
        ]}
      />
    </Panel>
  );
}
