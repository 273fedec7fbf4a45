/** Plan: choose a profile, change its geometry, see what it would reach; keep it and simulate it. */

import { batch, type ReadonlySignal, useComputed, useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { whenFree } from "../../api/busy_server";
import { api, RequestFailed, sent } from "../../api/client";
import { allowed, lacking, scopeOf } from "../../api/session";
import { choose, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { newDeviceId } from "../../ui/device_id";
import { NOMINAL_OPERATIONS, tryNominal } from "../../ui/nominal_calibration";
import { Action, Failure, Panel } from "../../ui/parts";
import { startUnlessRunning } from "../../ui/start_device";
import { takeText } from "../../ui/text_file";
import type { Plan } from "./plan_figures";
import { PlanResult } from "./plan_result";
import { changedProfile, type Geometry, keptAs, nameOf, renamed, type StoredProfile, UNCHANGED } from "./profile_text";

const PLAN = "POST /api/v1/profile-plans";
/** A plan takes the server most of a second: not one for each step of a slider. */
const SETTLED_MS = 300;
/** Points of the volume along each axis. */
const GRID = 3;
const SLIDERS: readonly (keyof Geometry)[] = ["baseline", "distance", "volume", "exposure"];

/** What is planned: a stored profile, or a file of the person at the page. */
interface Profile {
  /** Distinguishes what was loaded one after the other. */
  readonly loaded: number;
  /** Null: it is not stored. */
  readonly name: string | null;
  readonly toml: string;
}

const FILE = "";

export function PlanScreen() {
  const profiles = usePolled("profiles", () => sent(api.GET("/api/v1/device-profiles", { params: { query: { limit: 200 } } })), 30);
  const chosen = useSignal("bar");
  const shown = useSignal<Profile | null>(null);
  const problem = useSignal<string | null>(null);
  const turn = useRef(0);
  const show = async (name: string, read: () => Promise<string>) => {
    const mine = ++turn.current;
    chosen.value = name;
    // Until it is there nothing is shown: the one before is not what is chosen.
    shown.value = null;
    problem.value = null;
    try {
      const toml = await read();
      if (mine === turn.current) shown.value = { loaded: mine, name: name === FILE ? null : name, toml };
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      if (mine === turn.current) problem.value = failure.message;
    }
  };
  const load = (id: string) =>
    show(id, async () => (await sent(api.GET("/api/v1/device-profiles/{profile_id}", { params: { path: { profile_id: id } } }))).toml);
  useEffect(() => void load(chosen.value), []);
  return (
    <>
      <Panel title={text.screens.plan}>
        <div class="row">
          <label>
            {text.plan.profile}{" "}
            <select value={chosen.value} onChange={({ currentTarget }) => void load(currentTarget.value)}>
              {chosen.value === FILE ? <option value={FILE}>{text.plan.own}</option> : null}
              {(profiles.value?.items ?? []).map(({ id, title }) => (
                <option key={id} value={id} title={title}>
                  {id}
                </option>
              ))}
            </select>
          </label>
          <label>
            {text.plan.file}{" "}
            <input
              type="file"
              accept=".toml"
              onChange={({ currentTarget }) => {
                if (currentTarget.files?.length) void show(FILE, async () => (await takeText(currentTarget)) ?? "");
              }}
            />
          </label>
        </div>
        <p class="muted">{profiles.value?.items.find(({ id }) => id === chosen.value)?.title}</p>
        <Failure message={profiles.error ?? problem.value} />
      </Panel>
      {shown.value ? <Laboratory key={shown.value.loaded} profile={shown.value} kept={profiles.refresh} /> : null}
    </>
  );
}

function Laboratory({ profile, kept }: { profile: Profile; kept: () => Promise<void> }) {
  /** The text as it was loaded or edited; sliders change the numbers in it. */
  const written = useSignal(profile.toml);
  const geometry = useSignal<Geometry>(UNCHANGED);
  const toml = useComputed(() => changedProfile(written.value, geometry.value) ?? written.value);
  const { plan, base, planned, busy, error } = usePlans(profile, toml);
  const can = allowed(PLAN);
  const adjustable = changedProfile(written.value, UNCHANGED) !== null;
  const write = (entered: string) =>
    batch(() => {
      written.value = entered;
      geometry.value = UNCHANGED;
    });
  const stale = planned.value !== toml.value;
  return (
    <>
      <Panel
        title={text.plan.geometry}
        actions={
          <button type="button" disabled={!can} onClick={() => write(profile.toml)}>
            {text.plan.reset}
          </button>
        }
      >
        {can ? null : <p class="muted">{text.access.notAllowed(scopeOf(PLAN))}</p>}
        {adjustable ? (
          <div class="sliders">
            {SLIDERS.map((name) => (
              <label key={name}>
                {text.plan.sliders[name]} <span>{`× ${geometry.value[name].toFixed(2)}`}</span>
                <input
                  type="range"
                  min={-1}
                  max={1}
                  step={0.02}
                  disabled={!can}
                  // By doubling and halving: the middle is the profile as it is.
                  value={Math.log2(geometry.value[name])}
                  onInput={({ currentTarget }) => (geometry.value = { ...geometry.value, [name]: 2 ** Number(currentTarget.value) })}
                />
              </label>
            ))}
          </div>
        ) : (
          <p class="muted">{text.plan.notAdjustable}</p>
        )}
        <details>
          <summary>{text.plan.edit}</summary>
          <textarea rows={16} spellcheck={false} readOnly={!can} aria-label={text.plan.edit} value={toml.value} onInput={({ currentTarget }) => write(currentTarget.value)} />
        </details>
        <Keep profile={profile} toml={toml.value} kept={kept} />
      </Panel>
      <Failure message={error.value} />
      <p class="muted" role="status">{busy.value ? text.plan.computing : ""}</p>
      {plan.value ? (
        // Figures of another profile than the one above must not look like its own.
        <div class={stale ? "stale" : ""} aria-busy={stale}>
          <PlanResult plan={plan.value} base={base.value} />
        </div>
      ) : null}
    </>
  );
}

/** Plans of the profile as it was and of the text that is shown, one after the other: the server computes few at once. */
function usePlans(profile: Profile, toml: ReadonlySignal<string>) {
  const base = useSignal<Plan | null>(null);
  const plan = useSignal<Plan | null>(null);
  /** The text that the plan is of. */
  const planned = useSignal<string | null>(null);
  const error = useSignal<string | null>(null);
  const busy = useSignal(false);
  const shownNoMore = useRef(new AbortController()).current;
  const { signal } = shownNoMore;
  useEffect(() => () => shownNoMore.abort(), []);
  const planOf = async (asked: string): Promise<Plan | null> => {
    error.value = null;
    try {
      // Others plan, too, and the server computes few at once.
      if (allowed(PLAN)) return await whenFree(() => sent(api.POST("/api/v1/profile-plans", { body: { toml: asked, grid: GRID }, signal })), signal);
      // Who may only look may see the plan of what is stored, and so of nothing else.
      if (profile.name === null || asked !== profile.toml) return null;
      const params = { path: { profile_id: profile.name }, query: { grid: GRID } };
      return await whenFree(() => sent(api.GET("/api/v1/device-profiles/{profile_id}/plan", { params, signal })), signal);
    } catch (failure) {
      if (signal.aborted) return null;
      if (!(failure instanceof RequestFailed)) throw failure;
      error.value = failure.message;
      return null;
    }
  };
  const work = async () => {
    if (busy.value) return;
    busy.value = true;
    try {
      let asked: string;
      do {
        asked = toml.value;
        base.value ??= await planOf(profile.toml);
        if (signal.aborted) return;
        const found = asked === profile.toml ? base.value : await planOf(asked);
        if (!found) continue;
        plan.value = found;
        planned.value = asked;
      } while (!signal.aborted && asked !== toml.value);
    } finally {
      busy.value = false;
    }
  };
  useEffect(() => {
    const timer = setTimeout(() => void work(), base.value ? SETTLED_MS : 0);
    return () => clearTimeout(timer);
  }, [toml.value]);
  return { plan, base, planned, busy, error };
}

interface KeepProps {
  profile: Profile;
  toml: string;
  kept: () => Promise<void>;
}

function Keep({ profile, toml, kept }: KeepProps) {
  const name = useSignal(`${nameOf(toml) ?? "device"}-own`);
  /** What the server has, the newest first: devices are simulated from that. */
  const stored = useSignal<readonly StoredProfile[]>(profile.name === null ? [] : [{ name: profile.name, toml: profile.toml }]);
  const simulated = keptAs(toml, stored.value);
  const nominal = useSignal(true);
  const lacks = lacking(NOMINAL_OPERATIONS);
  const can = lacks === null;
  /** Why the device that was started has no nominal calibration. */
  const uncalibrated = useSignal<string | null>(null);
  return (
    <>
      <div class="row controls">
        <label>
          {text.plan.name} <input value={name.value} onInput={({ currentTarget }) => (name.value = currentTarget.value)} />
        </label>
        <Action
          label={text.plan.keep}
          operation="POST /api/v1/device-profiles"
          run={async () => {
            const own = { name: name.value, toml: renamed(toml, name.value) };
            await sent(api.POST("/api/v1/device-profiles", { body: { toml: own.toml } }));
            stored.value = [own, ...stored.value];
          }}
          done={kept}
        />
        <Action
          label={text.plan.simulate}
          operation={["POST /api/v1/devices", "POST /api/v1/devices/{device_id}/start"]}
          disabled={simulated === null}
          run={async () => {
            uncalibrated.value = null;
            if (simulated !== null) uncalibrated.value = await simulate(simulated, nominal.value && can);
          }}
        />
        <label>
          <input type="checkbox" disabled={!can} checked={nominal.value && can} onChange={({ currentTarget }) => (nominal.value = currentTarget.checked)} />{" "}
          {text.plan.nominal}
        </label>
      </div>
      <p class="muted">{simulated === null ? text.plan.keepFirst : text.plan.simulates(simulated)}</p>
      <p class="muted">{lacks === null ? text.plan.nominalHelp : text.access.notAllowed(lacks)}</p>
      <Failure message={uncalibrated.value === null ? null : text.plan.uncalibrated(uncalibrated.value)} />
    </>
  );
}

/** What a small computer simulates and measures beside another device, and the eye sees as motion. */
const RATE_HZ = 50;

/**
 * Start a simulated device of a stored profile, and show it: with a calibration its points, else its scans.
 *
 * Return why it has no nominal calibration, where it should have one; then nothing is shown yet.
 */
async function simulate(profile: string, nominal: boolean): Promise<string | null> {
  const known = await loadDevices();
  const before = known.find(({ source }) => source.kind === "profile" && source.profile_id === profile);
  const id = before?.id ?? newDeviceId(profile, new Set(known.map((one) => one.id)));
  if (!before) {
    const { rates } = await sent(api.GET("/api/v1/device-profiles/{profile_id}", { params: { path: { profile_id: profile } } }));
    const settings = { frame_rate_hz: Math.min(rates.line_rate_hz, RATE_HZ) };
    await sent(api.POST("/api/v1/devices", { body: { id, title: profile, source: { kind: "profile", profile_id: profile, settings } } } as never));
  }
  // One that is measured stays.
  const measured = (before?.active_calibration_id ?? null) !== null;
  const refusal = nominal && !measured ? await tryNominal(id, profile) : null;
  await startUnlessRunning(id);
  await loadDevices();
  choose(id);
  if (refusal === null) location.hash = measured || nominal ? "#/scene" : "#/scans";
  return refusal;
}
