/** A recording by a second calibration beside its own: the choice, and the differences. */

import { type ReadonlySignal, type Signal, useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { whenFree } from "../../api/busy_server";
import { api, RequestFailed, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { significant } from "../../ui/format";
import { Action, Failure, Table } from "../../ui/parts";
import { type Difference, differenceRows, differences, samplePages } from "./differences";
import type { Recording } from "./playback";

/** Pages and frames of each that are compared over a whole recording. */
const PAGES = 20;
const PAGE_FRAMES = 32;

interface ChoiceProps {
  recording: Recording;
  second: Signal<string>;
}

const CALIBRATIONS = "GET /api/v1/calibrations";

export function SecondCalibrationChoice(props: ChoiceProps) {
  if (!allowed(CALIBRATIONS)) return <span class="muted">{`${text.beside.second}: ${text.access.notAllowed(scopeOf(CALIBRATIONS))}`}</span>;
  return <AllowedChoice {...props} />;
}

function AllowedChoice({ recording, second }: ChoiceProps) {
  const device = recording.device_id;
  const query = { ...(device === null ? {} : { device_id: device }), limit: 100 };
  const calibrations = usePolled(`calibrations ${device}`, () => sent(api.GET("/api/v1/calibrations", { params: { query } })), 30);
  return (
    <label>
      {text.beside.second}{" "}
      <select value={second.value} onChange={({ currentTarget }) => (second.value = currentTarget.value)}>
        <option value="">{text.beside.none}</option>
        {(calibrations.value?.items ?? []).map(({ id }) => (
          <option key={id} value={id}>
            {id}
          </option>
        ))}
      </select>
      <Failure message={calibrations.error} />
    </label>
  );
}

interface DifferencesProps {
  recording: Recording;
  frames: number;
  first: string | null;
  second: string;
  /** Of the frames that are shown. */
  shown: ReadonlySignal<readonly Difference[]>;
  /** Whether those are worked out now, as tracks and tools are. */
  tracking: boolean;
}

/** Begins anew for each second calibration: give that as its key. */
export function Differences({ recording, frames, first, second, shown, tracking }: DifferencesProps) {
  const whole = useSignal<readonly Difference[] | null>(null);
  const share = useSignal(0);
  const error = useSignal<string | null>(null);
  const shownNoMore = useRef(new AbortController()).current;
  useEffect(() => () => shownNoMore.abort(), []);
  const results = recording.contents.includes("results");
  const compare = async () => {
    const pages = samplePages(frames, PAGES, PAGE_FRAMES);
    const compared: Difference[] = [];
    error.value = null;
    try {
      for (const [index, page] of pages.entries()) {
        share.value = index / pages.length;
        const path = { recording_id: recording.id };
        const framesOf = async (query: { calibration_id?: string; tracking?: boolean }) => {
          const { signal } = shownNoMore;
          const send = () =>
            sent(api.GET("/api/v1/recordings/{recording_id}/frames", { params: { path, query: { first: page, count: PAGE_FRAMES, ...query } }, signal }));
          return (await whenFree(send, signal)).frames;
        };
        // Without results its own points, too, are worked out now.
        compared.push(...differences(await framesOf(results ? {} : { tracking: true }), await framesOf({ calibration_id: second })));
      }
      whole.value = compared;
    } catch (failure) {
      if (shownNoMore.signal.aborted) return;
      if (!(failure instanceof RequestFailed)) throw failure;
      error.value = failure.message;
    } finally {
      share.value = 0;
    }
  };
  const used = whole.value ?? shown.value;
  const live = whole.value ? results : !tracking;
  return (
    <section class="panel" aria-label={text.beside.title}>
      <h3>{text.beside.title}</h3>
      <p>
        <span class="swatch first" /> {(live ? text.beside.live : text.beside.now)(first ?? text.missing)} <span class="swatch second" />{" "}
        {text.beside.by(second)}
      </p>
      <p class="muted">{whole.value ? text.beside.ofWhole(used.length) : text.beside.ofShown(used.length)}</p>
      <Table
        caption={text.beside.title}
        columns={[text.beside.axis, text.beside.median, text.beside.p95, text.beside.largest]}
        rows={differenceRows(used)}
        identity={({ axis }) => axis}
        empty={text.beside.nothing}
        row={(one) => [
          one.axis === "distance" ? text.beside.distance : one.axis,
          significant(one.median_mm, 3),
          significant(one.p95_mm, 3),
          significant(one.largest_mm, 3),
        ]}
      />
      <div class="row">
        <Action
          label={text.beside.compareWhole}
          operation="GET /api/v1/recordings/{recording_id}/frames"
          run={compare}
        />
        {share.value > 0 ? <progress max={1} value={share.value} aria-label={text.column.progress} /> : null}
      </div>
      <Failure message={error.value} />
    </section>
  );
}
