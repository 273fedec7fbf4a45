/** Small parts that all screens use. */

import { useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useLayoutEffect, useRef } from "preact/hooks";
import { RequestFailed } from "../api/client";
import { lacking, type Operation } from "../api/session";
import { text } from "../text";
import { copyText } from "./clipboard";

interface PanelProps {
  title: string;
  actions?: ComponentChildren;
  /** A person opened it: its heading takes the focus, so that what was opened is read next. */
  focus?: boolean;
  children: ComponentChildren;
}

export function Panel(props: PanelProps) {
  const heading = useRef<HTMLHeadingElement>(null);
  useLayoutEffect(() => {
    if (props.focus) heading.current?.focus();
  }, []);
  return (
    <section class="panel" aria-label={props.title}>
      <header class="panel-head">
        <h2 ref={heading} tabIndex={props.focus ? -1 : undefined}>
          {props.title}
        </h2>
        <div class="row">{props.actions}</div>
      </header>
      {props.children}
    </section>
  );
}

/** Says an error in the server's words; nothing where there is none. */
export function Failure({ message }: { message: string | null }) {
  return message ? (
    <p class="failure" role="alert">
      {message}
    </p>
  ) : null;
}

export function Badge({ kind, children }: { kind: "good" | "warn" | "bad" | "idle"; children: ComponentChildren }) {
  return <span class={`badge ${kind}`}>{children}</span>;
}

/** A reason, as visible text beside what it explains; nothing where there is none. */
export function Why({ reason }: { reason: string | null | undefined }) {
  return reason ? <small class="why">{reason}</small> : null;
}

interface ActionProps {
  label: string;
  /** All of them are needed. */
  operation: Operation | readonly Operation[];
  run: () => Promise<unknown>;
  /** A question that is asked before. */
  confirm?: string;
  disabled?: boolean;
  /** What it began is still under way: it may not begin again, but keeps the focus. */
  busy?: boolean;
  kind?: "primary" | "danger";
  done?: () => void | Promise<void>;
}

/** A button for an operation of the server: shows what is not allowed, and what went wrong. */
export function Action(props: ActionProps) {
  const working = useSignal(false);
  const asking = useSignal(false);
  const error = useSignal<string | null>(null);
  const scopes = lacking(typeof props.operation === "string" ? [props.operation] : props.operation);
  const can = scopes === null;
  const refusal = scopes === null ? undefined : text.access.notAllowed(scopes);
  const group = useRef<HTMLSpanElement>(null);
  const button = useRef<HTMLButtonElement>(null);
  const asked = useRef(false);
  // The question takes the focus before the next key, and gives it back to the button once it is answered.
  useLayoutEffect(() => {
    if (asking.value) group.current?.focus();
    else if (asked.current) button.current?.focus();
    asked.current = asking.value;
  }, [asking.value]);
  // A button that is disabled would lose the focus.
  const busy = working.value || props.busy === true;
  const act = async () => {
    asking.value = false;
    working.value = true;
    error.value = null;
    try {
      await props.run();
      await props.done?.();
    } catch (failure) {
      if (!(failure instanceof RequestFailed)) throw failure;
      error.value = failure.message;
    } finally {
      working.value = false;
    }
  };
  if (asking.value) {
    return (
      <span
        ref={group}
        class="row"
        role="group"
        tabIndex={-1}
        aria-label={props.confirm}
        onKeyDown={(event) => {
          if (event.key === "Escape") asking.value = false;
        }}
      >
        <span>{props.confirm}</span>
        <button type="button" class="danger" onClick={() => void act()}>
          {text.confirm.yes}
        </button>
        <button type="button" onClick={() => (asking.value = false)}>
          {text.confirm.no}
        </button>
      </span>
    );
  }
  return (
    <span class="action">
      <button
        ref={button}
        type="button"
        class={props.kind}
        disabled={!can || (props.disabled && !busy)}
        aria-disabled={busy}
        title={refusal}
        onClick={() => {
          if (busy) return;
          if (props.confirm) asking.value = true;
          else void act();
        }}
      >
        {working.value ? "…" : props.label}
      </button>
      {refusal ? <small class="muted">{refusal}</small> : null}
      <Failure message={error.value} />
    </span>
  );
}

export function Copy({ value }: { value: string }) {
  const done = useSignal<string | null>(null);
  const copy = async () => {
    done.value = (await copyText(value)) ? text.copied : text.notCopied;
    setTimeout(() => (done.value = null), 1500);
  };
  return (
    <button type="button" class="quiet" onClick={() => void copy()}>
      {done.value ?? text.copy}
    </button>
  );
}

interface TableProps<T> {
  caption: string;
  columns: readonly string[];
  rows: readonly T[];
  row: (item: T) => readonly ComponentChildren[];
  identity: (item: T) => string | number;
  empty: string;
  /** Rows can be picked. */
  selected?: string | number | null;
  select?: (identity: string | number) => void;
}

/** More rows nobody reads, and drawn some times a second they would take the browser's time. */
const MAX_ROWS = 200;

export function Table<T>(props: TableProps<T>) {
  if (!props.rows.length) return <p class="muted">{props.empty}</p>;
  return (
    <div class="scroll" tabIndex={0} role="region" aria-label={props.caption}>
      <table>
        <caption class="hidden">{props.caption}</caption>
        <thead>
          <tr>
            {props.columns.map((name) => (
              <th key={name} scope="col">
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>
          {props.rows.slice(0, MAX_ROWS).map((item) => {
            const identity = props.identity(item);
            const cells = props.row(item);
            return (
              <tr key={identity} class={props.selected === identity ? "selected" : undefined}>
                {cells.map((cell, index) =>
                  index === 0 && props.select ? (
                    <th key={index} scope="row">
                      <button
                        type="button"
                        class="quiet"
                        aria-pressed={props.selected === identity}
                        onClick={() => props.select?.(identity)}
                      >
                        {cell}
                      </button>
                    </th>
                  ) : (
                    <td key={index}>{cell}</td>
                  ),
                )}
              </tr>
            );
          })}
        </tbody>
      </table>
      {props.rows.length > MAX_ROWS ? <p class="muted">{text.moreRows(props.rows.length - MAX_ROWS)}</p> : null}
    </div>
  );
}

/** A value that changes too often to be read, at most `hertz` times a second. */
export function useThrottled<T>(read: () => T, hertz: number): T {
  const shown = useSignal<T>(read());
  const latest = useRef(read);
  latest.current = read;
  useEffect(() => {
    const timer = setInterval(() => (shown.value = latest.current()), 1000 / hertz);
    return () => clearInterval(timer);
  }, [hertz]);
  return shown.value;
}
