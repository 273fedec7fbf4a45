/** Pivot and spin: how far the tool was swung while poses are collected, and what was found. */

import { useComputed, useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, type Schemas, sent } from "../../api/client";
import type { DeviceStream } from "../../live/device_stream";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { meanSigma, significant, time } from "../../ui/format";
import { Action, Badge, Failure, Table } from "../../ui/parts";
import { OrientationCoverage, relative } from "./orientation_coverage";

type Tool = Schemas["Tool"];
type Found = Schemas["ToolCalibration"];
type Kind = Found["kind"];

const KINDS: readonly Kind[] = ["pivot", "spin"];
/** Which of the three swings counts: of a spin the least is that of the axis itself, which stays. */
const COUNTED: Record<Kind, number> = { pivot: 0, spin: 1 };
const MIN_SWING_DEG: Record<Kind, number> = { pivot: 5, spin: 20 };
const OPERATIONS = {
  pivot: "POST /api/v1/tools/{tool_id}/pivot-calibrations",
  spin: "POST /api/v1/tools/{tool_id}/spin-calibrations",
} as const;
const POSES = 500;

interface TipCalibrationProps {
  tool: Tool;
  /** With the poses of the device's tools. */
  stream: DeviceStream;
  changed: () => Promise<void>;
}

/** A calibration that is under way. */
interface Collected {
  kind: Kind;
  /** When it began, and ends [ms of performance.now()]. */
  begin: number;
  end: number;
  coverage: OrientationCoverage;
}

export function TipCalibration({ tool, stream, changed }: TipCalibrationProps) {
  const kind = useSignal<Kind>("pivot");
  const seconds = useSignal(10);
  const apply = useSignal(true);
  const collected = useSignal<Collected | null>(null);
  const results = usePolled(`calibrations of ${tool.id}`, () =>
    sent(api.GET("/api/v1/tools/{tool_id}/calibrations", { params: { path: { tool_id: tool.id }, query: { limit: 20 } } })),
  );
  const now = kind.value;
  const start = async () => {
    const begin = performance.now();
    collected.value = { kind: now, begin, end: begin + 1000 * seconds.value, coverage: new OrientationCoverage() };
    const params = { path: { tool_id: tool.id } };
    const body = { duration_s: seconds.value, poses: POSES, relative: true, apply: apply.value, min_swing_deg: MIN_SWING_DEG[now] };
    try {
      if (now === "pivot") await sent(api.POST("/api/v1/tools/{tool_id}/pivot-calibrations", { params, body }));
      else await sent(api.POST("/api/v1/tools/{tool_id}/spin-calibrations", { params, body }));
    } finally {
      // What was reached stays beside a refusal, until the next begins.
      if (collected.value) collected.value = { ...collected.value, end: performance.now() };
    }
  };
  return (
    <section aria-label={text.tools.calibrate}>
      <h3>{text.tools.calibrate}</h3>
      <fieldset class="row">
        <legend class="hidden">{text.tools.calibrate}</legend>
        {KINDS.map((one) => (
          <label key={one}>
            <input type="radio" name={`kind of ${tool.id}`} checked={now === one} onChange={() => (kind.value = one)} /> {text.tools.kinds[one]}
          </label>
        ))}
      </fieldset>
      <p>{text.tools.kindHelp[now]}</p>
      <div class="row">
        <label>
          {text.tools.seconds}{" "}
          <input type="number" min={1} max={120} value={seconds.value} onInput={({ currentTarget }) => (seconds.value = currentTarget.valueAsNumber || 10)} />
        </label>
        <label>
          <input type="checkbox" checked={apply.value} onChange={({ currentTarget }) => (apply.value = currentTarget.checked)} /> {text.tools.apply}
        </label>
        <Action
          label={text.tools.start[now]}
          kind="primary"
          operation={OPERATIONS[now]}
          run={start}
          done={async () => {
            await Promise.all([results.refresh(), changed()]);
          }}
        />
      </div>
      {collected.value ? <Motion key={collected.value.begin} collected={collected.value} tool={tool} stream={stream} /> : null}
      <Failure message={results.error} />
      <Newest found={results.value?.items[0]} />
      <History found={results.value?.items ?? null} />
    </section>
  );
}

