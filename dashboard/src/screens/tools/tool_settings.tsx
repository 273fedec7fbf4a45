/** What may be changed of a tool: its reference, its limit; and its end. */

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, type Schemas, sent, tagged } from "../../api/client";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { IdChoice } from "../../ui/id_choice";
import { Action, Failure } from "../../ui/parts";

type Tool = Schemas["Tool"];
type Settings = Pick<Tool, "reference_id" | "limits">;

const CHANGED_MEANWHILE = 412;

interface ToolSettingsProps {
  tool: Tool;
  /** All tools of the device. */
  tools: readonly Tool[];
  changed: () => Promise<void>;
}

export function ToolSettings({ tool, tools, changed }: ToolSettingsProps) {
  const path = { tool_id: tool.id };
  // With its tag: what another person changed meanwhile is not overwritten. It is read with every change of the tool: one
  // of its tip, by a pivot, is no change of the form.
  const polled = usePolled(`tool ${tool.id} ${tool.updated_at}`, () => tagged(api.GET("/api/v1/tools/{tool_id}", { params: { path } })));
  const read = useRef(polled.value);
  read.current = polled.value ?? read.current;
  const now = read.current;
  const shown = now ? written(now.document) : null;
  const before = useRef(shown);
  const overtaken = useSignal(false);
  const reloads = useSignal(0);
  const reload = () => {
    overtaken.value = true;
    reloads.value += 1;
  };
  useEffect(() => {
    if (before.current !== null && shown !== before.current) reload();
    before.current = shown;
  }, [shown]);
  const save = async (settings: Settings) => {
    overtaken.value = false;
    // What is read from now on may be this change already.
    before.current = written(settings);
    try {
      const header = { "If-Match": now?.tag ?? "*" };
      await sent(api.PATCH("/api/v1/tools/{tool_id}", { params: { path, header }, body: settings }));
    } catch (failure) {
      before.current = shown;
      if (!(failure instanceof RequestFailed) || failure.status !== CHANGED_MEANWHILE) throw failure;
      await polled.refresh();
      reload();
    }
  };
  return (
    <>
      <Failure message={polled.error} />
      <Failure message={overtaken.value ? text.tools.changedMeanwhile : null} />
      <div class="row">
        {now ? (
          <Form
            key={reloads.value}
            tool={now.document}
            tools={tools}
            save={save}
            done={async () => {
              await Promise.all([polled.refresh(), changed()]);
            }}
          />
        ) : null}
        <Action
          label={text.tools.remove}
          kind="danger"
          operation="DELETE /api/v1/tools/{tool_id}"
          confirm={text.confirm.remove(tool.id)}
          run={() => sent(api.DELETE("/api/v1/tools/{tool_id}", { params: { path } }))}
          done={changed}
        />
      </div>
    </>
  );
}

/** Return what the form shows of a tool: another text, another form. */
function written({ reference_id, limits }: Settings): string {
  return JSON.stringify([reference_id, limits.tip_sd_mm ?? null]);
}

interface FormProps {
  tool: Tool;
  tools: readonly Tool[];
  save: (settings: Settings) => Promise<void>;
  done: () => Promise<void>;
}

function Form({ tool, tools, save, done }: FormProps) {
  const reference = useSignal(tool.reference_id ?? "");
  const limit = useSignal(tool.limits.tip_sd_mm?.toString() ?? "");
  const tip_sd_mm = limit.value === "" ? null : Number(limit.value);
  return (
    <>
      <IdChoice
        label={text.tools.reference}
        value={reference.value}
        among={tools}
        none={text.tools.tracker}
        without={tool.id}
        choose={(id) => (reference.value = id)}
      />
      <label>
        {text.tools.tipLimit}{" "}
        <input
          type="number"
          min={0}
          step="any"
          placeholder={text.tools.asDevice}
          value={limit.value}
          onInput={({ currentTarget }) => (limit.value = currentTarget.value)}
        />
      </label>
      <Action
        label={text.tools.save}
        operation="PATCH /api/v1/tools/{tool_id}"
        run={() => save({ reference_id: reference.value || null, limits: { tip_sd_mm } })}
        done={done}
      />
    </>
  );
}
