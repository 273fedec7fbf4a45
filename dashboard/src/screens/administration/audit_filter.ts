/** What of the audit log is asked for. */

export interface AuditFilter {
  readonly actor_id: string;
  readonly operation: string;
  readonly object_kind: string;
  readonly object_id: string;
  /** Of the reader's own time zone, as the browser's input gives it; empty: any. */
  readonly since: string;
  readonly until: string;
  readonly outcome: "" | "done" | "refused";
}

export const EMPTY_FILTER: AuditFilter = { actor_id: "", operation: "", object_kind: "", object_id: "", since: "", until: "", outcome: "" };

/** Return the query of a filter: only what was given, moments with their time zone. */
export function auditQuery({ since, until, outcome, ...words }: AuditFilter) {
  const moments = { since: moment(since), until: moment(until) };
  const given = Object.fromEntries(
    Object.entries({ ...words, ...moments }).flatMap(([name, value]) => (value.trim() ? [[name, value.trim()]] : [])),
  );
  return { ...given, ...(outcome ? { outcome } : {}) };
}

function moment(local: string): string {
  const found = new Date(local);
  return Number.isNaN(found.getTime()) ? "" : found.toISOString();
}
