/** A player of one recording: scrub, step, speed; the scene as live, and the scans. */

import { useSignal, useSignalEffect } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { serverFailed, whenFree } from "../../api/busy_server";
import { api, RequestFailed, type Schemas, sent } from "../../api/client";
import { allowed } from "../../api/session";
import type { Frame } from "../../live/messages";
import { usePolled } from "../../live/polling";
import { visible } from "../../live/visibility";
import { text } from "../../text";
import { significant } from "../../ui/format";
import { Failure, Panel } from "../../ui/parts";
import type { Scans } from "../scans/scan_data";
import { ScansPicture } from "../scans/scans";
import { ScenePicture } from "../scene/scene";
import { SceneState } from "../scene/scene_state";
import { type Difference, differences } from "./differences";
import { LatestRequest } from "./latest_request";
import { calibrationOf, frameRate, kept, nextPosition, PICTURE_MS, type Recording, SPAN, SPEEDS, toFrame } from "./playback";
import { Differences, SecondCalibrationChoice } from "./second_calibration";

type RecordedFrame = Schemas["RecordedFrame"];

/** What the player shows. */
interface View {
  readonly number: number;
  readonly scans: boolean;
  readonly sensor: string;
  /** A second calibration; "": none. */
  readonly second: string;
  readonly tracking: boolean;
}

const NO_TOOLS: readonly Schemas["Tool"][] = [];
/** An answer that comes sooner replaces the scene before it is shown as old. */
const OLD_MS = 200;
/** Scans are four times as much to read as points; while it plays they come less often. */
const SCANS_EVERY = 4;

