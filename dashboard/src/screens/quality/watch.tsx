/** How the drift of a device is watched. */

import { useSignal } from "@preact/signals";
import { api, RequestFailed, type Schemas, sent, tagged } from "../../api/client";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { attempt } from "../../ui/attempt";
import { Action, Failure, Panel } from "../../ui/parts";
import { oneMarker } from "./quality_data";

const MIN_S = 10;
const MAX_S = 86_400;

export function Watch({ device, changed }: { device: Device; changed: () => Promise<void> }) {
  const path = { path: { device_id: device.id } };
  // With its tag: what another person changed meanwhile is not overwritten.
  const polled = usePolled(`watch ${device.id}`, () => tagged(api.GET("/api/v1/devices/{device_id}/watch", { params: path })));
  const now = polled.value;
  // Not with the fields: they begin anew when another person saved meanwhile, which is why a save fails.
  const problem = useSignal<string | null>(null);
  return (
    <Panel title={text.quality.watch}>
      <Failure message={polled.error} />
      <p class="muted">{text.quality.watchHelp}</p>
      {now ? (
        <Settings
          key={now.tag}
          settings={now.document}
          save={async (settings) => {
            problem.value = null;
            try {
              await sent(
                api.PUT("/api/v1/devices/{device_id}/watch", {
                  params: { ...path, header: { "If-Match": now.tag } },
                  body: settings,
                }),
              );
            } catch (failure) {
              if (!(failure instanceof RequestFailed)) throw failure;
              problem.value = failure.message;
            }
            await polled.refresh();
            await changed();
          }}
        />
      ) : null}
      <Failure message={problem.value} />
    </Panel>
  );
}

type WatchSettings = Schemas["WatchSettings"];

interface SettingsProps {
  settings: WatchSettings;
  save: (settings: WatchSettings) => Promise<void>;
}

function Settings({ settings, save }: SettingsProps) {
  const interval = useSignal(String(settings.interval_s));
  const entered = useSignal(settings.reference ? String(settings.reference.marker) : "");
  const marker = attempt(() => oneMarker(entered.value));
  const seconds = Number(interval.value);
  const long = interval.value.trim() !== "" && seconds >= MIN_S && seconds <= MAX_S;
  const wrong = typeof marker === "string" ? marker : long ? null : text.quality.noInterval(MIN_S, MAX_S);
  return (
    <>
      <div class="row">
        <label>
          {text.quality.interval}{" "}
          <input type="number" min={MIN_S} max={MAX_S} value={interval.value} onInput={({ currentTarget }) => (interval.value = currentTarget.value)} />
        </label>
        <label>
          {text.quality.referenceMarker}{" "}
          <input inputMode="numeric" size={5} value={entered.value} onInput={({ currentTarget }) => (entered.value = currentTarget.value)} />
        </label>
        <Action
          label={text.quality.save}
          operation="PUT /api/v1/devices/{device_id}/watch"
          disabled={wrong !== null}
          run={() => save({ interval_s: seconds, reference: typeof marker === "number" ? { marker } : null })}
        />
      </div>
      <Failure message={wrong} />
    </>
  );
}
