/** Requests to the server, typed by its OpenAPI document. */

import createClient, { type Middleware } from "openapi-fetch";
import type { components, paths } from "./schema";
import { text } from "../text";
import { key } from "./key";

export type Schemas = components["schemas"];
export type Problem = Schemas["Problem"];

/** An answer that is a problem document, or none at all. */
export class RequestFailed extends Error {
  constructor(
    readonly status: number,
    readonly problem: Problem | null,
    message: string,
  ) {
    super(message);
  }
}

const withKey: Middleware = {
  onRequest({ request }) {
    if (key.value) request.headers.set("Authorization", `Bearer ${key.value}`);
    return request;
  },
};

export const api = createClient<paths>({ baseUrl: "/" });
api.use(withKey);

/** What openapi-fetch gives back. */
interface Answer<T> {
  data?: T;
  error?: unknown;
  response: Response;
}

/** A document as it was read, with its entity tag: what another changed meanwhile is not overwritten. */
export interface Tagged<T> {
  readonly document: T;
  readonly tag: string;
}

/** Return the answer's document, or throw RequestFailed with the server's own words. */
export async function sent<T>(request: Promise<Answer<T>>): Promise<T> {
  return (await tagged(request)).document;
}

/** Return the answer's document with its entity tag, or throw RequestFailed with the server's own words. */
export async function tagged<T>(request: Promise<Answer<T>>): Promise<Tagged<T>> {
  const { data, error, response } = await reached(request);
  if (!response.ok) throw failure(response.status, (error ?? null) as Problem | null);
  return { document: data as T, tag: response.headers.get("ETag") ?? "*" };
}

/** A network's failure is a TypeError of fetch, and that of an answer cut short a SyntaxError. */
async function reached<T>(answer: Promise<T>): Promise<T> {
  try {
    return await answer;
  } catch {
    throw new RequestFailed(0, null, text.connection.noAnswer);
  }
}

function failure(status: number, problem: Problem | null): RequestFailed {
  return new RequestFailed(status, problem, problem?.detail ?? text.connection.answered(status));
}

/** Return a picture or a file of the server as a blob: images carry no key of their own. */
export async function fetchBlob(path: string): Promise<Blob> {
  const headers: HeadersInit = key.value ? { Authorization: `Bearer ${key.value}` } : {};
  const response = await reached(fetch(path, { headers }));
  if (!response.ok) throw failure(response.status, (await response.json().catch(() => null)) as Problem | null);
  return reached(response.blob());
}
