/** The scene: sensors, markers and tools in 3D, and the same as tables. */

import { effect, type ReadonlySignal, useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { api, type Schemas, sent } from "../../api/client";
import { allowed } from "../../api/session";
import { device, loadDevices } from "../../devices";
import { type DeviceStream, useDeviceStream } from "../../live/device_stream";
import type { Frame, ToolPose, Track } from "../../live/messages";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { meanSigma, position, significant, withSigma } from "../../ui/format";
import { NoDevice } from "../../ui/no_device";
import { NOMINAL_OPERATIONS, useNominal } from "../../ui/nominal_calibration";
import { Action, Badge, Copy, Failure, Panel, Table, useThrottled } from "../../ui/parts";
import { centreOf, type SensorModel, sensorPose, type Vector } from "./geometry";
import { SceneState } from "./scene_state";
import { type Picked, SceneView, type ToolShape, type View } from "./scene_view";

type Tool = Schemas["Tool"];

const RATE_HZ = 30;
const TABLE_HZ = 4;
const TOOLS_S = 5;
const FACTORS = [0, 3, 10, 100, 1000] as const;
const VIEWS = Object.keys(text.scene.views) as View[];

export function Scene() {
  const shown = device.value;
  return shown ? <DeviceScene key={shown.id} device={shown} /> : <NoDevice />;
}

function DeviceScene({ device: shown }: { device: Schemas["Device"] }) {
  const stream = useDeviceStream(shown.id, ["points", "tracks", "tools"], RATE_HZ);
  const active = shown.active_calibration_id;
  const profile = shown.source.kind === "profile" ? shown.source.profile_id : null;
  const may = allowed("GET /api/v1/tools");
  const tools = usePolled(
    `tools ${shown.id} ${may}`,
    async () => (may ? await sent(api.GET("/api/v1/tools", { params: { query: { device_id: shown.id, limit: 100 } } })) : null),
    TOOLS_S,
  );
  return (
    <>
      <ScenePicture
        frame={stream.frame}
        calibration={active}
        state={useRef(new SceneState()).current}
        tools={tools.value?.items ?? NO_TOOLS}
        volume={shown.tracking.volume_mm ?? null}
        old={stream.stale.value}
      >
        <StreamBanner stream={stream} />
      </ScenePicture>
      {active === null ? <p class="muted">{text.scene.noCalibration}</p> : null}
      {active === null && profile !== null ? (
        <div class="row">
          <Action label={text.scene.useNominal} operation={NOMINAL_OPERATIONS} run={() => useNominal(shown.id, profile)} done={async () => void (await loadDevices())} />
          <span class="muted">{text.scene.useNominalHelp}</span>
        </div>
      ) : null}
    </>
  );
}

const NO_TOOLS: readonly Tool[] = [];

interface ScenePictureProps {
  /** What is shown, live or recorded. */
  frame: ReadonlySignal<Frame | null>;
  /** The calibration of its points; null: none. */
  calibration: string | null;
  /** What earlier frames leave to be shown. */
  state: SceneState;
  /** The same frames by a second calibration, in another colour. */
  second?: SceneState | null;
  /** The tools whose poses the frames have. */
  tools?: readonly Tool[];
  /** Lowest and highest corner of the volume that the calibration is good for [mm]; null: not said. */
  volume?: readonly [Vector, Vector] | null;
  /** What is shown is of before. */
  old?: boolean;
  /** Over the picture. */
  children?: ComponentChildren;
}

/** Frames in 3D, and the same as tables. */
export function ScenePicture(props: ScenePictureProps) {
  const { state, calibration: active, tools = NO_TOOLS, volume = null } = props;
  const selected = useSignal<Picked | null>(null);
  const view = useSignal<View>("free");
  const factor = useSignal<number>(100);
  const planes = useSignal(true);
  /** The frame that the state has taken last, and the number of changes besides frames. */
  const taken = useRef<Frame | null>(null);
  const changes = useSignal(0);
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
      picture.current?.setCalibration(models, control, volume);
      changes.value += 1;
    }
  }, [calibration.value, JSON.stringify(volume)]);

  // Drawn with each frame, and also when another thing is chosen: a paused or stopped one sends no frame.
  useEffect(
    () =>
      effect(() => {
        const frame = props.frame.value;
        const chosen = selected.value;
        void changes.value;
        if (frame && frame !== taken.current) state.take(frame);
        taken.current = frame;
        const markers = frame ? state.markers : [];
        const others = (frame && props.second?.markers) || [];
        picture.current?.setMarkers([...markers, ...others.map((one) => ({ ...one, id: one.id + SECOND, kind: "second" as const }))], factor.value, chosen?.id ?? null);
        picture.current?.setTools(frame ? state.tools : [], shapesOf(tools, chosen));
        const marker = planes.value ? markers.find(({ id }) => id === chosen?.id) : undefined;
        picture.current?.setPlanes(marker?.position ?? null);
      }),
    [props.frame, state, props.second, tools],
  );

  const frame = useThrottled(() => props.frame.value, TABLE_HZ);
  return (
    <div class="scene">
      <div class="picture">
        <canvas ref={canvas} class={props.old ? "stale" : undefined} tabIndex={0} aria-label={text.scene.picture} role="img" />
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
      {calibration.value?.provenance === "nominal" ? <p class="muted">{text.scene.nominal}</p> : null}
      {volume ? <p class="muted">{text.scene.volume(...boxRanges(volume))}</p> : null}
      <div class={props.old ? "stale" : undefined}>
        <Selected frame={frame} state={state} second={props.second ?? null} picked={selected.value} />
        <Tables
          frame={frame}
          state={state}
          selected={selected.value?.id ?? null}
          select={(kind, id) => (selected.value = { kind, id })}
        />
      </div>
      {calibration.value ? (
        <Sensors
          models={calibration.value.result.sensors.map(({ model }) => model)}
          control={calibration.value.points.map((point) => point.position_mm as Vector)}
        />
      ) : null}
    </div>
  );
}

