/** One capture session: the next target large, coverage as it grows, then the calibration. */

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, type Schemas, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { position, significant } from "../../ui/format";
import { Action, Failure, Panel, Table } from "../../ui/parts";
import { coverage } from "./coverage";

type Capture = Schemas["Capture"];
type Run = Schemas["Run"];
const OPERATION = "POST /api/v1/captures/{capture_id}/capture";

interface SessionProps {
  id: string;
  device: Device;
  close: () => void;
  calibrated: (calibration: string) => void;
}

export function CaptureSession({ id, device, close, calibrated }: SessionProps) {
  const session = usePolled(`capture ${id}`, () =>
    sent(api.GET("/api/v1/captures/{capture_id}", { params: { path: { capture_id: id } } })),
  );
  const capture = session.value;
  const leave = (
    <button type="button" onClick={close}>
      {text.calibrate.leave}
    </button>
  );
  if (!capture)
    return (
      <Panel title={text.calibrate.capturing(id)} actions={leave}>
        <Failure message={session.error} />
      </Panel>
    );
  return (
    <>
      <Panel title={text.calibrate.capturing(id)} actions={leave}>
        <NextTarget capture={capture} refresh={session.refresh} />
        <CapturedTable capture={capture} refresh={session.refresh} />
      </Panel>
      <CoveragePanel capture={capture} device={device} />
      <RunPanel capture={capture} calibrated={calibrated} />
    </>
  );
}

/** Short tones tell whoever holds the marker, and does not look, what happened. */
function tone(hertz: number, seconds: number): void {
  const context = new AudioContext();
  const oscillator = context.createOscillator();
  const gain = context.createGain();
  gain.gain.value = 0.1;
  oscillator.frequency.value = hertz;
  oscillator.connect(gain).connect(context.destination);
  oscillator.start();
  oscillator.stop(context.currentTime + seconds);
  oscillator.onended = () => void context.close();
}

function NextTarget({ capture, refresh }: { capture: Capture; refresh: () => Promise<void> }) {
  const state = useSignal<"ready" | "measuring" | "captured" | "failed">("ready");
  const message = useSignal("");
  const stopping = useRef(false);
  const alive = useRef(true);
  useEffect(() => () => void (alive.current = false), []);
  const next = capture.targets.find(({ name }) => name === capture.next);
  const can = allowed(OPERATION);
  const one = async (): Promise<Capture | null> => {
    state.value = "measuring";
    message.value = "";
    try {
      const found = await sent(
        api.POST("/api/v1/captures/{capture_id}/capture", { params: { path: { capture_id: capture.id } } }),
      );
      state.value = "captured";
      tone(880, 0.12);
      return found;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      state.value = "failed";
      message.value = failure.message;
      tone(220, 0.4);
      return null;
    } finally {
      await refresh();
    }
  };
  // A frame with many strobed markers needs nobody to move anything.
  const all = async () => {
    stopping.current = false;
    let found: Capture | null = capture;
    while (found?.next && !stopping.current && alive.current) found = await one();
  };
  const fixed = capture.targets.every(({ marker }) => marker !== null);
  const busy = state.value === "measuring";
  return (
    <div class={`capture ${state.value}`}>
      <p class="large" role="status">
        {busy ? text.calibrate.hold : next ? next.name : text.calibrate.complete}
      </p>
      {next ? <p>{text.calibrate.at(position(next.position_mm))}</p> : null}
      <p>{text.calibrate.progress(capture.captured.length, capture.targets.length)}</p>
      <progress max={capture.targets.length} value={capture.captured.length} aria-label={text.column.progress} />
      <div class="row">
        <button type="button" class="primary" disabled={!can || busy || !next} onClick={() => void one()}>
          {text.calibrate.capture}
        </button>
        {fixed ? (
          <button type="button" disabled={!can || busy || !next} onClick={() => void all()}>
            {text.calibrate.captureAll}
          </button>
        ) : null}
        {fixed && busy ? (
          <button type="button" onClick={() => (stopping.current = true)}>
            {text.device.stop}
          </button>
        ) : null}
        {can ? null : <small class="muted">{text.access.notAllowed(scopeOf(OPERATION))}</small>}
      </div>
      <Failure message={message.value || null} />
    </div>
  );
}