export function Player({ recording, close }: { recording: Recording; close: () => void }) {
  const path = { path: { recording_id: recording.id } };
  const detail = usePolled(`recording ${recording.id}`, () => sent(api.GET("/api/v1/recordings/{recording_id}", { params: path })), 60);
  const device = recording.device_id;
  const mayTools = device !== null && allowed("GET /api/v1/tools");
  const tools = usePolled(
    `tools ${device} ${mayTools}`,
    async () => (mayTools ? await sent(api.GET("/api/v1/tools", { params: { query: { device_id: device, limit: 100 } } })) : null),
    30,
  );
  const frames = detail.value?.frames_written ?? recording.frames_written ?? 0;
  const rateHz = frameRate(recording);
  const position = useSignal(0);
  const playing = useSignal(false);
  const speed = useSignal<number>(1);
  const withScans = useSignal(false);
  const sensor = useSignal("");
  const frame = useSignal<Frame | null>(null);
  const scans = useSignal<Scans | null>(null);
  /** Number of the frame that the scans are of. */
  const scansShown = useSignal(-1);
  const error = useSignal<string | null>(null);
  const state = useRef(new SceneState()).current;
  const second = useSignal("");
  const secondState = useRef(new SceneState()).current;
  const apart = useSignal<readonly Difference[]>([]);
  /** Whether tracks and tools are worked out: those of the device's present tools. */
  const tracked = useSignal(true);
  /** Why they are not worked out any more; null: they can be. */
  const trackingFailure = useSignal<string | null>(null);
  /** What a busy server says while it is asked again. */
  const busy = useSignal<string | null>(null);
  /** Whether it is left alone for a moment. */
  const waits = useRef(false);
  /** The position that the scene shows. */
  const shown = useSignal(-1);
  /** The frames that the scene has; null: another view of them is to come. */
  const scene = useRef<{ number: number; second: string; tracking: boolean } | null>(null);
  const pictures = useRef(0);
  const number = Math.floor(position.value);
  const calibration = detail.value ? calibrationOf(detail.value, number) : null;

  const load = async (view: View, signal: AbortSignal) => {
    const first = Math.max(0, view.number - SPAN + 1);
    const span = { first, count: view.number - first + 1 };
    const framesOf = async (query: { calibration_id?: string; tracking?: boolean }) => {
      const send = () => sent(api.GET("/api/v1/recordings/{recording_id}/frames", { params: { ...path, query: { ...span, ...query } }, signal }));
      const said = (failure: RequestFailed | null, pauses: boolean) => {
        busy.value = failure?.message ?? null;
        waits.current = pauses;
      };
      return (await whenFree(send, signal, said)).frames;
    };
    const asLive = (frames: readonly RecordedFrame[], by: string | null) => frames.map((one) => toFrame(one, recording.device_id ?? "", by));
    const known = scene.current;
    const same = known?.number === view.number && known.second === view.second && known.tracking === view.tracking;
    if (same) {
      // Only the scans are missing.
      error.value = null;
      return loadScans(view, signal);
    }
    // At first without tracks and tools: the server takes seconds until it can work them out.
    if (frame.value === null && view.tracking) {
      const [last] = asLive(await framesOf({}), calibration).slice(-1);
      signal.throwIfAborted();
      frame.value = last ?? null;
      shown.value = view.number;
    }
    let recorded: readonly RecordedFrame[];
    try {
      recorded = await framesOf({ tracking: view.tracking });
    } catch (failure) {
      if (signal.aborted || !view.tracking || !serverFailed(failure)) throw failure;
      // The frames themselves can be shown: they come with the next view, which is without tracking.
      trackingFailure.value = failure.message;
      tracked.value = false;
      return;
    }
    let beside: readonly RecordedFrame[] = [];
    let remark: string | null = null;
    try {
      if (view.second) beside = await framesOf({ tracking: view.tracking, calibration_id: view.second });
    } catch (failure) {
      if (signal.aborted || !serverFailed(failure)) throw failure;
      remark = failure.message;
      playing.value = false;
    }
    signal.throwIfAborted();
    // The scene knows what came before, but not after a jump, nor by other results.
    const follows = known?.tracking === view.tracking && view.number >= known.number && view.number <= known.number + 10 * SPAN;
    if (!follows) {
      state.clear();
      secondState.clear();
    }
    secondState.follow(asLive(beside, view.second), first);
    apart.value = differences(recorded, beside);
    const pictured = asLive(recorded, calibration);
    state.follow(pictured, first, 1);
    frame.value = pictured.at(-1) ?? null;
    scene.current = remark === null ? { number: view.number, second: view.second, tracking: view.tracking } : null;
    shown.value = view.number;
    error.value = remark;
    pictures.current += 1;
    if (!playing.value || pictures.current % SCANS_EVERY === 0) await loadScans(view, signal);
  };

  const loadScans = async (view: View, signal: AbortSignal) => {
    if (!view.scans || view.number !== Math.floor(position.value)) return;
    const query = { number: view.number, ...(view.sensor ? { detail_sensor: view.sensor } : {}) };
    const answer = await sent(api.GET("/api/v1/recordings/{recording_id}/scans", { params: { ...path, query }, signal }));
    signal.throwIfAborted();
    scans.value = answer;
    scansShown.value = view.number;
    if (!sensor.value) sensor.value = answer.scans[0]?.sensor ?? "";
  };

  /** What is loaded and when; `load` is that of the newest rendering. */
  const source = useRef({ load, frames });
  source.current = { load, frames };
  const requests = useRef<LatestRequest<View> | null>(null);
  requests.current ??= new LatestRequest<View>({
    view: () =>
      source.current.frames === 0
        ? null
        : { number: Math.floor(position.value), scans: withScans.value, sensor: sensor.value, second: second.value, tracking: tracked.value },
    load: (view, signal) => source.current.load(view, signal),
    // The server works on at what was aborted, and at one such request at a time: another position waits for no longer
    // when the one before is not aborted, except where that is not being worked at.
    outdates: (newer, loading) => newer.second !== loading.second || newer.tracking !== loading.tracking || waits.current,
    failed: (failure) => {
      if (!(failure instanceof RequestFailed)) throw failure;
      error.value = failure.message;
      playing.value = false;
    },
  });
  const show = () => void requests.current?.show();
  useEffect(() => () => requests.current?.close(), []);

  useSignalEffect(() => {
    if (!playing.value || !visible.value) return undefined;
    let before = performance.now();
    const timer = setInterval(() => {
      // Whoever goes on meanwhile asks for frames further and further on, which take the server longer and longer.
      if (requests.current?.busy) return;
      const now = performance.now();
      const next = nextPosition(position.peek(), source.current.frames, now - before, speed.peek(), rateHz);
      before = now;
      position.value = next;
      if (next >= source.current.frames - 1) playing.value = false;
    }, PICTURE_MS);
    return () => clearInterval(timer);
  });
  // When it stops, the scans of that frame are still to come.
  useEffect(show, [number, playing.value, withScans.value, sensor.value, second.value, tracked.value, frames]);
  // What is there is by another calibration than the one that is named now.
  useEffect(() => {
    secondState.clear();
    apart.value = [];
  }, [second.value]);
  const behind = shown.value !== number;
  const old = useLasting(behind);
  const oldScans = useLasting(!playing.value && scansShown.value !== number);

  const go = (by: number) => {
    playing.value = false;
    position.value = kept(Math.floor(position.value) + by, frames);
  };
  return (
    <Panel
      focus
      title={text.player.title(recording.id)}
      actions={
        <button type="button" onClick={close}>
          {text.player.close}
        </button>
      }
    >
      <div class="row player">
        <button type="button" onClick={() => go(-Math.round(rateHz / 10) || -1)} aria-label={text.player.back}>«</button>
        <button type="button" onClick={() => go(-1)} aria-label={text.player.stepBack}>‹</button>
        <button
          type="button"
          class="primary"
          onClick={() => {
            if (!playing.value && number >= frames - 1) position.value = 0;
            playing.value = !playing.value;
          }}
        >
          {playing.value ? text.player.pause : text.player.play}
        </button>
        <button type="button" onClick={() => go(1)} aria-label={text.player.step}>›</button>
        <button type="button" onClick={() => go(Math.round(rateHz / 10) || 1)} aria-label={text.player.forth}>»</button>
        <label>
          {text.player.speed}{" "}
          <select value={speed.value} onChange={({ currentTarget }) => (speed.value = Number(currentTarget.value))}>
            {SPEEDS.map((one) => (
              <option key={one} value={one}>
                {`${one} ×`}
              </option>
            ))}
          </select>
        </label>
        <label>
          <input type="checkbox" checked={withScans.value} onChange={({ currentTarget }) => (withScans.value = currentTarget.checked)} />{" "}
          {text.screens.scans}
        </label>
        <label>
          <input
            type="checkbox"
            checked={tracked.value}
            onChange={({ currentTarget }) => {
              tracked.value = currentTarget.checked;
              trackingFailure.value = null;
            }}
          />{" "}
          {text.player.tracking}
        </label>
        <SecondCalibrationChoice recording={recording} second={second} />
        <span class="count" aria-busy={behind}>{text.player.position(number, frames, significant(number / rateHz, 4), significant(recording.duration_s, 4))}</span>
      </div>
      <input
        class="scrub"
        type="range"
        min={0}
        max={Math.max(0, frames - 1)}
        step={1}
        value={number}
        aria-label={text.player.scrub}
        onInput={({ currentTarget }) => {
          playing.value = false;
          position.value = Number(currentTarget.value);
        }}
      />
      <Failure message={error.value ?? busy.value ?? (trackingFailure.value === null ? null : text.player.noTracking(trackingFailure.value)) ?? detail.error} />
      <p class="muted">{tracked.value ? text.player.trackingHelp : recording.contents.includes("results") ? null : text.player.noResults}</p>
      {withScans.value && scans.value ? (
        <div class={oldScans ? "stale" : undefined}>
          <ScansPicture scans={scans.value} sensor={sensor.value} pick={(name) => (sensor.value = name)} />
        </div>
      ) : null}
      {second.value ? (
        // Anew for another calibration: the results of the one before are not its.
        <Differences
          key={second.value}
          recording={recording}
          frames={frames}
          first={calibration}
          second={second.value}
          shown={apart}
          tracking={tracked.value}
        />
      ) : null}
      <ScenePicture
        frame={frame}
        calibration={calibration}
        state={state}
        second={second.value ? secondState : null}
        tools={tools.value?.items ?? NO_TOOLS}
        old={old}
      />
    </Panel>
  );
}

/** Return whether something has held for OLD_MS. */
function useLasting(holds: boolean): boolean {
  const lasting = useSignal(false);
  useEffect(() => {
    lasting.value = false;
    if (!holds) return undefined;
    const timer = setTimeout(() => (lasting.value = true), OLD_MS);
    return () => clearTimeout(timer);
  }, [holds]);
  return lasting.value;
}
