import { expect, test, vi } from "vitest";

const GET = vi.fn();
const POST = vi.fn();
vi.mock("../api/client", () => ({ api: { GET, POST }, sent: (answer: unknown) => answer }));

const { startUnlessRunning } = await import("./start_device");

test.each([
  ["stopped", 1],
  ["failed", 1],
  ["ended", 1],
  ["running", 0],
  ["starting", 0],
  ["disconnected", 0],
])("a device that is %s is started %i times", async (state, times) => {
  POST.mockClear();
  GET.mockReturnValue({ state });
  await startUnlessRunning("bar");
  expect(POST).toHaveBeenCalledTimes(times);
});
