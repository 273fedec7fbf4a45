/** What may be changed of a tool: its reference, its limit; and its end. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent } from "../../api/client";
import { text } from "../../text";
import { Action } from "../../ui/parts";

type Tool = Schemas["Tool"];

interface ToolSettingsProps {
  tool: Tool;
  /** All tools of the device. */
  tools: readonly Tool[];
  changed: () => Promise<void>;
}

export function ToolSettings({ tool, tools, changed }: ToolSettingsProps) {
  const reference = useSignal(tool.reference_id ?? "");
  const limit = useSignal(tool.limits.tip_sd_mm?.toString() ?? "");
  const path = { tool_id: tool.id };
  const tip_sd_mm = limit.value === "" ? null : Number(limit.value);
  return (
    <div class="row">
      <label>
        {text.tools.reference}{" "}
        <select value={reference.value} onChange={({ currentTarget }) => (reference.value = currentTarget.value)}>
          <option value="">{text.tools.tracker}</option>
          {tools
            .filter(({ id }) => id !== tool.id)
            .map(({ id }) => (
              <option key={id} value={id}>
                {id}
              </option>
            ))}
        </select>
      </label>
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
        run={async () => {
          // By what is on the server now: a pivot may have given it a tip meanwhile.
          const answer = await api.GET("/api/v1/tools/{tool_id}", { params: { path } });
          await sent(Promise.resolve(answer));
          const header = { "If-Match": answer.response.headers.get("ETag") ?? "*" };
          const body = { reference_id: reference.value || null, limits: { tip_sd_mm } };
          await sent(api.PATCH("/api/v1/tools/{tool_id}", { params: { path, header }, body }));
        }}
        done={changed}
      />
      <Action
        label={text.tools.remove}
        kind="danger"
        operation="DELETE /api/v1/tools/{tool_id}"
        confirm={text.confirm.remove(tool.id)}
        run={() => sent(api.DELETE("/api/v1/tools/{tool_id}", { params: { path } }))}
        done={changed}
      />
    </div>
  );
}