/** The tools' markers; the axes of the reference of the chosen tool carry their names. */
function shapesOf(tools: readonly Tool[], chosen: Picked | null): ReadonlyMap<string, ToolShape> {
  const reference = chosen?.kind === "tool" ? tools.find(({ id }) => id === chosen.id)?.reference_id : null;
  return new Map(tools.map(({ id, markers_mm }) => [id, { markers_mm, named: id === reference }]));
}

function Sensors({ models, control }: { models: readonly SensorModel[]; control: readonly Vector[] }) {
  const near = centreOf(control);
  const rows = models.map((model) => ({ name: model.name, pose: sensorPose(model, near) }));
  return (
    <Panel title={text.scene.sensors}>
      <Table
        caption={text.scene.sensors}
        columns={[text.light.sensor, text.column.position, text.scene.looksAlong, text.scene.pixelsAlong]}
        rows={rows}
        identity={({ name }) => name}
        empty={text.missing}
        row={({ name, pose }) => [name, lengths(pose.position, 1), lengths(pose.axes[2], 4), lengths(pose.axes[0], 4)]}
      />
      <p class="muted">{text.scene.sensorsHelp}</p>
    </Panel>
  );
}

function boxRanges([low, high]: readonly [Vector, Vector]): [string, string, string] {
  return [0, 1, 2].map((axis) => `${significant(low[axis], 4)} … ${significant(high[axis], 4)}`) as [string, string, string];
}

function lengths(vector: Vector, decimals: number): string {
  return vector.map((value) => value.toFixed(decimals)).join(", ");
}

/** Says over what is shown that it is old, and why. */
export function StreamBanner({ stream }: { stream: DeviceStream }) {
  const connection = stream.connection.value;
  const state = stream.state.value;
  if (connection === "connecting" && stream.stale.value)
    return stream.hello.value ? <Banner>{text.connection.connectingAgain}</Banner> : <Banner role="status">{text.connection.connecting}</Banner>;
  if (connection === "lost") return <Banner>{text.connection.lost}</Banner>;
  if (connection === "refused") return <Banner>{stream.reason.value ?? text.connection.refused}</Banner>;
  // Nothing is shown that could be old.
  if (stream.stale.value && connection === "open" && stream.received === 0) return <Banner role="status">{[text.connection.noFrameYet, stream.reason.value].filter(Boolean).join(" ")}</Banner>;
  if (stream.stale.value && connection === "open") return <Banner>{text.connection.silent}</Banner>;
  if (connection === "open" && state !== null && state !== "running")
    return <Banner>{[text.connection.notRunning(state), stream.reason.value].filter(Boolean).join(" ")}</Banner>;
  return null;
}

function Banner({ children, role = "alert" }: { children: string; role?: "alert" | "status" }) {
  return (
    <p class={`banner over ${role === "alert" ? "bad" : ""}`} role={role}>
      {children}
    </p>
  );
}

/** Behind the name of what a second calibration gives. */
const SECOND = " (2)";

function markerName(track: Track): string {
  return `track ${track.id}`;
}

/** A value for people; "Copy" has all digits. */
function shortened(value: unknown): string {
  if (value === null || value === undefined) return text.missing;
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : significant(value, 5);
  if (Array.isArray(value)) return value.length ? value.map((item) => (Array.isArray(item) ? `(${shortened(item)})` : shortened(item))).join(", ") : text.missing;
  return String(value);
}

interface SelectedProps {
  frame: Frame | null;
  state: SceneState;
  second: SceneState | null;
  picked: Picked | null;
}

function Selected({ frame, state, second, picked }: SelectedProps) {
  const numbers = frame && picked ? numbersOf(frame, state, second, picked) : null;
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

function numbersOf(frame: Frame, state: SceneState, second: SceneState | null, picked: Picked): object | null {
  if (picked.kind === "marker" && picked.id.endsWith(SECOND)) {
    const marker = second?.markers.find(({ id }) => id + SECOND === picked.id);
    return marker ? { id: picked.id, position_mm: marker.position, covariance_mm2: marker.covariance } : null;
  }
  if (picked.kind === "tool") return frame.tools?.find(({ tool_id }) => tool_id === picked.id) ?? null;
  return (
    frame.tracks?.find((track) => markerName(track) === picked.id) ??
    state.points.find(({ id }) => id === picked.id)?.point ??
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
  return (
    <>
      {/* Recorded frames may have points only. */}
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
          rows={frame ? state.points : []}
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
