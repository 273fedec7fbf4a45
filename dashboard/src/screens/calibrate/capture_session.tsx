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
import { Action, Badge, Failure, Panel, Table } from "../../ui/parts";
import { RunAction } from "../../ui/run_action";
import { coverage } from "./coverage";
import { tone } from "../../ui/tone";
import { type Order, proposedTarget, volumeCoverage } from "./volume_coverage";

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
      <VolumePanel capture={capture} />
      <CoveragePanel capture={capture} device={device} />
      {purpose(capture)}
    </>
  );
}

const ORDERS: readonly Order[] = ["farthest", "table"];

function NextTarget({ capture, refresh }: { capture: Capture; refresh: () => Promise<void> }) {
  const state = useSignal<"ready" | "measuring" | "captured" | "failed">("ready");
  const message = useSignal("");
  const order = useSignal<Order>("farthest");
  /** Another target than the proposed one, until it is captured. */
  const chosen = useSignal<string | null>(null);
  /** Whether one target after the other is captured. */
  const running = useSignal(false);
  const alive = useRef(true);
  useEffect(() => () => void (alive.current = false), []);
  const captured = new Set(capture.captured.map(({ target }) => target));
  const left = capture.targets.filter(({ name }) => !captured.has(name));
  const proposed = proposedTarget(capture, order.value);
  const next = left.find(({ name }) => name === chosen.value) ?? proposed;
  const can = allowed(OPERATION);
  const one = async (target: string): Promise<Capture | null> => {
    state.value = "measuring";
    message.value = "";
    try {
      const found = await sent(
        api.POST("/api/v1/captures/{capture_id}/capture", {
          params: { path: { capture_id: capture.id }, query: { target } },
        }),
      );
      tone(880, 0.12);
      // First what is captured is known again: until then the next target is the one that was.
      await refresh();
      if (chosen.value === target) chosen.value = null;
      state.value = "captured";
      return found;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      tone(220, 0.4);
      await refresh();
      state.value = "failed";
      message.value = failure.message;
      return null;
    }
  };
  // A frame with many strobed markers needs nobody to move anything.
  const all = async () => {
    running.value = true;
    let target = next?.name;
    while (target !== undefined && running.value && alive.current) {
      const found = await one(target);
      target = found ? proposedTarget(found, order.value)?.name : undefined;
    }
    running.value = false;
  };
  const fixed = capture.targets.every(({ marker }) => marker !== null);
  const busy = state.value === "measuring";
  // A button that is disabled, or goes, loses the focus: who captures by keyboard would have to look for it after each target.
  const off = !can || busy || running.value || !next;
  return (
    <div class={`capture ${state.value}`}>
      <p class="large" role="status">
        {busy ? text.calibrate.hold : next ? next.name : text.calibrate.complete}
      </p>
      {next ? <p>{text.calibrate.at(position(next.position_mm))}</p> : null}
      <p>{text.calibrate.progress(capture.captured.length, capture.targets.length)}</p>
      <progress max={capture.targets.length} value={capture.captured.length} aria-label={text.column.progress} />
      <div class="row">
        <button type="button" class="primary" aria-disabled={off} onClick={() => (off ? undefined : void one(next.name))}>
          {text.calibrate.capture}
        </button>
        {fixed ? (
          <button
            type="button"
            aria-disabled={off && !running.value}
            onClick={() => {
              if (running.value) running.value = false;
              else if (!off) void all();
            }}
          >
            {running.value ? text.device.stop : text.calibrate.captureAll}
          </button>
        ) : null}
        {can ? null : <small class="muted">{text.access.notAllowed(scopeOf(OPERATION))}</small>}
      </div>
      {next ? (
        <div class="row controls">
          <label>
            {text.calibrate.next}{" "}
            <select value={order.value} onChange={({ currentTarget }) => (order.value = currentTarget.value as Order)}>
              {ORDERS.map((one) => (
                <option key={one} value={one}>
                  {text.calibrate.orders[one]}
                </option>
              ))}
            </select>
          </label>
          <label>
            {text.calibrate.other}{" "}
            <select
              value={next === proposed ? -1 : left.indexOf(next)}
              onChange={({ currentTarget }) => (chosen.value = left[Number(currentTarget.value)]?.name ?? null)}
            >
              <option value={-1}>{text.calibrate.proposed}</option>
              {left.map(({ name }, index) => (
                <option key={name} value={index}>
                  {name}
                </option>
              ))}
            </select>
          </label>
        </div>
      ) : null}
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

function VolumePanel({ capture }: { capture: Capture }) {
  const boxes = volumeCoverage(capture);
  const range = (low: number, high: number) => (low === high ? significant(low, 4) : text.calibrate.range(significant(low, 4), significant(high, 4)));
  return (
    <Panel title={text.calibrate.volume}>
      <p>{text.calibrate.volumeParts(boxes.filter(({ captured }) => captured > 0).length, boxes.length)}</p>
      <Table
        caption={text.calibrate.volume}
        columns={[...["X", "Y", "Z"].map(text.calibrate.box), text.calibrate.inBox, text.column.state]}
        rows={boxes}
        identity={({ low }) => low.join()}
        empty={text.calibrate.nothing}
        row={({ low, high, targets, captured }) => [
          range(low[0], high[0]),
          range(low[1], high[1]),
          range(low[2], high[2]),
          `${captured} / ${targets}`,
          <Badge kind={captured ? "good" : targets ? "warn" : "idle"}>{text.calibrate.boxes[captured ? "captured" : targets ? "empty" : "none"]}</Badge>,
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
        session={capture.id}
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
