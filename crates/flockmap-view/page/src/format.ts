// Numbers in words. What is not known is a dash.

export const UNKNOWN = "–";

export function count(n: number | null | undefined): string {
  if (n == null) return UNKNOWN;
  if (n < 10_000) return n.toLocaleString("en");
  if (n < 1e6) return `${(n / 1e3).toFixed(n < 1e5 ? 1 : 0)} k`;
  return `${(n / 1e6).toFixed(2)} M`;
}

/** Bytes of a second as KB/s, of 1,000 bytes. */
export function rate(bytes: number | null | undefined): string {
  if (bytes == null) return UNKNOWN;
  const kb = bytes / 1e3;
  return `${kb < 10 ? kb.toFixed(1) : kb.toFixed(0)} KB/s`;
}

export function seconds(s: number | null | undefined): string {
  if (s == null || !Number.isFinite(s)) return UNKNOWN;
  if (s < 0.95) return "now";
  if (s < 90) return `${Math.round(s)} s`;
  if (s < 5_400) return `${Math.round(s / 60)} min`;
  return `${(s / 3_600).toFixed(1)} h`;
}

export function metres(m: number): string {
  return `${m.toFixed(Math.abs(m) < 100 ? 1 : 0)} m`;
}

/** Minutes and seconds from the beginning of a recording. */
export function clockTime(s: number): string {
  const whole = Math.max(0, Math.floor(s + 0.05));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

export function share(part: number | null | undefined): string {
  return part == null ? UNKNOWN : `${(100 * part).toFixed(0)} %`;
}
