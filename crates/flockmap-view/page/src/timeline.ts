// The chart of bytes over time, drawn when something changed.

import { clockTime, rate } from "./format";
import { Series, sum, type Name } from "./series";

/** While live, so many seconds are shown at most. */
const WINDOW = 600;
const WINDOW_MIN = 60;
/** A value that is older than so many seconds is not the one of now. */
const STALE = 12;

interface Curve {
  label: string;
  colour: string;
  width: number;
  at: (second: number) => number | null;
  /** The newest second of which it is known. */
  newest: () => number;
}

export interface TimelineState {
  series: Map<number, Series>;
  chosen: number;
  chosenName: string;
  /** Seconds on the clock of the feed: all of a recording, and where it is. */
  playback: { begin: number; end: number; at: number } | null;
  log: boolean;
}

export class Timeline {
  private hover: number | null = null;
  private keys = "";

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly keysAt: HTMLElement,
    again: () => void,
  ) {
    canvas.addEventListener("pointermove", (event) => {
      const box = canvas.getBoundingClientRect();
      this.hover = (event.clientX - box.left) / box.width;
      again();
    });
    canvas.addEventListener("pointerleave", () => {
      this.hover = null;
      again();
    });
  }

  draw(state: TimelineState): void {
    const { canvas } = this;
    const ratio = Math.min(devicePixelRatio, 2);
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (w === 0 || h === 0) return;
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    const g = canvas.getContext("2d")!;
    g.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement);
    const colour = (name: string) => style.getPropertyValue(name).trim();
    const em = parseFloat(style.fontSize);
    const all = [...state.series.values()];
    const own = state.series.get(state.chosen);
    const curves: Curve[] = [];
    const newestOf = (list: Series[], name: Name) => () => Math.max(-Infinity, ...list.map((s) => s.newestOf(name)));
    if (all.some((s) => s.has("racer"))) curves.push({ label: "RACER", colour: colour("--racer"), width: 1.3, at: (t) => sum(all, t, "racer"), newest: newestOf(all, "racer") });
    if (all.some((s) => s.has("paper"))) curves.push({ label: "paper’s method", colour: colour("--paper"), width: 1.3, at: (t) => sum(all, t, "paper"), newest: newestOf(all, "paper") });
    if (all.length > 1 && own) curves.push({ label: `${state.chosenName} alone`, colour: colour("--own"), width: 1.1, at: (t) => own.at(t, "sent"), newest: newestOf([own], "sent") });
    curves.push({ label: all.length > 1 ? "all robots send" : "sent", colour: colour("--sum"), width: 1.9, at: (t) => sum(all, t, "sent"), newest: newestOf(all, "sent") });

    const newest = Math.max(...all.map((s) => s.newest), -Infinity);
    const first = Math.min(...all.map((s) => s.first), Infinity);
    const known = Number.isFinite(newest);
    const to = state.playback ? Math.max(state.playback.end, state.playback.begin + 1) : known ? newest + 1 : 1;
    const from = state.playback ? state.playback.begin : Math.min(Math.max(known ? first : 0, to - WINDOW), to - WINDOW_MIN);
    const gutter = 3.9 * em;
    const x = (t: number) => gutter + ((t - from) / (to - from)) * (w - gutter - 2);

    // As many points as there is room for: of several seconds in a pixel, the mean.
    const stride = Math.max(1, Math.ceil((to - from) / Math.max(w - gutter, 1)));
    let most = 0;
    let least = Infinity;
    const points = curves.map((curve) => {
      const line: [number, number | null][] = [];
      for (let t = Math.floor(from); t < to; t += stride) {
        let [total, n] = [0, 0];
        for (let s = t; s < t + stride; s++) {
          const bytes = curve.at(s);
          if (bytes !== null) [total, n] = [total + bytes, n + 1];
        }
        const mean = n > 0 ? total / n : null;
        if (mean !== null) {
          most = Math.max(most, mean);
          if (mean > 0) least = Math.min(least, mean);
        }
        line.push([t + stride / 2, mean]);
      }
      return line;
    });
    const top = nice(Math.max(most, 100));
    const bottom = state.log ? 10 ** Math.floor(Math.log10(Math.max(Math.min(least, top / 10), 100))) : 0;
    const [y0, y1] = [h - 1.25 * em, 0.4 * em];
    const y = (bytes: number) => {
      const part = state.log ? Math.log(Math.max(bytes, bottom) / bottom) / Math.log(top / bottom) : bytes / top;
      return y0 + (y1 - y0) * part;
    };

    g.font = `${0.74 * em}px system-ui, sans-serif`;
    g.textBaseline = "middle";
    g.fillStyle = colour("--soft");
    g.strokeStyle = colour("--rule");
    g.lineWidth = 1;
    g.textAlign = "right";
    for (const bytes of state.log ? decades(bottom, top, Math.floor((y0 - y1) / (1.2 * em))) : [0, top / 2, top]) {
      g.beginPath();
      g.moveTo(gutter, Math.round(y(bytes)) + 0.5);
      g.lineTo(w, Math.round(y(bytes)) + 0.5);
      g.stroke();
      g.fillText(tick(bytes), gutter - 0.4 * em, y(bytes));
    }
    g.textBaseline = "alphabetic";
    const step = [5, 10, 30, 60, 120, 300, 600, 1_200, 3_600].find((s) => ((to - from) / s) * 4 * em < w - gutter) ?? 7_200;
    const zero = state.playback ? from : to;
    for (let s = 0; s <= to - from; s += step) {
      const t = state.playback ? zero + s : zero - s;
      const label = state.playback ? clockTime(s) : s === 0 ? "now" : `−${clockTime(s)}`;
      g.textAlign = x(t) > w - 2 * em ? "right" : x(t) < gutter + em ? "left" : "center";
      g.fillText(label, Math.min(x(t), w - 1), h - 0.15 * em);
    }
    curves.forEach((curve, i) => this.stroke(g, curve, points[i]!, x, y));
    if (!known) {
      g.textAlign = "center";
      g.fillStyle = colour("--soft");
      g.fillText("no bytes are known yet", gutter + (w - gutter) / 2, (y0 + y1) / 2);
    }
    const at = this.hover !== null ? from + ((this.hover * w - gutter) / (w - gutter - 2)) * (to - from) : state.playback?.at;
    for (const [t, name] of [[state.playback?.at, "--accent"], [this.hover === null ? undefined : at, "--soft"]] as const) {
      if (t === undefined || t < from || t > to) continue;
      g.strokeStyle = colour(name);
      g.lineWidth = 1.5;
      g.beginPath();
      g.moveTo(x(t), y1);
      g.lineTo(x(t), y0);
      g.stroke();
    }
    this.tell(curves, at === undefined ? null : Math.floor(at), newest, this.hover !== null);
  }

  private stroke(g: CanvasRenderingContext2D, curve: Curve, line: [number, number | null][], x: (t: number) => number, y: (b: number) => number): void {
    g.strokeStyle = curve.colour;
    g.lineWidth = curve.width;
    g.lineJoin = "round";
    g.beginPath();
    let pen = false;
    for (const [t, bytes] of line) {
      if (bytes !== null) {
        if (pen) g.lineTo(x(t), y(bytes));
        else g.moveTo(x(t), y(bytes));
      }
      pen = bytes !== null;
    }
    g.stroke();
  }

  /** The names of the curves, and their values at a second; without one, the newest that is known of each. */
  private tell(curves: Curve[], second: number | null, newest: number, pointed: boolean): void {
    const texts = [...curves].reverse().map((curve) => {
      const at = second ?? curve.newest();
      // The newest second of a recording may not be over yet.
      const live = second === null;
      const bytes = live && at <= newest - STALE ? null : curve.at(at);
      return { ...curve, value: rate(bytes ?? (live || pointed ? null : curve.at(at - 1))) };
    });
    const key = texts.map((t) => `${t.label} ${t.value} ${t.colour}`).join();
    if (key === this.keys) return;
    this.keys = key;
    this.keysAt.replaceChildren(
      ...texts.map((t) => {
        const span = document.createElement("span");
        span.style.setProperty("--c", t.colour);
        const value = document.createElement("b");
        value.textContent = t.value;
        span.append(t.label, value);
        return span;
      }),
    );
  }
}

/** The next of 1, 2, 5 times a power of ten. */
function nice(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].find((n) => n * power >= value)! * power;
}

/** Powers of ten, not more than there is room for. */
function decades(bottom: number, top: number, most: number): number[] {
  const list: number[] = [];
  for (let at = bottom; at <= top * 1.001; at *= 10) list.push(at);
  const stride = Math.ceil(list.length / Math.max(most, 1));
  return list.filter((_, i) => (list.length - 1 - i) % stride === 0);
}

function tick(bytes: number): string {
  const kb = bytes / 1e3;
  if (kb >= 1e3) return `${+(kb / 1e3).toFixed(1)} MB/s`;
  return kb === 0 ? "0 KB/s" : `${kb >= 1 ? kb.toFixed(0) : kb.toPrecision(1)} KB/s`;
}
