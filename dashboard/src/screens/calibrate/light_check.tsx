/** What each sensor sees now, and what to do about the light. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import type { Device } from "../../devices";
import { useDeviceStream } from "../../live/device_stream";
import type { Frame } from "../../live/messages";
import { text } from "../../text";
import { significant } from "../../ui/format";
import { Badge, Panel, Table } from "../../ui/parts";
import { StreamBanner } from "../scene/scene";
import { judgeLight, type SensorLight } from "./light";

const RATE_HZ = 20;
/** Frames that are judged together: two seconds. */
const FRAMES = 40;
const TABLE_MS = 500;

export function LightCheck({ device }: { device: Device }) {
  const stream = useDeviceStream(device.id, ["peaks"], RATE_HZ);
  const names = device.sensors.map(({ name }) => name);
  const lights = useSignal<readonly SensorLight[]>([]);
  useEffect(() => {
    let frames: Frame[] = [];
    const stop = stream.frame.subscribe((frame) => {
      frames = frame ? [...frames.slice(1 - FRAMES), frame] : [];
    });
    const timer = setInterval(() => (lights.value = frames.length ? judgeLight(names, frames) : []), TABLE_MS);
    return () => {
      stop();
      clearInterval(timer);
    };
  }, [stream]);
  return (
    <Panel title={text.light.title}>
      <div class="under">
        <StreamBanner stream={stream} />
      </div>
      <Table
        caption={text.light.title}
        columns={[text.light.sensor, text.light.verdict, text.light.advice, text.light.seen, text.light.peaks, text.light.amplitude, text.light.sigma, text.light.width]}
        rows={lights.value}
        identity={({ sensor }) => sensor}
        empty={text.light.waiting}
        row={(one) => [
          one.sensor,
          <Badge kind={one.verdict}>{text.light.verdicts[one.verdict]}</Badge>,
          one.advice,
          `${Math.round(100 * one.seen)} %`,
          significant(one.peaks, 2),
          significant(one.amplitude, 3),
          significant(one.sigma_px, 2),
          significant(one.width_px, 3),
        ]}
      />
    </Panel>
  );
}
