/** The scene: sensors, markers and tools in 3D, and the same as tables. */

import { type ReadonlySignal, useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { api, type Schemas, sent } from "../../api/client";
import { device } from "../../devices";
import { type DeviceStream, useDeviceStream } from "../../live/device_stream";
import type { Frame, Point, ToolPose, Track } from "../../live/messages";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { meanSigma, position, significant, withSigma } from "../../ui/format";
import { Badge, Copy, Failure, Panel, Table, useThrottled } from "../../ui/parts";
import type { Vector } from "./geometry";
import { SceneState } from "./scene_state";
import { type Picked, SceneView, type View } from "./scene_view";

const RATE_HZ = 30;
const TABLE_HZ = 4;
const FACTORS = [0, 3, 10, 100, 1000] as const;
const VIEWS = Object.keys(text.scene.views) as View[];

export function Scene() {
  const shown = device.value;
  return shown ? <DeviceScene key={shown.id} device={shown} /> : <p class="muted">{text.device.none}</p>;
}

function DeviceScene({ device: shown }: { device: Schemas["Device"] }) {
  const stream = useDeviceStream(shown.id, ["points", "tracks", "tools"], RATE_HZ);
  const active = shown.active_calibration_id;
  return (
    <>
      <ScenePicture frame={stream.frame} calibration={active} state={useRef(new SceneState()).current}>
        <StreamBanner stream={stream} />
      </ScenePicture>
      {active === null ? <p class="muted">{text.scene.noCalibration}</p> : null}
    </>
  );
}

interface ScenePictureProps {
  /** What is shown, live or recorded. */
  frame: ReadonlySignal<Frame | null>;
  /** The calibration of its points; null: none. */
  calibration: string | null;
  /** What earlier frames leave to be shown. */
  state: SceneState;
  /** The same frames by a second calibration, in another colour. */
  second?: SceneState | null;
  /** Over the picture. */
  children?: ComponentChildren;
}

/** Frames in 3D, and the same as tables. */
export function ScenePicture(props: ScenePictureProps) {
  const { state, calibration: active } = props;
  const selected = useSignal<Picked | null>(null);
  const view = useSignal<View>("free");
  const factor = useSignal<number>(100);
  const planes = useSignal(true);
  const canvas = useRef<HTMLCanvasElement>(null);
  const picture = useRef<SceneView | null>(null);
  const impossible = useSignal(false);
  const calibration = usePolled(
    `calibration ${active}`,
    async () =>
      active === null
        ? null
        : await sent(
            api.GET("/api/v1/calibrations/{calibration_id}", { params: { path: { calibration_id: active } } }),
          ),
    3600,
  );

  useEffect(() => {
    if (!canvas.current) return undefined;
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    try {
      picture.current = new SceneView(canvas.current, (picked) => (selected.value = picked), still);
    } catch {
      impossible.value = true;
      return undefined;
    }
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const themed = () => picture.current?.theme();
    dark.addEventListener("change", themed);
    return () => {
      dark.removeEventListener("change", themed);
      picture.current?.dispose();
      picture.current = null;
    };
  }, []);

  useEffect(() => {
    const found = calibration.value;
    if (found) {
      const control = found.points.map((point) => point.position_mm as Vector);
      const models = found.result.sensors.map(({ model }) => model);
      picture.current?.setCalibration(models, control);
    }
  }, [calibration.value]);

  useEffect(() => {
    const draw = (frame: Frame | null) => {
      if (frame) state.take(frame);
      const chosen = selected.value;
      const markers = frame ? state.markers : [];
      const others = (frame && props.second?.markers) || [];
      picture.current?.setMarkers([...markers, ...others.map((one) => ({ ...one, id: `${one.id} (2)`, kind: "second" as const }))], factor.value, chosen?.id ?? null);
      picture.current?.setTools(frame ? state.tools : []);
      const marker = planes.value ? markers.find(({ id }) => id === chosen?.id) : undefined;
      picture.current?.setPlanes(marker?.position ?? null);
    };
    return props.frame.subscribe(draw);
  }, [props.frame, state, props.second]);

  const frame = useThrottled(() => props.frame.value, TABLE_HZ);
  return (
    <div class="scene">
      <div class="picture">
        <canvas ref={canvas} tabIndex={0} aria-label={text.scene.picture} role="img" />
        {props.children}
        {impossible.value ? <p class="banner">{text.scene.webgl}</p> : null}
        <div class="row controls">
          <div role="group" aria-label={text.scene.view} class="row">
            {VIEWS.map((name) => (
              <button
                key={name}
                type="button"
                aria-pressed={view.value === name}
                onClick={() => {
                  view.value = name;
                  picture.current?.look(name);
                }}
              >
                {text.scene.views[name]}
              </button>
            ))}
          </div>
          <label>
            {text.scene.ellipsoids}{" "}
            <select value={factor.value} onChange={(event) => (factor.value = Number(event.currentTarget.value))}>
              {FACTORS.map((one) => (
                <option key={one} value={one}>
                  {text.scene.ellipsoidFactor(one)}
                </option>
              ))}
            </select>
          </label>
          <label>
            <input
              type="checkbox"
              checked={planes.value}
              onChange={(event) => (planes.value = event.currentTarget.checked)}
            />{" "}
            {text.scene.planes}
          </label>
        </div>
      </div>
      <Failure message={calibration.error} />
      <Selected frame={frame} picked={selected.value} />
      <Tables
        frame={frame}
        state={state}
        selected={selected.value?.id ?? null}
        select={(kind, id) => (selected.value = { kind, id })}
      />
    </div>
  );
}

/** Says over what is shown that it is old, and why. */
export function StreamBanner({ stream }: { stream: DeviceStream }) {
  const connection = stream.connection.value;
  const state = stream.state.value;
  if (connection === "lost") return <Banner>{text.connection.lost}</Banner>;
  if (connection === "refused") return <Banner>{stream.reason.value ?? text.connection.refused}</Banner>;
  if (stream.stale.value && connection === "open") return <Banner>{text.connection.silent}</Banner>;
  if (connection === "open" && state !== null && state !== "running")
    return <Banner>{[text.connection.notRunning(state), stream.reason.value].filter(Boolean).join(" ")}</Banner>;
  return null;
}

function Banner({ children }: { children: string }) {
  return (
    <p class="banner bad over" role="alert">
      {children}
    </p>
  );
}

function markerName(track: Track): string {
  return `track ${track.id}`;
}

function pointName(point: Point, index: number): string {
  return point.marker === null ? `point ${index}` : `marker ${point.marker}`;
}

/** A value for people; "Copy" has all digits. */
function shortened(value: unknown): string {
  if (value === null || value === undefined) return text.missing;
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : significant(value, 5);
  if (Array.isArray(value)) return value.length ? value.map((item) => (Array.isArray(item) ? `(${shortened(item)})` : shortened(item))).join(", ") : text.missing;
  return String(value);
}

function Selected({ frame, picked }: { frame: Frame | null; picked: Picked | null }) {
  const numbers = frame && picked ? numbersOf(frame, picked) : null;
  return (
    <Panel title={text.scene.selected} actions={numbers ? <Copy value={JSON.stringify(numbers)} /> : null}>
      {numbers ? (
        <dl class="numbers">
          {Object.entries(numbers).map(([name, value]) => (
            <div key={name}>
              <dt>{name}</dt>
              <dd>{shortened(value)}</dd>
            </div>
          ))}
        </dl>
      ) : (
        <p class="muted">{text.scene.none}</p>
      )}
    </Panel>
  );
}

function numbersOf(frame: Frame, picked: Picked): object | null {
  if (picked.kind === "tool") return frame.tools?.find(({ tool_id }) => tool_id === picked.id) ?? null;
  return (
    frame.tracks?.find((track) => markerName(track) === picked.id) ??
    frame.points?.find((point, index) => pointName(point, index) === picked.id) ??
    null
  );
}

interface TablesProps {
  frame: Frame | null;
  state: SceneState;
  selected: string | null;
  select: (kind: Picked["kind"], id: string) => void;
}

function Tables({ frame, state, selected, select }: TablesProps) {
  const points = (frame?.points ?? []).map((point, index) => ({ point, id: pointName(point, index) }));
  return (
    <>
      {/* Recorded frames have points only. */}
      {frame?.tools === null ? null : (
      <Panel title={text.scene.tools}>
        <Table
          caption={text.scene.tools}
          columns={[text.column.tool, text.column.status, text.column.tip, text.column.sigma, text.column.residual, text.column.detectable, text.column.reason]}
          rows={frame?.tools ?? []}
          identity={(tool) => tool.tool_id}
          selected={selected}
          select={(id) => select("tool", String(id))}
          empty={text.tools.none}
          row={(tool) => toolRow(tool, frame, state)}
        />
      </Panel>
      )}
      {frame?.tracks === null ? null : (
      <Panel title={text.scene.tracks}>
        <Table
          caption={text.scene.tracks}
          columns={[text.column.track, text.column.state, text.column.position, text.column.sigma, text.column.speed, text.column.flags]}
          rows={frame?.tracks ?? []}
          identity={markerName}
          selected={selected}
          select={(id) => select("marker", String(id))}
          empty={text.scene.nothing}
          row={(track) => [
            markerName(track),
            track.state,
            position(track.position_mm, track.covariance_mm2),
            significant(meanSigma(track.covariance_mm2), 2),
            significant(Math.hypot(...track.velocity_mm_s), 3),
            track.flags.join(", "),
          ]}
        />
      </Panel>
      )}
      <Panel title={text.scene.points}>
        <Table
          caption={text.scene.points}
          columns={[text.column.marker, text.column.position, text.column.sigma, text.column.residual, text.column.sensors, text.column.flags]}
          rows={points}
          identity={({ id }) => id}
          selected={selected}
          select={(id) => select("marker", String(id))}
          empty={text.scene.nothing}
          row={({ point, id }) => [
            id,
            position(point.position_mm, point.covariance_mm2),
            significant(meanSigma(point.covariance_mm2), 2),
            withSigma(point.residual_sigma, 0.1),
            point.sensors.length,
            point.flags.join(", "),
          ]}
        />
      </Panel>
    </>
  );
}

function toolRow(tool: ToolPose, frame: Frame | null, state: SceneState) {
  const lost = frame && tool.status !== "OK" ? state.lostFor(tool.tool_id, frame) : null;
  const ago = lost === null ? null : text.scene.lastSeen(significant(lost, 2));
  const posed = tool.translation_mm !== null;
  return [
    tool.tool_id,
    <Badge kind={tool.status === "OK" ? "good" : posed ? "warn" : "bad"}>{tool.status}</Badge>,
    position(tool.tip_mm ?? tool.translation_mm, tool.tip_covariance_mm2),
    significant(meanSigma(tool.tip_covariance_mm2), 2),
    withSigma(tool.residual_sigma, 0.1),
    significant(tool.detectable_sigma, 2),
    [tool.reason, posed ? null : ago].filter(Boolean).join("; "),
  ];
}
