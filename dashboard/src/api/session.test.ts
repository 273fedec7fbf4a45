import { beforeEach, expect, test, vi } from "vitest";

const answer = vi.hoisted(() => ({ next: (): Promise<unknown> => Promise.reject(new Error("not set")) }));

vi.mock("./key", () => ({ key: { value: null }, setKey: vi.fn() }));
vi.mock("./client", () => ({
  api: { GET: () => answer.next() },
  sent: (request: Promise<unknown>) => request,
  RequestFailed: class extends Error {
    constructor(
      readonly status: number,
      _problem: null,
      message: string,
    ) {
      super(message);
    }
  },
}));

const { lacking, logIn, openSession, refusal, serverReached, session, trouble } = await import("./session");
const { RequestFailed } = await import("./client");
const { setKey } = await import("./key");
const VIEWER = { kind: "key", scopes: ["read:stream"] };

function fails(status: number, message: string): void {
  answer.next = () => Promise.reject(new RequestFailed(status, null, message));
}

beforeEach(() => {
  session.value = refusal.value = trouble.value = null;
  serverReached.value = true;
  vi.mocked(setKey).mockClear();
});

test.each([429, 503])("an answer %i is trouble that is said, and ends with the next good answer", async (status) => {
  fails(status, "come back later");
  await openSession();
  expect([session.value, refusal.value, trouble.value, serverReached.value]).toEqual([null, null, "come back later", true]);
  answer.next = async () => VIEWER;
  await openSession();
  expect([session.value, trouble.value]).toEqual([VIEWER, null]);
});

test("a key that is refused is forgotten, one that could not be looked at is kept", async () => {
  fails(401, "no such key");
  await logIn("lumi_a");
  expect(refusal.value).toBe("no such key");
  expect(setKey).toHaveBeenLastCalledWith(null);
  for (const status of [0, 429, 503]) {
    fails(status, "come back later");
    await logIn("lumi_b");
    expect(setKey).toHaveBeenLastCalledWith("lumi_b");
  }
});

test("a late answer to an older request changes nothing", async () => {
  let late: (reason: Error) => void = () => undefined;
  answer.next = () => new Promise((_, reject) => (late = reject));
  const older = openSession();
  answer.next = async () => VIEWER;
  await openSession();
  late(new RequestFailed(401, null, "this server wants a key"));
  await older;
  expect([session.value, refusal.value]).toEqual([VIEWER, null]);
});

test.each([
  [["write:calibrations"], "activate:calibrations"],
  [["activate:calibrations"], "write:calibrations"],
  [[], "write:calibrations, activate:calibrations"],
  [["write:calibrations", "activate:calibrations"], null],
])("of two operations the scopes that are lacking are named, with %j", async (scopes, missing) => {
  answer.next = async () => ({ kind: "key", scopes });
  await openSession();
  expect(lacking(["POST /api/v1/nominal-calibrations", "POST /api/v1/calibrations/{calibration_id}/activate"])).toBe(missing);
});
