/** Tools: their state, pivot and spin, points, registrations, and the frames of a device. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { device, type Device } from "../../devices";
import { useDeviceStream } from "../../live/device_stream";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { meanSigma, position, significant } from "../../ui/format";
import { NoDevice } from "../../ui/no_device";
import { Badge, Failure, Panel, Table, useThrottled } from "../../ui/parts";
import { StreamBanner } from "../scene/scene";
import { DefineTool } from "./define_tool";
import { DigitisePoints } from "./digitise";
import { Frames, useFrames } from "./frames";
import { Registrations } from "./registrations";
import { TipCalibration } from "./tip_calibration";
import { ToolSettings } from "./tool_settings";

type Tool = Schemas["Tool"];
const RATE_HZ = 30;
const TABLE_HZ = 4;

export function Tools() {
  const shown = device.value;
  return shown ? <DeviceTools key={shown.id} device={shown} /> : <NoDevice />;
}

function DeviceTools({ device: shown }: { device: Device }) {
  const { id } = shown;
  const stream = useDeviceStream(id, ["tools"], RATE_HZ);
  const polled = usePolled(`tools ${id}`, () =>
    sent(api.GET("/api/v1/tools", { params: { query: { device_id: id, limit: 100 } } })),
  );
  const newest = useThrottled(() => stream.frame.value?.tools ?? [], TABLE_HZ);
  // A status of before must not look like one of now.
  const poses = stream.connection.value === "open" && !stream.stale.value ? newest : [];
  const frames = useFrames(id);
  const chosen = useSignal<string | null>(null);
  const tools = polled.value?.items ?? [];
  const tool = tools.find((one) => one.id === chosen.value);
  return (
    <>
      <Panel title={text.screens.tools}>
        <StreamBanner stream={stream} />
        <Failure message={polled.error} />
        <Table
          caption={text.screens.tools}
          columns={[text.column.tool, text.tools.title, text.column.status, text.column.reason, text.column.tip, text.column.markers]}
          rows={tools}
          identity={(one) => one.id}
          selected={chosen.value}
          select={(one) => (chosen.value = chosen.value === one ? null : String(one))}
          empty={polled.value ? text.tools.none : text.loading}
          row={(one) => {
            const pose = poses.find(({ tool_id }) => tool_id === one.id);
            return [
              one.id,
              one.title,
              pose ? <Badge kind={pose.status === "OK" ? "good" : pose.translation_mm ? "warn" : "bad"}>{pose.status}</Badge> : text.missing,
              pose?.reason ?? "",
              one.tip.position_mm && pose?.tip_mm ? position(pose.tip_mm, pose.tip_covariance_mm2) : tipOf(one),
              one.markers_mm.length,
            ];
          }}
        />
      </Panel>
      {tool ? (
        <Panel key={`${tool.id} ${tool.created_at}`} title={text.tools.chosen(tool.id)}>
          <ToolSettings tool={tool} tools={tools} changed={polled.refresh} />
          <TipCalibration tool={tool} stream={stream} changed={polled.refresh} />
        </Panel>
      ) : null}
      <DefineTool device={id} done={polled.refresh} />
      <DigitisePoints device={id} tools={tools} frames={frames.value?.frames ?? []} />
      <Registrations device={shown} tools={tools} />
      <Frames device={id} polled={frames} />
    </>
  );
}

function tipOf(tool: Tool): string {
  if (!tool.tip.position_mm) return text.tools.noTip;
  const sigma = meanSigma(tool.tip.covariance_mm2);
  return sigma === null ? position(tool.tip.position_mm) : text.tools.tipError(significant(sigma, 2));
}
