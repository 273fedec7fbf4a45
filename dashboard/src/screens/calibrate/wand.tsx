/** Wand: what is waved, coverage as it grows and what is missing, then the calibration. */

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, type Schemas, sent, tagged } from "../../api/client";
import { type Device, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { significant } from "../../ui/format";
import { keptSignal } from "../../ui/kept";
import { Action, Failure, Panel, Table } from "../../ui/parts";
import { RunAction } from "../../ui/run_action";
import { sectors } from "./direction_grid";
import { Sessions } from "./sessions";
import { tone } from "../../ui/tone";
import { directions, wand } from "./wand_input";

type Wave = Schemas["WaveCapture"];
const DISTORTIONS = ["none", "symmetric-3", "symmetric-5", "all-3"] as const;
const INITIAL = ["active", "readings-in-frame", "readings"] as const;

interface WandProps {
  device: Device;
  calibrated: (calibration: string) => void;
}

export function WandCalibration({ device, calibrated }: WandProps) {
  const session = keptSignal(`wave capture ${device.id}`);
  const waves = usePolled(`waves ${device.id}`, () =>
    sent(api.GET("/api/v1/wave-captures", { params: { query: { device_id: device.id, limit: 20 } } })),
  );
  if (session.value)
    return (
      <WaveSession
        key={session.value}
        id={session.value}
        device={device}
        close={() => {
          session.value = null;
          void waves.refresh();
        }}
        calibrated={calibrated}
      />
    );
  return (
    <>
      <NewWave device={device} begun={(id) => (session.value = id)} />
      <Sessions
        polled={waves}
        column={text.wand.poses}
        done={({ progress }) => text.wand.progress(progress.poses, progress.wanted_poses)}
        open={(id) => (session.value = id)}
      />
    </>
  );
}

function NewWave({ device, begun }: { device: Device; begun: (id: string) => void }) {
  const positions = useSignal("0, 300");
  const markers = useSignal("0, 1");
  const read = attempt(() => wand(positions.value, markers.value));
  return (
    <Panel title={text.wand.title}>
      <p>{text.wand.help}</p>
      <div class="row">
        <label>
          {text.wand.positions}{" "}
          <input value={positions.value} onInput={(event) => (positions.value = event.currentTarget.value)} />
        </label>
        <label>
          {text.wand.markers}{" "}
          <input value={markers.value} onInput={(event) => (markers.value = event.currentTarget.value)} />
        </label>
      </div>
      <Failure message={typeof read === "string" ? read : null} />
      <div class="row">
        <Action
          label={text.wand.begin}
          kind="primary"
          operation="POST /api/v1/wave-captures"
          disabled={typeof read === "string"}
          run={async () => {
            if (typeof read === "string") return;
            const body = {
              device_id: device.id,
              target: { kind: "wand" as const, position_mm: read.position_mm, sigma_mm: 0 },
              markers: read.markers,
              settings: { duration_s: 180, end_when_enough: true },
              note: "",
            };
            begun((await sent(api.POST("/api/v1/wave-captures", { body }))).id);
          }}
        />
        {device.source.kind === "simulated" && typeof read !== "string" ? (
          <SimulatedWand device={device} position_mm={read.position_mm} />
        ) : null}
      </div>
    </Panel>
  );
}

/** Lets the simulated device show a waved wand, so that the way can be tried without hardware. */
function SimulatedWand({ device, position_mm }: { device: Device; position_mm: readonly number[] }) {
  const path = { path: { device_id: device.id } };
  return (
    <Action
      label={text.wand.simulate}
      operation="PATCH /api/v1/devices/{device_id}"
      run={async () => {
        const { document: now, tag } = await tagged(api.GET("/api/v1/devices/{device_id}", { params: path }));
        if (now.source.kind !== "simulated") return;
        const scene = {
          kind: "waved-wand",
          length_mm: Math.max(...position_mm) - Math.min(...position_mm),
        } as Schemas["WavedWand"];
        const settings = { ...now.source.settings, scene, illumination: "strobed" as const, strobe: null, blink: null };
        await sent(
          api.PATCH("/api/v1/devices/{device_id}", {
            params: { ...path, header: { "If-Match": tag } },
            body: { source: { kind: "simulated", settings: settings as Schemas["SimulationSettings"] } },
          }),
        );
        // A device shows what it is started with.
        await sent(api.POST("/api/v1/devices/{device_id}/stop", { params: path }));
        await sent(api.POST("/api/v1/devices/{device_id}/start", { params: path }));
      }}
      done={async () => void (await loadDevices())}
    />
  );
}

function WaveSession({ id, device, close, calibrated }: WandProps & { id: string; close: () => void }) {
  const path = { params: { path: { wave_capture_id: id } } };
  const polled = usePolled(`wave ${id}`, () => sent(api.GET("/api/v1/wave-captures/{wave_capture_id}", path)), 0.5);
  const wave = polled.value;
  const state = wave ? stateOf(wave) : "ready";
  useSoundOfEnd(wave);
  return (
    <>
      <Panel
        title={text.calibrate.capturing(id)}
        actions={
          <>
            <Action
              label={text.tools.remove}
              kind="danger"
              operation="DELETE /api/v1/wave-captures/{wave_capture_id}"
              confirm={text.confirm.remove(id)}
              run={() => sent(api.DELETE("/api/v1/wave-captures/{wave_capture_id}", path))}
              done={close}
            />
            <button type="button" onClick={close}>
              {text.calibrate.leave}
            </button>
          </>
        }
      >
        <Failure message={polled.error} />
        {wave ? (
          <div class={`capture ${CLASSES[state]}`}>
            <p class="large" role="status">
              {text.wand.states[state]}
            </p>
            <p>{text.wand.progress(wave.progress.poses, wave.progress.wanted_poses)}</p>
            <progress
              max={wave.progress.wanted_poses}
              value={Math.min(wave.progress.poses, wave.progress.wanted_poses)}
              aria-label={text.column.progress}
            />
            <div class="row">
              {wave.state === "capturing" ? (
                <Action
                  label={text.wand.stop}
                  operation="POST /api/v1/wave-captures/{wave_capture_id}/stop"
                  run={() => sent(api.POST("/api/v1/wave-captures/{wave_capture_id}/stop", path))}
                  done={polled.refresh}
                />
              ) : (
                <Action
                  label={wave.state === "ready" ? text.wand.start : text.wand.more}
                  kind="primary"
                  operation="POST /api/v1/wave-captures/{wave_capture_id}/start"
                  run={() => sent(api.POST("/api/v1/wave-captures/{wave_capture_id}/start", path))}
                  done={polled.refresh}
                />
              )}
            </div>
            {wave.ended ? <p>{text.wand.ended(wave.ended)}</p> : null}
            <Missing wave={wave} />
          </div>
        ) : null}
      </Panel>
      {wave ? <Coverage wave={wave} /> : null}
      {wave ? <WandRun wave={wave} device={device} calibrated={calibrated} /> : null}
    </>
  );
}

type State = "ready" | "waving" | "enough" | "stopped";
const CLASSES = { ready: "", waving: "measuring", enough: "captured", stopped: "failed" } as const;

function stateOf({ state, progress }: Wave): State {
  if (progress.enough) return "enough";
  return state === "capturing" ? "waving" : state;
}

/** A high tone when there is enough, a low one when poses are taken no more before. */
function useSoundOfEnd(wave: Wave | null): void {
  const before = useRef(false);
  const capturing = wave?.state === "capturing";
  useEffect(() => {
    if (before.current && wave && !capturing) tone(wave.progress.enough ? 880 : 220, 0.4);
    if (wave) before.current = capturing;
  }, [capturing, wave === null]);
}

function Missing({ wave }: { wave: Wave }) {
  const { missing } = wave.progress;
  if (wave.state === "ready" || !missing.length) return null;
  return (
    <>
      <h3>{text.wand.missing}</h3>
      <ul>
        {missing.map((sentence) => (
          <li key={sentence}>{sentence}</li>
        ))}
      </ul>
    </>
  );
}

function Coverage({ wave }: { wave: Wave }) {
  const { sensors, exposures, directions: held, volume } = wave.progress;
  return (
    <Panel title={text.calibrate.coverage}>
      <Table
        caption={text.calibrate.coverage}
        columns={[text.light.sensor, text.wand.pixels, text.calibrate.readings, text.wand.clear, text.wand.unclear, text.wand.unseen]}
        rows={sensors}
        identity={({ sensor }) => sensor}
        empty={text.calibrate.nothing}
        row={(one) => {
          const all = one.clear + one.unclear + one.unseen;
          return [
            one.sensor,
            <Cells sensor={one} />,
            one.readings,
            percent(one.clear, all),
            percent(one.unclear, all),
            percent(one.unseen, all),
          ];
        }}
      />
      <p>
        {text.wand.exposures(exposures.all, exposures.taken, exposures.still, exposures.too_few_sensors, exposures.not_lit)}
      </p>
      {held ? (
        <figure>
          <DirectionDisc directions={held} />
          <figcaption>{text.wand.directions(held.bins.filter((count) => count >= held.wanted).length, held.bins.length)}</figcaption>
        </figure>
      ) : (
        <p class="muted">{text.wand.noDirections}</p>
      )}
      {volume ? <p>{text.wand.volume(volume.extent_mm.map((size) => significant(size, 3)).join(" × "))}</p> : null}
    </Panel>
  );
}

function percent(count: number, all: number): string {
  return all ? `${Math.round((100 * count) / all)} %` : text.missing;
}

/** Readings in equal parts of a sensor's pixels; parts with enough are filled. */
function Cells({ sensor: { cells, covered, wanted } }: { sensor: Schemas["WaveSensor"] }) {
  const most = Math.max(wanted, ...cells);
  return (
    <svg class="bins cells" viewBox={`0 0 ${cells.length} 1`} preserveAspectRatio="none" role="img" aria-label={text.wand.covered(Math.round(100 * covered))}>
      {cells.map((count, index) => {
        const height = Math.max(0.1, count / most);
        return <rect key={index} class={count >= wanted ? "full" : "empty"} x={index + 0.05} y={1 - height} width={0.9} height={height} />;
      })}
    </svg>
  );
}

function DirectionDisc({ directions: held }: { directions: Schemas["WaveDirections"] }) {
  const full = held.bins.filter((count) => count >= held.wanted).length;
  return (
    <svg class="bins disc" viewBox="-1.05 -1.05 2.1 2.1" role="img" aria-label={text.wand.directions(full, held.bins.length)}>
      {sectors(held.rings, held.bins).map(({ path, count }) => (
        <path key={path} d={path} class={count >= held.wanted ? "full" : "empty"} />
      ))}
    </svg>
  );
}

function WandRun({ wave, device, calibrated }: { wave: Wave } & WandProps) {
  const active = device.active_calibration_id;
  const initial = useSignal<(typeof INITIAL)[number]>(active ? "active" : "readings");
  const distortion = useSignal<(typeof DISTORTIONS)[number]>("none");
  const entered = useSignal<Record<string, string>>({});
  const names = device.sensors.map(({ name }) => name);
  const free = initial.value === "readings";
  const given = attempt(() => (free ? directions(entered.value, names) : null));
  return (
    <Panel title={text.calibrate.compute}>
      <div class="row">
        <label>
          {text.wand.initial}{" "}
          <select value={initial.value} onChange={({ currentTarget }) => (initial.value = currentTarget.value as typeof initial.value)}>
            {INITIAL.filter((one) => active || one === "readings").map((one) => (
              <option key={one} value={one}>
                {text.wand.initials[one]}
              </option>
            ))}
          </select>
        </label>
        {free ? (
          <label>
            {text.wand.distortion}{" "}
            <select value={distortion.value} onChange={({ currentTarget }) => (distortion.value = currentTarget.value as typeof distortion.value)}>
              {DISTORTIONS.map((one) => (
                <option key={one} value={one}>
                  {one}
                </option>
              ))}
            </select>
          </label>
        ) : null}
      </div>
      {free ? (
        <fieldset>
          <legend>{text.wand.pixelDirections}</legend>
          <p class="muted">{text.wand.pixelDirectionsHelp}</p>
          <div class="row">
            {names.map((name) => (
              <label key={name}>
                {name}{" "}
                <input
                  size={5}
                  value={entered.value[name] ?? ""}
                  onInput={({ currentTarget }) => (entered.value = { ...entered.value, [name]: currentTarget.value })}
                />
              </label>
            ))}
          </div>
          <Failure message={typeof given === "string" ? given : null} />
        </fieldset>
      ) : null}
      {wave.progress.enough || wave.state === "ready" ? null : <p class="muted">{text.wand.notEnough}</p>}
      <RunAction
        label={text.calibrate.computeAction}
        operation="POST /api/v1/runs/self-calibration"
        session={wave.id}
        disabled={wave.state === "capturing" || wave.progress.exposures.taken === 0 || typeof given === "string"}
        start={() => {
          const body = {
            device_id: wave.device_id,
            wave_capture_id: wave.id,
            initial: initial.value === "active" ? ("start" as const) : ("readings" as const),
            start_calibration_id: free ? null : active,
            directions_deg: typeof given === "string" ? null : given,
            distortion: free ? distortion.value : ("none" as const),
            datum: "start" as const,
            note: "",
          };
          return sent(api.POST("/api/v1/runs/self-calibration", { body }));
        }}
        done={calibrated}
      />
    </Panel>
  );
}
