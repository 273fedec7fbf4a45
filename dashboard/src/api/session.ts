/** Who this page is for the server, and what that allows. */

import { computed, signal } from "@preact/signals";
import { api, RequestFailed, type Schemas, sent } from "./client";
import { setKey } from "./key";
import { RequestOrder } from "./request_order";
import { OPERATION_SCOPES } from "./scopes";

export type Operation = keyof typeof OPERATION_SCOPES;
export type Session = Schemas["RequestPrincipal"];

/** Null: not known yet, or no access. */
export const session = signal<Session | null>(null);
/** Why there is no access: the server's words. */
export const refusal = signal<string | null>(null);
/** Why the server could not say who this is, though it answers: too many requests, or not ready. It is asked again. */
export const trouble = signal<string | null>(null);
export const serverReached = signal(true);

const LIMIT_MS = 5000;
const order = new RequestOrder();

const scopes = computed(() => new Set<string>(session.value?.scopes ?? []));

/** Return whether an operation is allowed; the server checks again. */
export function allowed(operation: Operation): boolean {
  return scopes.value.has(OPERATION_SCOPES[operation]);
}

/** Return the scopes, as text, that a use of all these operations lacks; null: it is allowed. */
export function lacking(operations: readonly Operation[]): string | null {
  const missing = operations.filter((operation) => !allowed(operation)).map(scopeOf);
  return missing.length ? [...new Set(missing)].join(", ") : null;
}

/** Return the scope that an operation needs. */
export function scopeOf(operation: Operation): string {
  return OPERATION_SCOPES[operation];
}

/** Ask the server who this is. */
export async function openSession(): Promise<void> {
  const number = order.begin();
  try {
    const found = await sent(api.GET("/api/v1/principal", { signal: AbortSignal.timeout(LIMIT_MS) }));
    if (!order.isNewest(number)) return;
    session.value = found;
    refusal.value = null;
    trouble.value = null;
    serverReached.value = true;
  } catch (error) {
    if (!(error instanceof RequestFailed)) throw error;
    if (!order.isNewest(number)) return;
    serverReached.value = error.status !== 0;
    const refused = error.status === 401 || error.status === 403;
    trouble.value = refused || error.status === 0 ? null : error.message;
    if (refused) {
      session.value = null;
      refusal.value = error.message;
    }
  }
}

export async function logIn(text: string): Promise<void> {
  setKey(text.trim());
  await openSession();
  // A key that the server could not look at may be good.
  if (session.value === null && trouble.value === null && serverReached.value) setKey(null);
}

export async function logOut(): Promise<void> {
  setKey(null);
  session.value = null;
  await openSession();
}
