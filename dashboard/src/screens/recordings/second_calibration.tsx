/** A recording by a second calibration beside what was found live: the choice, and the differences. */

import { type ReadonlySignal, type Signal, useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, sent } from "../../api/client";
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

export function SecondCalibrationChoice({ recording, second }: ChoiceProps) {
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
}

/** Begins anew for each second calibration: give that as its key. */
export function Differences({ recording, frames, first, second, shown }: DifferencesProps) {
  const whole = useSignal<readonly Difference[] | null>(null);
  const share = useSignal(0);
  const error = useSignal<string | null>(null);
  const alive = useRef(true);
  useEffect(() => () => void (alive.current = false), []);
  const compare = async () => {
    const pages = samplePages(frames, PAGES, PAGE_FRAMES);
    const found: Difference[] = [];
    error.value = null;
    try {
      for (const [index, page] of pages.entries()) {
        if (!alive.current) return;
        share.value = index / pages.length;
        const path = { recording_id: recording.id };
        const of = (query: object) =>
          sent(api.GET("/api/v1/recordings/{recording_id}/frames", { params: { path, query: { first: page, count: PAGE_FRAMES, ...query } } }));
        const [live, other] = [await of({}), await of({ calibration_id: second })];
        found.push(...differences(live.frames, other.frames));
      }
      whole.value = found;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      error.value = failure.message;
    } finally {
      share.value = 0;
    }
  };
  const used = whole.value ?? shown.value;
  return (
    <section class="panel" aria-label={text.beside.title}>
      <h3>{text.beside.title}</h3>
      <p>
        <span class="swatch first" /> {text.beside.live(first ?? text.missing)} <span class="swatch second" />{" "}
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
