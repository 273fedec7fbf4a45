/** Beam holds: a board that can be read from three metres. */

import { api, type Schemas, sent } from "../api/client";
import { useDeviceStream } from "../live/device_stream";
import { type HoldSample, toMilliseconds } from "../live/messages";
import { usePolled } from "../live/polling";
import { text } from "../text";
import { sinceTime } from "../ui/format";
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
          <DeviceHolds
            key={device}
            device={device}
            holds={items.filter((hold) => hold.device_id === device)}
            changed={holds.refresh}
          />
        ))}
      </div>
    </>
  );
}

interface DeviceHoldsProps {
  device: string;
  holds: readonly Hold[];
  changed: () => Promise<void>;
}

function DeviceHolds({ device, holds, changed }: DeviceHoldsProps) {
  const stream = useDeviceStream(device, ["holds"], RATE_HZ);
  // A board that does not know must not say that the beam may be on. Where the device does not run, the stream is stale as
  // soon as the server is not reached.
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
            <Reason hold={hold} state={state} />
            {state ? <p>{text.holds.since(sinceTime(toMilliseconds(state.since_ns)))}</p> : null}
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
              done={changed}
            />
          </article>
        );
      })}
    </>
  );
}

/** Why a beam is held: the cause in words that are read from afar, then the server's own with numbers. */
function Reason({ hold, state }: { hold: Hold; state: HoldSample | undefined }) {
  if (!state) return <p class="cause">{text.holds.unknownReason}</p>;
  if (!state.held) return null;
  // The server's sentence on a hold without a reference is for programs: it names a request.
  if (!hold.reference && state.cause === "no-data") return <p class="cause">{text.holds.noReference}</p>;
  const cause = state.cause as Exclude<Schemas["BeamHoldCause"], "none">;
  return (
    <>
      <p class="cause">{text.holds.causes[cause] ?? state.cause}</p>
      <p>{state.reason}</p>
    </>
  );
}
