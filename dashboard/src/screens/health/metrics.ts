/** Figures from the server's metrics (Prometheus text): what happened between two readings. */

export interface Sample {
  readonly labels: Readonly<Record<string, string>>;
  readonly value: number;
}

export type Metrics = ReadonlyMap<string, readonly Sample[]>;

const LINE = /^([a-zA-Z_:][\w:]*)(?:\{(.*)\})?\s+(\S+)/;
const LABEL = /(\w+)="((?:[^"\\]|\\.)*)"/g;
const ESCAPES: Record<string, string> = { n: "\n", '"': '"', "\\": "\\" };

export function parseMetrics(text: string): Metrics {
  const found = new Map<string, Sample[]>();
  for (const line of text.split("\n")) {
    const parts = line.startsWith("#") ? null : LINE.exec(line);
    if (!parts) continue;
    const labels: Record<string, string> = {};
    for (const [, name, value] of (parts[2] ?? "").matchAll(LABEL))
      labels[name as string] = (value as string).replace(/\\(.)/g, (_, escaped: string) => ESCAPES[escaped] ?? escaped);
    const value = parts[3] === "+Inf" ? Number.POSITIVE_INFINITY : Number(parts[3]);
    const samples = found.get(parts[1] as string) ?? [];
    samples.push({ labels, value });
    found.set(parts[1] as string, samples);
  }
  return found;
}

/** Return the value of the sample that has these labels, whatever others it has; null: there is none. */
export function valueOf(metrics: Metrics, name: string, labels: Readonly<Record<string, string>> = {}): number | null {
  const wanted = Object.entries(labels);
  return metrics.get(name)?.find((sample) => wanted.every(([label, value]) => sample.labels[label] === value))?.value ?? null;
}

/** Return by how much a counter grew; one that began anew counts from zero. */
export function grown(before: Metrics, after: Metrics, name: string, labels: Readonly<Record<string, string>> = {}): number {
  const now = valueOf(after, name, labels) ?? 0;
  const then = valueOf(before, name, labels) ?? 0;
  return now >= then ? now - then : now;
}

export interface LatencyClass {
  /** Longer than this [s]. */
  readonly from: number;
  /** As long as this at most [s]; infinite in the last class. */
  readonly to: number;
  readonly count: number;
}

/** Return how many batches of a device took how long between two readings. */
export function latencies(before: Metrics, after: Metrics, device: string): LatencyClass[] {
  const name = "lumiline_batch_latency_seconds_bucket";
  const bounds = (after.get(name) ?? [])
    .filter(({ labels }) => labels["device"] === device)
    .map(({ labels }) => labels["le"] as string)
    .sort((a, b) => upper(a) - upper(b));
  let from = 0;
  let counted = 0;
  return bounds.map((le) => {
    const all = grown(before, after, name, { device, le });
    const one = { from, to: upper(le), count: Math.max(0, all - counted) };
    from = one.to;
    counted = all;
    return one;
  });
}

function upper(le: string): number {
  return le === "+Inf" ? Number.POSITIVE_INFINITY : Number(le);
}

/** Return what a share of the batches did not exceed [s], by linear interpolation in its class;
 * infinite: beyond the last bound; null: there were none. */
export function quantile(classes: readonly LatencyClass[], share: number): number | null {
  const total = classes.reduce((sum, { count }) => sum + count, 0);
  if (total === 0) return null;
  let left = share * total;
  for (const { from, to, count } of classes) {
    if (count > 0 && left <= count) return Number.isFinite(to) ? from + ((to - from) * left) / count : to;
    left -= count;
  }
  return classes.at(-1)?.to ?? null;
}

export const STAGES = ["reception", "waiting", "computation", "publication"] as const;

export interface StageTime {
  readonly stage: (typeof STAGES)[number];
  /** Mean time from the exposure until the stage begins [s]. */
  readonly from: number;
  /** Mean time in the stage [s]. */
  readonly took: number;
}

/** Return the stages of the frames of a device that were timed between two readings; none without a frame. */
export function stages(before: Metrics, after: Metrics, device: string): StageTime[] {
  const name = "lumiline_frame_stage_seconds";
  let from = 0;
  const found: StageTime[] = [];
  for (const stage of STAGES) {
    const count = grown(before, after, `${name}_count`, { device, stage });
    if (count <= 0) return [];
    const took = Math.max(0, grown(before, after, `${name}_sum`, { device, stage }) / count);
    found.push({ stage, from, took });
    from += took;
  }
  return found;
}

export interface Requests {
  readonly route: string;
  readonly perSecond: number;
  readonly meanMs: number;
}

/** Return the routes that were asked for between two readings, those that took most time first. */
export function requests(before: Metrics, after: Metrics, seconds: number): Requests[] {
  const name = "lumiline_http_request_duration_seconds";
  return (after.get(`${name}_count`) ?? [])
    .map(({ labels }) => {
      const count = grown(before, after, `${name}_count`, labels);
      const sum = grown(before, after, `${name}_sum`, labels);
      return { route: `${labels["method"]} ${labels["route"]}`, perSecond: count / seconds, meanMs: count ? (1000 * sum) / count : 0 };
    })
    .filter(({ perSecond }) => perSecond > 0)
    .sort((a, b) => b.perSecond * b.meanMs - a.perSecond * a.meanMs);
}
