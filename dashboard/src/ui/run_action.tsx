/** A button that posts a run, and what becomes of the run: progress, cancel, how it ended. */

import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { api, type Schemas, sent } from "../api/client";
import type { Operation } from "../api/session";
import { usePolled } from "../live/polling";
import { text } from "../text";
import { Action, Failure } from "./parts";

type Run = Schemas["Run"];

interface RunActionProps {
  label: string;
  operation: Operation;
  disabled?: boolean;
  /** Posts the run. */
  start: () => Promise<Run>;
  /** Called with the id of what the run made. */
  done: (result: string) => void;
}

const POLL_S = 0.5;

export function RunAction(props: RunActionProps) {
  const run = useSignal<string | null>(null);
  const path = { params: { path: { run_id: run.value ?? "" } } };
  const now = usePolled<Run | null>(
    `run ${run.value}`,
    async () => (run.value === null ? null : await sent(api.GET("/api/v1/runs/{run_id}", path))),
    POLL_S,
  );
  const state = now.value?.state;
  const result = state === "succeeded" ? (now.value?.result_id ?? null) : null;
  useEffect(() => {
    if (result) props.done(result);
  }, [result]);
  const active = run.value !== null && (state === undefined || state === "queued" || state === "running");
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
              run={() => sent(api.POST("/api/v1/runs/{run_id}/cancel", path))}
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
