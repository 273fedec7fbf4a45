/** How the drift of a device is watched. */

import { useSignal } from "@preact/signals";
import { api, type Schemas, sent, tagged } from "../../api/client";
import type { Device } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { Action, Failure, Panel } from "../../ui/parts";
import { markerNumbers } from "./quality_data";

export function Watch({ device, changed }: { device: Device; changed: () => Promise<void> }) {
  const path = { path: { device_id: device.id } };
  // With its tag: what another person changed meanwhile is not overwritten.
  const polled = usePolled(`watch ${device.id}`, () => tagged(api.GET("/api/v1/devices/{device_id}/watch", { params: path })));
  const now = polled.value;
  return (
    <Panel title={text.quality.watch}>
      <Failure message={polled.error} />
      <p class="muted">{text.quality.watchHelp}</p>
      {now ? (
        <Settings
          key={now.tag}
          settings={now.document}
          save={(settings) =>
            sent(
              api.PUT("/api/v1/devices/{device_id}/watch", {
                params: { ...path, header: { "If-Match": now.tag } },
                body: settings,
              }),
            )
          }
          done={async () => {
            await polled.refresh();
            await changed();
          }}
        />
      ) : null}
    </Panel>
  );
}

type WatchSettings = Schemas["WatchSettings"];

interface SettingsProps {
  settings: WatchSettings;
  save: (settings: WatchSettings) => Promise<unknown>;
  done: () => Promise<void>;
}

function Settings({ settings, save, done }: SettingsProps) {
  const interval = useSignal(String(settings.interval_s));
  const marker = useSignal(settings.reference ? String(settings.reference.marker) : "");
  const number = Number(marker.value);
  const wrong = !/^\d*$/.test(marker.value.trim()) || !(Number(interval.value) >= 10);
  return (
    <div class="row">
      <label>
        {text.quality.interval}{" "}
        <input type="number" min={10} max={86400} value={interval.value} onInput={({ currentTarget }) => (interval.value = currentTarget.value)} />
      </label>
      <label>
        {text.quality.referenceMarker}{" "}
        <input inputMode="numeric" size={5} value={marker.value} onInput={({ currentTarget }) => (marker.value = currentTarget.value)} />
      </label>
      <Action
        label={text.quality.save}
        operation="PUT /api/v1/devices/{device_id}/watch"
        disabled={wrong}
        run={() =>
          save({ interval_s: Number(interval.value), reference: markerNumbers(marker.value) ? { marker: number } : null })
        }
        done={done}
      />
    </div>
  );
}
