import { expect, test } from "vitest";
import { auditQuery, EMPTY_FILTER } from "./audit_filter";

test("what is left empty is not asked for", () => {
  expect(auditQuery(EMPTY_FILTER)).toEqual({});
  expect(auditQuery({ ...EMPTY_FILTER, operation: " create-tool ", outcome: "refused" })).toEqual({ operation: "create-tool", outcome: "refused" });
});

test("moments have their time zone", () => {
  const { since } = auditQuery({ ...EMPTY_FILTER, since: "2026-01-31T12:00" }) as { since: string };
  expect(since).toMatch(/^2026-0[12]-\d\dT\d\d:00:00\.000Z$/);
  expect(new Date(since).getTime()).toBe(new Date(2026, 0, 31, 12).getTime());
});

test("half a moment is none", () => {
  expect(auditQuery({ ...EMPTY_FILTER, until: "2026-01-99T" })).toEqual({});
});
