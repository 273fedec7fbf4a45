/** Beam holds: a board that can be read from three metres. */

import { api, type Schemas, sent } from "../api/client";
import { useDeviceStream } from "../live/device_stream";
import { toMilliseconds } from "../live/messages";
import { usePolled } from "../live/polling";
import { text } from "../text";
import { timeOfDay } from "../ui/format";
import { Action, Failure } from "../ui/parts";

type Hold = Schemas["BeamHold"];
const RATE_HZ = 5;

export function Holds() {
  const holds = usePolled("beam-holds", () =>
    sent(api.GET("/api/v1/beam-holds", { params: { query: { limit: 100 } } })),
  );
  const items = holds.value?.items ?? [];
  const devices = [...new Set(items.map((hold) => hold.device_id))];
  return (
    <>
      <Failure message={holds.error} />
      {holds.value && !items.length ? <p class="muted">{text.holds.none}</p> : null}
      <div class="board">
        {devices.map((device) => (
          <DeviceHolds key={device} device={device} holds={items.filter((hold) => hold.device_id === device)} />
        ))}
      </div>
    </>
  );
}

function DeviceHolds({ device, holds }: { device: string; holds: readonly Hold[] }) {
  const stream = useDeviceStream(device, ["holds"], RATE_HZ);
  // A board that does not know must not say that the beam may be on.
  const known = stream.connection.value === "open" && !stream.stale.value;
  return (
    <>
      {holds.map((hold) => {
        const state = known ? stream.holds.value.get(hold.id) : undefined;
        const kind = state ? (state.held ? "held" : "free") : "unknown";
        return (
          <article key={hold.id} class={`hold ${kind}`} aria-live="assertive">
            <h2>{hold.title || hold.id}</h2>
            <p class="large">{text.holds[kind]}</p>
            <p>{state ? (state.reason ?? "") : text.holds.unknownReason}</p>
            {state ? <p>{text.holds.since(timeOfDay(toMilliseconds(state.since_ns)))}</p> : null}
            {state?.cause === "latched" ? (
              <Action
                label={text.holds.acknowledge}
                kind="primary"
                operation="POST /api/v1/beam-holds/{hold_id}/acknowledge"
                run={() =>
                  sent(
                    api.POST("/api/v1/beam-holds/{hold_id}/acknowledge", { params: { path: { hold_id: hold.id } } }),
                  )
                }
              />
            ) : null}
            <Action
              label={text.holds.reference}
              operation="POST /api/v1/beam-holds/{hold_id}/reference"
              confirm={text.holds.referenceQuestion}
              run={() =>
                sent(
                  api.POST("/api/v1/beam-holds/{hold_id}/reference", {
                    params: { path: { hold_id: hold.id } },
                    body: { frames: 100, timeout_s: 10, max_scatter_mm: 0.5 },
                  }),
                )
              }
            />
          </article>
        );
      })}
    </>
  );
}
