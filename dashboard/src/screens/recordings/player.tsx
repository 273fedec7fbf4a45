/** A player of one recording: scrub, step, speed; the scene as it was found, and the scans. */

import { useSignal, useSignalEffect } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, sent } from "../../api/client";
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
import { advanced, calibrationOf, frameRate, kept, type Recording, SPAN, SPEEDS, toFrame } from "./playback";
import { Differences, SecondCalibrationChoice } from "./second_calibration";

const PICTURE_MS = 100;
/** Scans are four times as much to read as points; while it plays they come less often. */
const SCANS_EVERY = 4;

export function Player({ recording, close }: { recording: Recording; close: () => void }) {
  const path = { path: { recording_id: recording.id } };
  const detail = usePolled(`recording ${recording.id}`, () => sent(api.GET("/api/v1/recordings/{recording_id}", { params: path })), 60);
  const frames = detail.value?.frames_written ?? recording.frames_written ?? 0;
  const rateHz = frameRate(recording);
  const position = useSignal(0);
  const playing = useSignal(false);
  const speed = useSignal<number>(1);
  const withScans = useSignal(false);
  const sensor = useSignal("");
  const frame = useSignal<Frame | null>(null);
  const scans = useSignal<Scans | null>(null);
  const error = useSignal<string | null>(null);
  const state = useRef(new SceneState()).current;
  const second = useSignal("");
  const secondState = useRef(new SceneState()).current;
  const apart = useSignal<readonly Difference[]>([]);
  const shown = useRef(-1);
  const busy = useRef(false);
  const pictures = useRef(0);
  const calibration = detail.value ? calibrationOf(detail.value, Math.floor(position.value)) : null;

  const load = async () => {
    const number = Math.floor(position.value);
    // The scene knows what came before, but not after a jump.
    if (number < shown.current || number > shown.current + 10 * SPAN)
      for (const one of [state, secondState]) one.clear();
    const first = Math.max(0, number - SPAN + 1);
    const query = { first, count: number - first + 1 };
    const pages = (query: { first: number; count: number; calibration_id?: string }) =>
      sent(api.GET("/api/v1/recordings/{recording_id}/frames", { params: { ...path, query } }));
    const found = await pages(query);
    const taken = found.frames.map((one) => toFrame(one, recording.device_id ?? "", calibration));
    const other = second.value;
    const beside = other ? (await pages({ ...query, calibration_id: other })).frames : [];
    for (const one of beside) secondState.take(toFrame(one, recording.device_id ?? "", other));
    apart.value = differences(found.frames, beside);
    for (const one of taken.slice(0, -1)) state.take(one);
    frame.value = taken.at(-1) ?? null;
    shown.current = number;
    pictures.current += 1;
    if (withScans.value && (!playing.value || pictures.current % SCANS_EVERY === 0))
      scans.value = await sent(
        api.GET("/api/v1/recordings/{recording_id}/scans", {
          params: { ...path, query: { number, ...(sensor.value ? { detail_sensor: sensor.value } : {}) } },
        }),
      );
    if (!sensor.value) sensor.value = scans.value?.scans[0]?.sensor ?? "";
  };

  /** Show the newest position; positions that come meanwhile are left out. */
  const show = async () => {
    if (busy.current || frames === 0) return;
    busy.current = true;
    try {
      let asked: string;
      const wanted = () => `${Math.floor(position.value)} ${withScans.value} ${sensor.value} ${second.value}`;
      do {
        asked = wanted();
        await load();
      } while (!playing.value && asked !== wanted());
      error.value = null;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      error.value = failure.message;
      playing.value = false;
    } finally {
      busy.current = false;
    }
  };

  useSignalEffect(() => {
    if (!playing.value || !visible.value) return undefined;
    let before = performance.now();
    const timer = setInterval(() => {
      const now = performance.now();
      const next = advanced(position.peek(), frames, now - before, speed.peek(), rateHz);
      before = now;
      position.value = next;
      if (next >= frames - 1) playing.value = false;
      void show();
    }, PICTURE_MS);
    return () => clearInterval(timer);
  });
  useEffect(() => void show(), [Math.floor(position.value), withScans.value, sensor.value, second.value, frames]);
  useEffect(() => secondState.clear(), [second.value]);

  const go = (by: number) => {
    playing.value = false;
    position.value = kept(Math.floor(position.value) + by, frames);
  };
  const number = Math.floor(position.value);
  return (
    <Panel
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
        {recording.contents.includes("results") ? <SecondCalibrationChoice recording={recording} second={second} /> : null}
        <span class="count">{text.player.position(number, frames, significant(number / rateHz, 4), significant(recording.duration_s, 4))}</span>
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
      <Failure message={error.value ?? detail.error} />
      {recording.contents.includes("results") ? null : <p class="muted">{text.player.noResults}</p>}
      {withScans.value && scans.value ? (
        <ScansPicture scans={scans.value} sensor={sensor.value} pick={(name) => (sensor.value = name)} />
      ) : null}
      {second.value ? (
        // Anew for another calibration: what was found with the one before is not its.
        <Differences key={second.value} recording={recording} frames={frames} first={calibration} second={second.value} shown={apart} />
      ) : null}
      <ScenePicture frame={frame} calibration={calibration} state={state} second={second.value ? secondState : null} />
    </Panel>
  );
}
