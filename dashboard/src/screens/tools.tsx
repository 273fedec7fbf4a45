/** Tools: define by showing, pivot, see each one's state, delete. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../api/client";
import { device } from "../devices";
import { useDeviceStream } from "../live/device_stream";
import { type Polled, usePolled } from "../live/polling";
import { text } from "../text";
import { meanSigma, position, significant } from "../ui/format";
import { Action, Badge, Failure, Panel, Table, useThrottled } from "../ui/parts";
import { StreamBanner } from "./scene/scene";

type Tool = Schemas["Tool"];
type ToolPage = Schemas["Page_Tool_"];
const RATE_HZ = 10;

export function Tools() {
  const shown = device.value;
  return shown ? <DeviceTools key={shown.id} id={shown.id} /> : <p class="muted">{text.device.none}</p>;
}

function DeviceTools({ id }: { id: string }) {
  const stream = useDeviceStream(id, ["tools"], RATE_HZ);
  const tools = usePolled(`tools ${id}`, () =>
    sent(api.GET("/api/v1/tools", { params: { query: { device_id: id, limit: 100 } } })),
  );
  const poses = useThrottled(() => stream.frame.value?.tools ?? [], 4);
  return (
    <>
      <StreamBanner stream={stream} />
      <Panel title={text.screens.tools}>
        <Failure message={tools.error} />
        <Table
          caption={text.screens.tools}
          columns={[text.column.tool, text.column.status, text.column.reason, text.column.tip, text.column.markers, text.column.action]}
          rows={tools.value?.items ?? []}
          identity={(tool) => tool.id}
          empty={tools.value ? text.tools.none : text.loading}
          row={(tool) => {
            const pose = poses.find((one) => one.tool_id === tool.id);
            return [
              tool.title || tool.id,
              pose ? <Badge kind={pose.status === "OK" ? "good" : pose.translation_mm ? "warn" : "bad"}>{pose.status}</Badge> : text.missing,
              pose?.reason ?? "",
              pose?.tip_mm ? position(pose.tip_mm, pose.tip_covariance_mm2) : tipOf(tool),
              tool.markers_mm.length,
              <ToolActions tool={tool} tools={tools} />,
            ];
          }}
        />
      </Panel>
      <DefineTool device={id} tools={tools} />
    </>
  );
}

function tipOf(tool: Tool): string {
  if (!tool.tip.position_mm) return text.tools.noTip;
  const sigma = meanSigma(tool.tip.covariance_mm2);
  return sigma === null ? position(tool.tip.position_mm) : text.tools.tipError(significant(sigma, 2));
}

function ToolActions({ tool, tools }: { tool: Tool; tools: Polled<ToolPage> }) {
  const path = { path: { tool_id: tool.id } };
  return (
    <div class="row">
      <Action
        label={text.tools.pivot}
        operation="POST /api/v1/tools/{tool_id}/pivot-calibrations"
        run={() => sent(api.POST("/api/v1/tools/{tool_id}/pivot-calibrations", { params: path, body: { duration_s: 10, poses: 500, relative: true, apply: true } }))}
        done={tools.refresh}
      />
      <Action
        label={text.tools.remove}
        kind="danger"
        operation="DELETE /api/v1/tools/{tool_id}"
        confirm={text.confirm.remove(tool.id)}
        run={() => sent(api.DELETE("/api/v1/tools/{tool_id}", { params: path }))}
        done={tools.refresh}
      />
    </div>
  );
}

function DefineTool({ device: shown, tools }: { device: string; tools: Polled<ToolPage> }) {
  const id = useSignal("");
  const markers = useSignal(4);
  return (
    <Panel title={text.tools.define}>
      <p>{text.tools.show}</p>
      <div class="row">
        <label>
          {text.tools.id} <input value={id.value} onInput={(event) => (id.value = event.currentTarget.value)} />
        </label>
        <label>
          {text.tools.markers}{" "}
          <input
            type="number"
            min={3}
            max={32}
            value={markers.value}
            onInput={(event) => (markers.value = event.currentTarget.valueAsNumber)}
          />
        </label>
        <Action
          label={text.tools.capture}
          kind="primary"
          operation="POST /api/v1/tool-captures"
          disabled={!id.value}
          run={() =>
            sent(api.POST("/api/v1/tool-captures", { body: { id: id.value, device_id: shown, title: id.value, note: "", duration_s: 2, markers: markers.value } }))
          }
          done={tools.refresh}
        />
      </div>
      <p class="muted">{text.tools.pivotHelp}</p>
    </Panel>
  );
}