function CapturedTable({ capture, refresh }: { capture: Capture; refresh: () => Promise<void> }) {
  return (
    <Table
      caption={text.calibrate.captured}
      columns={[text.calibrate.target, text.column.position, text.column.sensors, text.calibrate.worstSigma, text.column.action]}
      rows={capture.captured}
      identity={({ target }) => target}
      empty={text.calibrate.nothing}
      row={(one) => [
        one.target,
        position(capture.targets.find(({ name }) => name === one.target)?.position_mm),
        one.sensors.map(({ sensor }) => sensor).join(", "),
        significant(Math.max(...one.sensors.map(({ sigma_px }) => sigma_px)), 2),
        <Action
          label={text.calibrate.again}
          operation={OPERATION}
          run={() =>
            sent(
              api.POST("/api/v1/captures/{capture_id}/capture", {
                params: { path: { capture_id: capture.id }, query: { target: one.target } },
              }),
            )
          }
          done={refresh}
        />,
      ]}
    />
  );
}

function CoveragePanel({ capture, device }: { capture: Capture; device: Device }) {
  return (
    <Panel title={text.calibrate.coverage}>
      <Table
        caption={text.calibrate.coverage}
        columns={[text.light.sensor, text.calibrate.readings, text.calibrate.pixels, text.calibrate.emptyParts]}
        rows={coverage(capture, device.sensors)}
        identity={({ sensor }) => sensor}
        empty={text.calibrate.nothing}
        row={(one) => [
          one.sensor,
          one.readings,
          <meter min={0} max={1} value={one.share} aria-label={text.calibrate.pixels}>
            {Math.round(100 * one.share)} %
          </meter>,
          one.gaps.map(([from, to]) => `${from}–${to} px`).join(", ") || text.calibrate.noGaps,
        ]}
      />
    </Panel>
  );
}

/** Computes the calibration of what is captured. */
function RunPanel({ capture, calibrated }: { capture: Capture; calibrated: (calibration: string) => void }) {
  const run = useSignal<string | null>(null);
  const now = usePolled<Run | null>(
    `run ${run.value}`,
    async () =>
      run.value === null
        ? null
        : await sent(api.GET("/api/v1/runs/{run_id}", { params: { path: { run_id: run.value } } })),
    0.5,
  );
  const state = now.value?.state;
  const result = state === "succeeded" ? (now.value?.result_id ?? null) : null;
  useEffect(() => {
    if (result) calibrated(result);
  }, [result]);
  const active = run.value !== null && (state === undefined || state === "queued" || state === "running");
  return (
    <Panel title={text.calibrate.compute}>
      <div class="row">
        <Action
          label={text.calibrate.computeAction}
          kind="primary"
          operation="POST /api/v1/calibration-runs"
          disabled={active || capture.captured.length === 0}
          run={async () => {
            const body = {
              device_id: capture.device_id,
              capture_id: capture.id,
              distortion: "auto" as const,
              loss: "linear" as const,
              labels: "report" as const,
              allow_incomplete: capture.left > 0,
              note: "",
            };
            run.value = (await sent(api.POST("/api/v1/calibration-runs", { body }))).id;
          }}
        />
        {active && now.value ? (
          <>
            <progress max={1} value={now.value.progress} aria-label={text.column.progress} />
            <span>{now.value.stage}</span>
            <Action
              label={text.health.cancel}
              operation="POST /api/v1/runs/{run_id}/cancel"
              run={() =>
                sent(api.POST("/api/v1/runs/{run_id}/cancel", { params: { path: { run_id: run.value ?? "" } } }))
              }
              done={now.refresh}
            />
          </>
        ) : null}
      </div>
      {capture.left > 0 ? <p class="muted">{text.calibrate.incomplete(capture.left)}</p> : null}
      {state === "cancelled" || state === "interrupted" ? <p>{text.calibrate.ended(state)}</p> : null}
      <Failure message={now.value?.problem?.detail ?? now.error} />
    </Panel>
  );
}