/** The bar of how much of the needed motion there is, as it grows. */
function Motion({ collected, tool, stream }: { collected: Collected; tool: Tool; stream: DeviceStream }) {
  const { kind, coverage } = collected;
  const swings = useSignal<[number, number, number] | null>(null);
  const left = useSignal(1);
  const unseen = useSignal<string | null>(null);
  const ended = useRef(false);
  ended.current = collected.end <= performance.now();
  useEffect(
    () =>
      stream.frame.subscribe((frame) => {
        if (ended.current || !frame) return;
        const pose = frame.tools?.find(({ tool_id }) => tool_id === tool.id);
        const reference = tool.reference_id === null ? null : frame.tools?.find(({ tool_id }) => tool_id === tool.reference_id);
        left.value = Math.max(0, (collected.end - performance.now()) / 1000);
        const missing = [pose, reference].find((one) => one?.rotation === null);
        unseen.value = missing ? (missing.reason ?? missing.status) : null;
        if (!pose?.rotation || pose.status !== "OK" || reference === undefined || reference?.rotation === null) return;
        coverage.take(reference ? relative(reference.rotation, pose.rotation) : pose.rotation);
        swings.value = coverage.swings();
      }),
    [stream, tool.id, tool.reference_id, coverage],
  );
  const reached = swings.value?.[COUNTED[kind]] ?? 0;
  const needed = MIN_SWING_DEG[kind];
  const enough = useComputed(() => (swings.value?.[COUNTED[kind]] ?? 0) >= needed);
  return (
    <div class={`capture ${enough.value ? "captured" : ended.current ? "failed" : "measuring"}`}>
      <p class="large" role="status">
        {enough.value ? text.tools.enoughMotion : text.tools.littleMotion}
      </p>
      <progress max={1} value={Math.min(1, reached / needed)} aria-label={text.tools.swing(significant(reached, 2), String(needed))} />
      <p>
        {text.tools.swing(significant(reached, 2), String(needed))}
        {kind === "spin" && swings.value ? `; ${text.tools.axisTilt(significant(swings.value[0], 2))}` : ""}
        {ended.current ? "" : `; ${text.tools.remaining(left.value.toFixed(0))}`}
      </p>
      <p class="muted">{text.tools.swingHelp[kind]}</p>
      {unseen.value && !ended.current ? <p>{text.tools.notSeen(unseen.value)}</p> : null}
    </div>
  );
}

function Newest({ found }: { found: Found | undefined }) {
  if (!found) return null;
  const sigma = meanSigma(found.tip_covariance_mm2);
  return (
    <p>
      <strong>{text.tools.found}</strong>:{" "}
      {found.kind === "pivot"
        ? text.tools.foundTip(significant(sigma, 2))
        : text.tools.foundAxis((found.axis ?? []).map((value) => value.toFixed(4)).join(", "))}
      . {text.tools.foundFit(significant(found.rms_mm, 2), found.poses, found.outliers)}.{" "}
      {found.residual_sigma !== null && found.residual_sigma > 2 ? text.tools.scatter(significant(found.residual_sigma, 2)) : ""}{" "}
      {found.applied ? text.tools.given : text.tools.notGiven}
    </p>
  );
}

function History({ found }: { found: readonly Found[] | null }) {
  return (
    <Table
      caption={text.tools.history}
      columns={[text.column.created, text.column.kind, text.column.sigma, text.tools.rms, text.tools.least, text.tools.poses, text.tools.outliers, text.tools.applied]}
      rows={found ?? []}
      identity={({ id }) => id}
      empty={found ? text.tools.noHistory : text.loading}
      row={(one) => [
        time(one.created_at),
        <Badge kind="idle">{one.kind}</Badge>,
        significant(meanSigma(one.tip_covariance_mm2), 2),
        significant(one.rms_mm, 2),
        significant(one.smallest_rotation_deg, 3),
        one.poses,
        one.outliers,
        one.applied ? text.tools.yes : text.tools.no,
      ]}
    />
  );
}
