/** The frames of a device as a tree, and the transform between any two, in both directions. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { type Polled, usePolled } from "../../live/polling";
import { text } from "../../text";
import { position, significant } from "../../ui/format";
import { IdChoice } from "../../ui/id_choice";
import { Badge, Copy, Failure, Panel } from "../../ui/parts";

type FrameList = Schemas["FrameList"];
type FrameState = Schemas["FrameState"];
type FrameTransform = Schemas["FrameTransform"];

/** Return a device's frames, asked for every second. */
export function useFrames(device: string): Polled<FrameList> {
  const path = { params: { path: { device_id: device } } };
  return usePolled(`frames ${device}`, () => sent(api.GET("/api/v1/devices/{device_id}/frames", path)), 1);
}

export function Frames({ device, polled }: { device: string; polled: Polled<FrameList> }) {
  const frames = polled.value?.frames ?? [];
  const from = useSignal<string | null>(null);
  const to = useSignal<string | null>(null);
  const [first, second] = [from.value ?? frames[1]?.id, to.value ?? frames[0]?.id];
  return (
    <Panel title={text.frames.title}>
      <Failure message={polled.error} />
      <p class="muted">{text.frames.help}</p>
      <Tree frames={frames} root={null} />
      {first !== undefined && second !== undefined ? (
        <section aria-label={text.frames.transform}>
          <div class="row">
            <IdChoice label={text.frames.from} among={frames} value={first} choose={(id) => (from.value = id)} />
            <IdChoice label={text.frames.to} among={frames} value={second} choose={(id) => (to.value = id)} />
            <button
              type="button"
              onClick={() => {
                from.value = second;
                to.value = first;
              }}
            >
              {text.frames.exchange}
            </button>
          </div>
          <div class="charts">
            <Transform device={device} from={first} to={second} />
            <Transform device={device} from={second} to={first} />
          </div>
        </section>
      ) : null}
    </Panel>
  );
}

/** The frames that hang on one; null: the tracker. */
function Tree({ frames, root }: { frames: readonly FrameState[]; root: string | null }) {
  const here = frames.filter(({ to_frame_id }) => to_frame_id === root);
  if (!here.length) return root === null ? <p class="muted">{text.frames.none}</p> : null;
  return (
    <ul>
      {here.map((frame) => (
        <li key={frame.id}>
          <strong>{frame.id}</strong> <span class="muted">{frame.kind}</span>{" "}
          <Badge kind={frame.status === "OK" ? "good" : frame.connected ? "warn" : "bad"}>{frame.status}</Badge> {frame.reason}
          <Tree frames={frames} root={frame.id} />
        </li>
      ))}
    </ul>
  );
}

function Transform({ device, from, to }: { device: string; from: string; to: string }) {
  const params = { path: { device_id: device, frame_id: from }, query: { to_frame_id: to } };
  const polled = usePolled(
    `transform ${device} ${from} ${to}`,
    () => sent(api.GET("/api/v1/devices/{device_id}/frames/{frame_id}", { params })),
    1,
  );
  const found = polled.value;
  return (
    <figure aria-label={text.frames.forward(from, to)}>
      <figcaption>
        <strong>
          {from} → {to}
        </strong>{" "}
        <span class="muted">{text.frames.forward(from, to)}</span>
      </figcaption>
      <Failure message={polled.error} />
      {found ? <Numbers found={found} /> : null}
    </figure>
  );
}

function Numbers({ found }: { found: FrameTransform }) {
  const state = (
    <p>
      <Badge kind={found.status === "OK" ? "good" : found.matrix ? "warn" : "bad"}>{found.status}</Badge> {found.reason}{" "}
      {found.path_frame_ids ? text.frames.path(found.path_frame_ids.join(" → ")) : text.frames.noTransform}{" "}
      {found.age_s === null ? "" : text.frames.age(significant(found.age_s, 2))}
    </p>
  );
  if (!found.matrix) return state;
  const covariance = found.covariance?.slice(3).map((row) => row.slice(3));
  return (
    <>
      {state}
      <dl class="numbers">
        <div>
          <dt>{text.frames.translation}</dt>
          <dd>{position(found.translation_mm, covariance ?? null)}</dd>
        </div>
        <div>
          <dt>{text.frames.quaternion}</dt>
          <dd>{(found.quaternion_wxyz ?? []).map((value) => value.toFixed(6)).join(", ")}</dd>
        </div>
      </dl>
      <pre class="matrix" tabIndex={0} role="region" aria-label={text.frames.matrix}>
        {found.matrix.map((row) => row.map((value, column) => value.toFixed(column === 3 ? 3 : 6).padStart(column === 3 ? 11 : 10)).join("")).join("\n")}
      </pre>
      <Copy value={JSON.stringify(found.matrix)} />
    </>
  );
}
