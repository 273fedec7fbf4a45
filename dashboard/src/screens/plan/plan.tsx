/** Plan: choose a profile, change its geometry, see what it would reach; keep it and simulate it. */

import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { api, RequestFailed, sent } from "../../api/client";
import { allowed, scopeOf } from "../../api/session";
import { choose, loadDevices } from "../../devices";
import { usePolled } from "../../live/polling";
import { text } from "../../text";
import { Action, Failure, Panel } from "../../ui/parts";
import type { Plan } from "./plan_figures";
import { PlanResult } from "./plan_result";
import { changedProfile, type Geometry, nameOf, renamed, UNCHANGED } from "./profile_text";

const PLAN = "POST /api/v1/profile-plans";
/** A plan takes the server most of a second: not one for each step of a slider. */
const SETTLED_MS = 300;
const SLIDERS: readonly (keyof Geometry)[] = ["baseline", "distance", "volume", "exposure"];

export function PlanScreen() {
  const profiles = usePolled("profiles", () => sent(api.GET("/api/v1/device-profiles", { params: { query: { limit: 200 } } })), 30);
  const chosen = useSignal("bar");
  const original = useSignal("");
  const edited = useSignal("");
  const problem = useSignal<string | null>(null);
  const load = async (id: string) => {
    chosen.value = id;
    try {
      const found = await sent(api.GET("/api/v1/device-profiles/{profile_id}", { params: { path: { profile_id: id } } }));
      original.value = edited.value = found.toml;
      problem.value = null;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      problem.value = failure.message;
    }
  };
  useEffect(() => void load(chosen.value), []);
  return (
    <>
      <Panel title={text.screens.plan}>
        <div class="row">
          <label>
            {text.plan.profile}{" "}
            <select value={chosen.value} onChange={({ currentTarget }) => void load(currentTarget.value)}>
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
              onChange={async ({ currentTarget }) => {
                const file = currentTarget.files?.[0];
                if (file) original.value = edited.value = await file.text();
              }}
            />
          </label>
        </div>
        <p class="muted">{profiles.value?.items.find(({ id }) => id === chosen.value)?.title}</p>
        <Failure message={profiles.error ?? problem.value} />
      </Panel>
      {original.value ? (
        <Laboratory key={original.value} original={original.value} kept={profiles.refresh} />
      ) : null}
    </>
  );
}

function Laboratory({ original, kept }: { original: string; kept: () => Promise<void> }) {
  const geometry = useSignal<Geometry>(UNCHANGED);
  const toml = useSignal(original);
  const base = useSignal<Plan | null>(null);
  const plan = useSignal<Plan | null>(null);
  const error = useSignal<string | null>(null);
  const busy = useSignal(false);
  /** The profile that the shown plan is of. */
  const planned = useSignal<string | null>(null);
  const turn = useRef(0);
  const adjustable = changedProfile(original, UNCHANGED) !== null;
  const can = allowed(PLAN);

  const ask = async () => {
    if (!can) return;
    const mine = ++turn.current;
    const asked = toml.value;
    busy.value = true;
    try {
      const found = await sent(api.POST("/api/v1/profile-plans", { body: { toml: asked, grid: 3 } }));
      if (mine !== turn.current) return;
      plan.value = found;
      planned.value = asked;
      base.value ??= found;
      error.value = null;
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      if (mine === turn.current) error.value = failure.message;
    } finally {
      if (mine === turn.current) busy.value = false;
    }
  };
  useEffect(() => {
    const timer = setTimeout(() => void ask(), base.value ? SETTLED_MS : 0);
    return () => clearTimeout(timer);
  }, [toml.value]);

  const stale = planned.value !== toml.value;
  const set = (change: Partial<Geometry>) => {
    geometry.value = { ...geometry.value, ...change };
    toml.value = changedProfile(original, geometry.value) ?? toml.value;
  };
  return (
    <>
      <Panel
        title={text.plan.geometry}
        actions={
          <button
            type="button"
            onClick={() => {
              geometry.value = UNCHANGED;
              toml.value = original;
            }}
          >
            {text.plan.reset}
          </button>
        }
      >
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
                  // By doubling and halving: the middle is the profile as it is.
                  value={Math.log2(geometry.value[name])}
                  onInput={({ currentTarget }) => set({ [name]: 2 ** Number(currentTarget.value) })}
                />
              </label>
            ))}
          </div>
        ) : (
          <p class="muted">{text.plan.notAdjustable}</p>
        )}
        <details>
          <summary>{text.plan.edit}</summary>
          <textarea rows={16} spellcheck={false} aria-label={text.plan.edit} value={toml.value} onInput={({ currentTarget }) => (toml.value = currentTarget.value)} />
        </details>
        <Keep toml={toml.value} kept={kept} />
      </Panel>
      {can ? null : <p class="muted">{text.access.notAllowed(scopeOf(PLAN))}</p>}
      <Failure message={error.value} />
      <p class="muted" role="status">{busy.value ? text.plan.computing : ""}</p>
      {plan.value && base.value ? (
        // Figures of another profile than the one above must not look like its own.
        <div class={stale ? "stale" : ""} aria-busy={stale}>
          <PlanResult plan={plan.value} base={base.value} />
        </div>
      ) : null}
    </>
  );
}

function Keep({ toml, kept }: { toml: string; kept: () => Promise<void> }) {
  const name = useSignal(`${nameOf(toml) ?? "device"}-own`);
  const simulate = async () => {
    const id = name.value.replaceAll(".", "-");
    await sent(
      api.POST("/api/v1/devices", { body: { id, title: id, source: { kind: "profile", profile_id: name.value } } } as never),
    );
    await sent(api.POST("/api/v1/devices/{device_id}/start", { params: { path: { device_id: id } } }));
    await loadDevices();
    choose(id);
    // It has no calibration yet, and so no points: what it has are scans.
    location.hash = "#/scans";
  };
  return (
    <div class="row controls">
      <label>
        {text.plan.name} <input value={name.value} onInput={({ currentTarget }) => (name.value = currentTarget.value)} />
      </label>
      <Action
        label={text.plan.keep}
        operation="POST /api/v1/device-profiles"
        run={() => sent(api.POST("/api/v1/device-profiles", { body: { toml: renamed(toml, name.value) } }))}
        done={kept}
      />
      <Action label={text.plan.simulate} operation="POST /api/v1/devices" run={simulate} />
    </div>
  );
}
