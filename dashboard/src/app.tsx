/** The page's frame: access, navigation, the chosen device, and the screen. */

import { signal, useSignal, useSignalEffect } from "@preact/signals";
import type { ComponentType } from "preact";
import { useEffect } from "preact/hooks";
import { api, sent } from "./api/client";
import { logIn, logOut, openSession, refusal, serverReached, session, trouble } from "./api/session";
import { choose, device, devices, loadDevices, missing } from "./devices";
import { usePolled } from "./live/polling";
import { visible } from "./live/visibility";
import { Administration } from "./screens/administration/administration";
import { Calibrate } from "./screens/calibrate/calibrate";
import { Health } from "./screens/health/health";
import { Holds } from "./screens/holds";
import { PlanScreen } from "./screens/plan/plan";
import { QualityScreen } from "./screens/quality/quality";
import { Recordings } from "./screens/recordings/recordings";
import { Scene } from "./screens/scene/scene";
import { ScansScreen } from "./screens/scans/scans";
import { Tools } from "./screens/tools/tools";
import { text } from "./text";
import { FaultBoundary } from "./ui/fault_boundary";
import { Action, Badge, Failure, Why } from "./ui/parts";

type Name = keyof typeof text.screens;

const SCREENS: Record<Name, ComponentType> = {
  scene: Scene,
  scans: ScansScreen,
  calibrate: Calibrate,
  tools: Tools,
  holds: Holds,
  recordings: Recordings,
  quality: QualityScreen,
  plan: PlanScreen,
  health: Health,
  administration: Administration,
};

function named(hash: string): Name {
  const name = hash.replace(/^#\/?/, "");
  return name in SCREENS ? (name as Name) : "scene";
}

const screen = signal<Name>(named(location.hash));
addEventListener("hashchange", () => (screen.value = named(location.hash)));

const RETRY_MS = 1000;
/** A server that has too much to do is asked less often than one that is gone. */
const TROUBLE_RETRY_MS = 5000;

export function App() {
  useSignalEffect(() => {
    if (!visible.value) return undefined;
    if (serverReached.value && session.value) return undefined;
    void openSession();
    // Without access the person at the page acts; without a server nobody can.
    const gone = setInterval(() => {
      if (!serverReached.value) void openSession();
    }, RETRY_MS);
    const troubled = setInterval(() => {
      if (trouble.value !== null) void openSession();
    }, TROUBLE_RETRY_MS);
    return () => {
      clearInterval(gone);
      clearInterval(troubled);
    };
  });
  return (
    <>
      <a class="skip" href="#content" onClick={focusContent}>
        {text.skip}
      </a>
      <header class="top">
        <strong class="product">{text.product}</strong>
        <Navigation />
        {session.value ? <DeviceChoice /> : null}
      </header>
      {serverReached.value ? null : (
        <p class="banner bad" role="alert">
          {text.connection.server}
        </p>
      )}
      <main id="content" tabIndex={-1}>
        {session.value ? <Screen /> : <Access />}
      </main>
      <footer class="muted">{text.research}</footer>
    </>
  );
}

function focusContent(event: Event): void {
  event.preventDefault();
  document.getElementById("content")?.focus();
}

function Screen() {
  const Shown = SCREENS[screen.value];
  const title = text.screens[screen.value];
  useEffect(() => {
    document.title = `${title} – ${text.product}`;
  }, [title]);
  return (
    <>
      <h1 class="hidden">{title}</h1>
      <FaultBoundary key={title} screen={title}>
        <Shown />
      </FaultBoundary>
    </>
  );
}

function Navigation() {
  return (
    <nav aria-label={text.product}>
      {(Object.keys(SCREENS) as Name[]).map((name) => (
        <a key={name} href={`#/${name}`} aria-current={screen.value === name ? "page" : undefined}>
          {text.screens[name]}
        </a>
      ))}
    </nav>
  );
}

function DeviceChoice() {
  const polled = usePolled("devices", loadDevices, 5);
  const now = device.value;
  const known = devices.value ?? [];
  return (
    <div class="row">
      {known.length ? (
        <label>
          {text.device.label}{" "}
          <select value={now?.id ?? ""} onChange={(event) => choose(event.currentTarget.value)}>
            {now ? null : (
              <option value="" disabled>
                {text.device.choose}
              </option>
            )}
            {known.map((one) => (
              <option key={one.id} value={one.id}>
                {one.title || one.id}
              </option>
            ))}
          </select>
        </label>
      ) : null}
      {now ? <DeviceState id={now.id} /> : null}
      <Failure message={missing.value === null ? null : text.device.gone(missing.value)} />
      <Failure message={unlessGone(polled.error)} />
    </div>
  );
}

/** That the server is gone stands above the screen already. */
function unlessGone(error: string | null): string | null {
  return serverReached.value ? error : null;
}

function DeviceState({ id }: { id: string }) {
  const polled = usePolled(
    `state ${id}`,
    () => sent(api.GET("/api/v1/devices/{device_id}/state", { params: { path: { device_id: id } } })),
    2,
  );
  const now = polled.value;
  const state = now?.state;
  // The last state is of before.
  if (polled.error !== null) return <Failure message={unlessGone(polled.error)} />;
  if (!state) return null;
  const path = { params: { path: { device_id: id } } };
  return (
    <>
      <Badge kind={state === "running" ? "good" : state === "failed" || state === "disconnected" ? "bad" : "idle"}>
        {state}
      </Badge>
      {state === "stopped" || state === "failed" || state === "ended" ? (
        <Action
          label={text.device.start}
          operation="POST /api/v1/devices/{device_id}/start"
          run={() => sent(api.POST("/api/v1/devices/{device_id}/start", path))}
          done={polled.refresh}
        />
      ) : null}
      <Why reason={now.reason} />
    </>
  );
}

function Access() {
  const entered = useSignal("");
  const why = trouble.value === null ? null : text.connection.again(trouble.value);
  if (serverReached.value && refusal.value === null && why !== null) return <Failure message={why} />;
  if (!serverReached.value || refusal.value === null) return <p class="muted">{text.loading}</p>;
  return (
    <form
      class="panel access"
      onSubmit={(event) => {
        event.preventDefault();
        void logIn(entered.value);
      }}
    >
      <h1>{text.access.title}</h1>
      <p>{text.access.needed}</p>
      <label>
        {text.access.key}
        <input
          type="password"
          autocomplete="off"
          value={entered.value}
          onInput={(event) => (entered.value = event.currentTarget.value)}
        />
      </label>
      <button type="submit" class="primary">
        {text.access.open}
      </button>
      <Failure message={why ?? refusal.value} />
      <p class="muted">{text.access.kept}</p>
      <button type="button" class="quiet" onClick={() => void logOut()}>
        {text.access.logOut}
      </button>
    </form>
  );
}
