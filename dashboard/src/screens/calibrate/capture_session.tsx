/** One capture session: the next target large, coverage as it grows, then what is made of it. */

import { useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, type Schemas, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { position, significant } from "../../ui/format";
import { Action, Failure, Panel, Table } from "../../ui/parts";
import { RunAction } from "../../ui/run_action";
import { coverage } from "./coverage";
import { tone } from "./tone";

export type Capture = Schemas["Capture"];
const OPERATION = "POST /api/v1/captures/{capture_id}/capture";

interface SessionProps {
  id: string;
  device: Device;
  close: () => void;
  /** What is made of the captured targets. */
  purpose: (capture: Capture) => ComponentChildren;
}

export function CaptureSession({ id, device, close, purpose }: SessionProps) {
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
      {purpose(capture)}
    </>
  );
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
export function CaptureRun({ capture, calibrated }: { capture: Capture; calibrated: (calibration: string) => void }) {
  return (
    <Panel title={text.calibrate.compute}>
      <RunAction
        label={text.calibrate.computeAction}
        operation="POST /api/v1/runs/calibration"
        disabled={capture.captured.length === 0}
        start={() => {
          const body = {
            device_id: capture.device_id,
            capture_id: capture.id,
            distortion: "auto" as const,
            loss: "linear" as const,
            labels: "report" as const,
            allow_incomplete: capture.left > 0,
            note: "",
          };
          return sent(api.POST("/api/v1/runs/calibration", { body }));
        }}
        done={calibrated}
      />
      {capture.left > 0 ? <p class="muted">{text.calibrate.incomplete(capture.left)}</p> : null}
    </Panel>
  );
}
