// Bytes of each second: from /series/N, and from the counters after that.

import type { Counters } from "./feed";

const STEPS_MAX = 3_600;
/** IP and UDP. */
const HEADERS = 28;
/** A longer gap between two counters, in seconds, says nothing about single seconds. */
export const GAP_MAX = 10;

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

  /** Takes what the server knows. It replaces what was counted here for the same seconds. */
  load(json: SeriesJson): void {
    const step = Math.max(json.step_s, 1e-3);
    const columns = NAMES.map((name) => json.bytes[json.names.indexOf(name)] ?? []);
    const length = Math.max(0, ...columns.map((column) => column.length));
    for (let i = Math.max(0, length - STEPS_MAX); i < length; i++) {
      const [sent, received, paper, racer] = columns.map((column) => {
        const bytes = column[i];
        return typeof bytes === "number" ? bytes / step : null;
      });
      const second = Math.floor(json.begin_us / 1e6 + i * step);
      this.put(second, { sent: sent!, received: received!, paper: paper!, racer: racer! });
    }
  }

  /** Takes counters; gives bytes a second since the ones before. Undefined where those are too near; null where it is not known. */
  count(counters: Counters, append: boolean): { sent: number; received: number } | null | undefined {
    const value = (name: string) => counters.values.get(name);
    const bytes = (way: "in" | "out") => {
      const payload = value(`node_bytes_${way}`);
      return payload === undefined ? undefined : payload + HEADERS * (value(`node_datagrams_${way}`) ?? 0);
    };
    const [sent, received] = [bytes("out"), bytes("in")];
    if (sent === undefined || received === undefined) return null;
    const before = this.last;
    if (before && counters.time - before.time < 0.5 && counters.time >= before.time) return undefined;
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

  /** The newest second of which it is known; -Infinity if there is none. */
  newestOf(name: Name): number {
    for (let s = this.newest; s >= this.first; s--) if (this.at(s, name) !== null) return s;
    return -Infinity;
  }

  has(name: Name): boolean {
    for (const step of this.steps.values()) if (step[name] !== null) return true;
    return false;
  }

  private put(second: number, step: Step): void {
    this.newest = Math.max(this.newest, second);
    if (second <= this.newest - STEPS_MAX) return;
    this.steps.set(second, step);
    this.first = Math.min(this.first, second);
    if (this.steps.size <= STEPS_MAX) return;
    for (const old of this.steps.keys()) if (old <= this.newest - STEPS_MAX) this.steps.delete(old);
    this.first = this.newest - STEPS_MAX + 1;
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
