// The time of a recording that the page shows. Each of its connections has a player of its own in the server: all are told
// the same, and one that connects is brought to where the others are.

import type { Playback } from "./feed";

/** What is said to a player. Times are in seconds on the clock of the recording. */
export type Wish = { seek: number } | { play: boolean } | { speed: number };

/** So near to its end a recording is over. */
const OVER = 0.05;
/** For so many milliseconds after a jump what a player says of other times was said before it. */
const SETTLES = 1_000;
const NEAR = 0.5;

export class Present {
  private shown: Playback | null = null;
  private since = 0;
  private jumped = -Infinity;

  constructor(private readonly now: () => number) {}

  /** What the player of the chosen robot says. Gives whether that is the time that is shown. */
  hear(playback: Playback): boolean {
    const { shown } = this;
    const settled = this.now() - this.jumped > SETTLES;
    if (shown && !settled && Math.abs(playback.at - this.at(shown)) > NEAR * Math.max(1, shown.speed)) return false;
    this.set(playback);
    return true;
  }

  /** The messages for all players. */
  wish(wish: Wish): string[] {
    const { shown } = this;
    if (!shown) return [];
    const at = this.at(shown);
    if ("seek" in wish) return this.seek(wish.seek);
    this.set({ ...shown, at, ...("play" in wish ? { plays: wish.play } : wish) });
    if ("speed" in wish) return [JSON.stringify(wish)];
    // One may be at the end a moment before the others: so all are sent to the beginning.
    const again = wish.play && !shown.grows && at >= shown.end - OVER ? this.seek(shown.begin) : [];
    return [...again, JSON.stringify(wish)];
  }

  /** The messages for a player that begins: nothing before any time was shown. */
  words(): string[] {
    const { shown } = this;
    if (!shown) return [];
    return [JSON.stringify({ speed: shown.speed }), JSON.stringify({ play: shown.plays }), ...this.seek(this.at(shown))];
  }

  private seek(at: number): string[] {
    this.set({ ...this.shown!, at });
    this.jumped = this.now();
    return [JSON.stringify({ seek_us: Math.round(1e6 * at) })];
  }

  private set(playback: Playback): void {
    this.shown = playback;
    this.since = this.now();
  }

  private at(shown: Playback): number {
    const gone = shown.plays ? ((this.now() - this.since) / 1e3) * shown.speed : 0;
    return Math.min(shown.end, shown.at + gone);
  }
}
