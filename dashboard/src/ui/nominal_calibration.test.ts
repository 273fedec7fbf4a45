import { beforeEach, describe, expect, test, vi } from "vitest";

const GET = vi.fn();
const POST = vi.fn();
vi.mock("../api/client", () => {
  class RequestFailed extends Error {
    constructor(
      readonly status: number,
      message: string,
    ) {
      super(message);
    }
  }
  return { api: { GET, POST }, RequestFailed, sent: (answer: Promise<unknown>) => answer };
});

const { tryNominal, useNominal } = await import("./nominal_calibration");
const { RequestFailed } = (await import("../api/client")) as unknown as { RequestFailed: new (status: number, message: string) => Error };

interface Stored {
  id: string;
  state: string;
  provenance: string;
  profile: { profile_id: string; content_hash: string } | null;
}

let stored: Stored[] = [];
let activated: string[] = [];
let refusal: Error | null = null;

function nominal(id: string, profile_id: string | null, state = "available", content_hash = "now"): Stored {
  return { id, state, provenance: "nominal", profile: profile_id === null ? null : { profile_id, content_hash } };
}

beforeEach(() => {
  stored = [];
  activated = [];
  refusal = null;
  GET.mockImplementation(async (path: string) => (path.includes("profiles") ? { content_hash: "now" } : { items: stored }));
  POST.mockImplementation(async (_path: string, { params }: { params?: { path: { calibration_id: string } } }) => {
    if (params) {
      activated.push(params.path.calibration_id);
      return {};
    }
    if (refusal) throw refusal;
    return { id: "new" };
  });
});

describe("nominal calibration", () => {
  test("one of this profile is used again", async () => {
    stored = [nominal("old", "bar")];
    await useNominal("d", "bar");
    expect(activated).toEqual(["old"]);
  });

  test.each([
    ["of another profile", nominal("old", "other")],
    ["of the profile as it was", nominal("old", "bar", "available", "before")],
    ["that is retired", nominal("old", "bar", "retired")],
    ["that names no profile", nominal("old", null)],
  ])("one %s is not used", async (_, one) => {
    stored = [one];
    await useNominal("d", "bar");
    expect(activated).toEqual(["new"]);
  });

  test.each([409, 422, 403, 503])("a refusal with %d is told in the server's words", async (status) => {
    refusal = new RequestFailed(status, "why not");
    expect(await tryNominal("d", "bar")).toBe("why not");
    expect(activated).toEqual([]);
  });

  test("nothing is told where it is done", async () => {
    expect(await tryNominal("d", "bar")).toBeNull();
  });
});
