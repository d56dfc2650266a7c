// Colours of the voxels and the robots.

type Rgb = [number, number, number];

/** Blue low, orange high; lightness rises all the way, so that it also reads without colours. */
const HEIGHT = ["#27348b", "#2c63b0", "#3192b4", "#58b8a4", "#a3cf8f", "#e2d27d", "#f2b04f", "#ee7f2d"];
/** New, then older. */
const AGE = ["#f4733d", "#f2a24e", "#d9b98a", "#aeb3bd", "#8693ab"];
export const OLDER: Rgb = rgb("#77809a");
const ROBOTS = ["#d9480f", "#1467b8", "#2b8a58", "#b3366f", "#8a7412", "#6d54cc", "#1f8fae", "#8d5a3b"];

export const RAMP = 16;

export function rgb(hex: string): Rgb {
  const n = parseInt(hex.slice(1), 16);
  return [(n >> 16) / 255, ((n >> 8) & 255) / 255, (n & 255) / 255];
}

export function css([r, g, b]: Rgb): string {
  return `rgb(${Math.round(255 * r)} ${Math.round(255 * g)} ${Math.round(255 * b)})`;
}

/** `RAMP` colours of a ramp, each three numbers. */
export function ramp(kind: "height" | "age"): Float32Array {
  const stops = (kind === "height" ? HEIGHT : AGE).map(rgb);
  const out = new Float32Array(3 * RAMP);
  for (let i = 0; i < RAMP; i++) {
    const at = (i / (RAMP - 1)) * (stops.length - 1);
    const low = Math.min(Math.floor(at), stops.length - 2);
    for (let c = 0; c < 3; c++) out[3 * i + c] = stops[low]![c]! + (at - low) * (stops[low + 1]![c]! - stops[low]![c]!);
  }
  return out;
}

/** Colour of the robot at a place of the list. Eight are chosen to be told apart; further ones go round the hues. */
export function robotColour(place: number): Rgb {
  if (place < ROBOTS.length) return rgb(ROBOTS[place]!);
  const hue = (place * 137.508) % 360;
  const channel = (n: number) => {
    const k = (n + hue / 30) % 12;
    return 0.48 - 0.3 * Math.max(-1, Math.min(k - 3, 9 - k, 1));
  };
  return [channel(0), channel(8), channel(4)];
}
