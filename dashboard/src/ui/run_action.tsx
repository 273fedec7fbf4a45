/** A button that posts a run, and what becomes of the run: progress, cancel, how it ended. */

import { useEffect, useRef } from "preact/hooks";
import { api, type Schemas, sent } from "../api/client";
import type { Operation } from "../api/session";
import { usePolled } from "../live/polling";
import { text } from "../text";
import { keptSignal } from "./kept";
import { whileKnown } from "./kept_document";
import { Action, Failure } from "./parts";
import { isActive, untilEnded } from "./run_answers";

type Run = Schemas["Run"];

interface RunActionProps {
  label: string;
  operation: Operation;
  /** The id of what the run is made from: with the operation, the run is found by it when the person comes back. */
  session: string;
  disabled?: boolean;
  /** Posts the run. */
  start: () => Promise<Run>;
  /** Called with the id of what the run made. */
  done: (result: string) => void;
}

const POLL_S = 0.5;

function pathOf(id: string) {
  return { params: { path: { run_id: id } } };
}

export function RunAction(props: RunActionProps) {
  const run = keptSignal(`run ${props.operation} ${props.session}`);
  const get = useRef(untilEnded((id) => sent(api.GET("/api/v1/runs/{run_id}", pathOf(id))))).current;
  const now = usePolled<Run | null>(
    `run ${run.value}`,
    // A run that the server knows no more would be waited for in vain.
    () => whileKnown(run, get),
    POLL_S,
  );
  const state = now.value?.state;
  const result = state === "succeeded" ? (now.value?.result_id ?? null) : null;
  useEffect(() => {
    if (!result) return;
    props.done(result);
    // Its result is not shown again to one who comes back for something else.
    run.value = null;
  }, [result]);
  const active = run.value !== null && (!now.value || isActive(now.value));
  return (
    <>
      <div class="row">
        <Action
          label={props.label}
          kind="primary"
          operation={props.operation}
          disabled={props.disabled === true}
          busy={active}
          run={async () => {
            run.value = (await props.start()).id;
          }}
        />
        {active && now.value ? (
          <>
            <progress max={1} value={now.value.progress} aria-label={text.column.progress} />
            <span>{now.value.stage}</span>
            <Action
              label={text.health.cancel}
              operation="POST /api/v1/runs/{run_id}/cancel"
              run={() => sent(api.POST("/api/v1/runs/{run_id}/cancel", pathOf(run.value ?? "")))}
              done={now.refresh}
            />
          </>
        ) : null}
      </div>
      {state === "cancelled" || state === "interrupted" ? <p>{text.run.ended(state)}</p> : null}
      <Failure message={now.value?.problem?.detail ?? now.error} />
    </>
  );
}
