/** Who this page is for the server, and what that allows. */

import { computed, signal } from "@preact/signals";
import { api, RequestFailed, type Schemas, sent } from "./client";
import { setKey } from "./key";
import { OPERATION_SCOPES } from "./scopes";

export type Operation = keyof typeof OPERATION_SCOPES;
export type Session = Schemas["RequestPrincipal"];

/** Null: not known yet, or no access. */
export const session = signal<Session | null>(null);
/** Why there is no access: the server's words. */
export const refusal = signal<string | null>(null);
export const serverReached = signal(true);

const scopes = computed(() => new Set<string>(session.value?.scopes ?? []));

/** Return whether an operation is allowed; the server checks again. */
export function allowed(operation: Operation): boolean {
  return scopes.value.has(OPERATION_SCOPES[operation]);
}

/** Return the scope that an operation needs. */
export function scopeOf(operation: Operation): string {
  return OPERATION_SCOPES[operation];
}

/** Ask the server who this is. */
export async function openSession(): Promise<void> {
  try {
    session.value = await sent(api.GET("/api/v1/principal"));
    refusal.value = null;
    serverReached.value = true;
  } catch (error) {
    if (!(error instanceof RequestFailed)) throw error;
    serverReached.value = error.status !== 0;
    if (error.status === 401 || error.status === 403) {
      session.value = null;
      refusal.value = error.message;
    }
  }
}

export async function logIn(text: string): Promise<void> {
  setKey(text.trim());
  await openSession();
  if (session.value === null) setKey(null);
}

export async function logOut(): Promise<void> {
  setKey(null);
  session.value = null;
  await openSession();
}
