// Bytes of each second: from /series/N, and from the counters after that.

import type { Counters } from "./feed";

const STEPS_MAX = 3_600;
/** IP and UDP. */
const HEADERS = 28;
/** A longer gap between two counters says nothing about single seconds. */
const GAP_MAX = 10;

export type Name = "sent" | "received" | "paper" | "racer";
const NAMES: readonly Name[] = ["sent", "received", "paper", "racer"];
type Step = Record<Name, number | null>;

export interface SeriesJson {
  begin_us: number;
  step_s: number;
  names: string[];
  bytes: (number | null)[][];
}

export class Series {
  /** Bytes a second, by the second of the feed's clock. */
  private steps = new Map<number, Step>();
  private last: { time: number; sent: number; received: number } | null = null;
  first = Infinity;
  newest = -Infinity;

  load(json: SeriesJson): void {
    this.steps.clear();
    const step = Math.max(json.step_s, 1e-3);
    json.bytes.slice(-STEPS_MAX).forEach((row, i) => {
      const skipped = Math.max(0, json.bytes.length - STEPS_MAX);
      const value = (name: Name) => {
        const bytes = row[json.names.indexOf(name)];
        return typeof bytes === "number" ? bytes / step : null;
      };
      const second = Math.floor(json.begin_us / 1e6 + (i + skipped) * step);
      this.put(second, { sent: value("sent"), received: value("received"), paper: value("paper"), racer: value("racer") });
    });
  }

  /** Takes counters; gives bytes a second since the ones before. */
  count(counters: Counters, append: boolean): { sent: number; received: number } | null {
    const value = (name: string) => counters.values.get(name);
    const bytes = (way: "in" | "out") => {
      const payload = value(`node_bytes_${way}`);
      return payload === undefined ? undefined : payload + HEADERS * (value(`node_datagrams_${way}`) ?? 0);
    };
    const [sent, received] = [bytes("out"), bytes("in")];
    if (sent === undefined || received === undefined) return null;
    const before = this.last;
    if (before && counters.time - before.time < 0.5 && counters.time >= before.time) return null;
    this.last = { time: counters.time, sent, received };
    const dt = before ? counters.time - before.time : 0;
    if (!before || dt <= 0 || dt > GAP_MAX || sent < before.sent || received < before.received) return null;
    const rates = { sent: (sent - before.sent) / dt, received: (received - before.received) / dt };
    const [from, to] = [Math.floor(before.time), Math.floor(counters.time)];
    if (append) {
      for (let s = from; s < to; s++) if (!this.steps.has(s)) this.put(s, { ...rates, paper: null, racer: null });
    }
    return rates;
  }

  at(second: number, name: Name): number | null {
    return this.steps.get(second)?.[name] ?? null;
  }

  has(name: Name): boolean {
    for (const step of this.steps.values()) if (step[name] !== null) return true;
    return false;
  }

  private put(second: number, step: Step): void {
    this.steps.set(second, step);
    if (this.steps.size > STEPS_MAX) {
      this.steps.delete(this.steps.keys().next().value!);
      this.first = this.steps.keys().next().value!;
    }
    this.first = Math.min(this.first, second);
    this.newest = Math.max(this.newest, second);
  }
}

/** The sum over robots; null where it is known of none. */
export function sum(all: Iterable<Series>, second: number, name: Name): number | null {
  let total: number | null = null;
  for (const series of all) {
    const bytes = series.at(second, name);
    if (bytes !== null) total = (total ?? 0) + bytes;
  }
  return total;
}

export function isSeries(json: unknown): json is SeriesJson {
  const s = json as SeriesJson;
  return (
    typeof s?.begin_us === "number" && typeof s.step_s === "number" && Array.isArray(s.names) && Array.isArray(s.bytes) &&
    s.bytes.every(Array.isArray) && s.names.some((name) => (NAMES as readonly string[]).includes(name))
  );
}
