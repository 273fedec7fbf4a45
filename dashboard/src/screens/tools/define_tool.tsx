/** A new tool: by showing it, or from a file. */

import { useSignal } from "@preact/signals";
import { api, sent } from "../../api/client";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { Action, Failure, Panel } from "../../ui/parts";
import { takeText } from "../../ui/text_file";
import { MIN_MARKERS, slotsOf } from "./entries";
import { parseTools } from "./tool_file";

interface DefineToolProps {
  device: string;
  done: () => Promise<void>;
}

const WAYS = ["show", "file"] as const;

export function DefineTool(props: DefineToolProps) {
  const way = useSignal<(typeof WAYS)[number]>("show");
  const id = useSignal("");
  return (
    <Panel title={text.tools.define}>
      <fieldset class="row">
        <legend class="hidden">{text.tools.way}</legend>
        {WAYS.map((one) => (
          <label key={one}>
            <input type="radio" name="way to define a tool" checked={way.value === one} onChange={() => (way.value = one)} /> {text.tools.ways[one]}
          </label>
        ))}
      </fieldset>
      <label>
        {text.tools.id} <input value={id.value} onInput={({ currentTarget }) => (id.value = currentTarget.value.trim())} />
      </label>
      {way.value === "show" ? <ShownTool {...props} id={id.value} /> : <ToolFromFile {...props} id={id.value} />}
    </Panel>
  );
}

function ShownTool({ device, done, id }: DefineToolProps & { id: string }) {
  const strobed = useSignal(true);
  const markers = useSignal(4);
  const slots = useSignal("0, 1, 2, 3");
  const read = attempt(() => (strobed.value ? slotsOf(slots.value) : null));
  const seen = strobed.value
    ? { strobe_markers: typeof read === "string" ? null : read, markers: null }
    : { strobe_markers: null, markers: markers.value };
  return (
    <>
      <div class="row">
        <label>
          {text.tools.lit}{" "}
          <select value={String(strobed.value)} onChange={({ currentTarget }) => (strobed.value = currentTarget.value === "true")}>
            <option value="true">{text.tools.strobed}</option>
            <option value="false">{text.tools.together}</option>
          </select>
        </label>
        {strobed.value ? (
          <label>
            {text.tools.slots} <input value={slots.value} onInput={({ currentTarget }) => (slots.value = currentTarget.value)} />
          </label>
        ) : (
          <label>
            {text.tools.markers}{" "}
            <input type="number" min={MIN_MARKERS} max={64} value={markers.value} onInput={({ currentTarget }) => (markers.value = currentTarget.valueAsNumber)} />
          </label>
        )}
      </div>
      <Failure message={typeof read === "string" ? read : null} />
      <p>{text.tools.show}</p>
      <Action
        label={text.tools.capture}
        kind="primary"
        operation="POST /api/v1/tool-captures"
        disabled={!id || typeof read === "string"}
        run={() => sent(api.POST("/api/v1/tool-captures", { body: { id, device_id: device, title: id, note: "", duration_s: 2, ...seen } }))}
        done={done}
      />
    </>
  );
}

function ToolFromFile({ device, done, id }: DefineToolProps & { id: string }) {
  const content = useSignal<string | null>(null);
  const given = content.value;
  const read = given === null ? null : attempt(() => parseTools(given, device, id));
  return (
    <>
      <p class="muted">{text.tools.fileHelp}</p>
      <label>
        {text.tools.file}{" "}
        <input
          type="file"
          accept=".json,.csv,.tsv,.txt"
          onChange={async ({ currentTarget }) => {
            const taken = await takeText(currentTarget);
            if (taken !== null) content.value = taken;
          }}
        />
      </label>
      {typeof read === "string" ? <Failure message={read} /> : null}
      {Array.isArray(read) ? <p>{text.tools.readFile(read.map((tool) => text.tools.summary(tool.id, tool.markers_mm.length)).join(", "))}</p> : null}
      <Action
        label={text.tools.create}
        kind="primary"
        operation="POST /api/v1/tools"
        disabled={!Array.isArray(read)}
        run={async () => {
          for (const body of Array.isArray(read) ? read : []) await sent(api.POST("/api/v1/tools", { body }));
        }}
        done={done}
      />
    </>
  );
}
