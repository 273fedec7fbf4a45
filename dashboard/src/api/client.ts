/** Requests to the server, typed by its OpenAPI document. */

import createClient, { type Middleware } from "openapi-fetch";
import type { components, paths } from "./schema";
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

/** Return the answer's document, or throw RequestFailed with the server's own words. */
export async function sent<T>(request: Promise<Answer<T>>): Promise<T> {
  let answer: Answer<T>;
  try {
    answer = await request;
  } catch {
    throw new RequestFailed(0, null, "The server does not answer.");
  }
  if (answer.response.ok) return answer.data as T;
  const problem = (answer.error ?? null) as Problem | null;
  const status = answer.response.status;
  throw new RequestFailed(status, problem, problem?.detail ?? `The server answered ${status}.`);
}

/** Return a picture or a file of the server as a blob: images carry no key of their own. */
export async function fetchBlob(path: string): Promise<Blob> {
  const headers: HeadersInit = key.value ? { Authorization: `Bearer ${key.value}` } : {};
  const response = await fetch(path, { headers });
  if (!response.ok) {
    const problem = (await response.json().catch(() => null)) as Problem | null;
    throw new RequestFailed(response.status, problem, problem?.detail ?? response.statusText);
  }
  return response.blob();
}
