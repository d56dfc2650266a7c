// Keeps the feeds of a recording at one time. Each connection is played on its own: a new one begins at the beginning.

import type { Playback } from "./feed";

/** Seconds, of the recording at its speed, by which a feed may be apart from the others. */
const APART = 0.6;
/** Milliseconds after a command in which what a feed says may still be from before it. */
const SETTLES = 700;

export interface Command {
  /** Seconds on the clock of the recording. */
  seek?: number;
  play?: boolean;
  speed?: number;
}

/** The text messages of docs/view.md. */
export function texts(command: Command): string[] {
  const list: object[] = [];
  if (command.seek !== undefined) list.push({ seek_us: Math.round(command.seek * 1e6) });
  if (command.speed !== undefined) list.push({ speed: command.speed });
  if (command.play !== undefined) list.push({ play: command.play });
  return list.map((part) => JSON.stringify(part));
}

export class Playhead {
  /** Where all should be, and since when by the clock of the worker. */
  private head: { at: number; plays: boolean; speed: number; end: number; since: number } | null = null;
  /** Until when the word of a feed is not believed. */
  private readonly settles = new Map<number, number>();

  /** The user asks for something: all feeds will be told. */
  command(command: Command, feeds: Iterable<number>, now: number): void {
    if (!this.head) return;
    this.head = { ...this.head, at: this.at(now), since: now };
    if (command.seek !== undefined) this.head.at = command.seek;
    if (command.play !== undefined) this.head.plays = command.play;
    if (command.speed !== undefined) this.head.speed = command.speed;
    for (const feed of feeds) this.settles.set(feed, now + SETTLES);
  }

  /** A connection is new: the first thing that it says is no more than where recordings begin. */
  opened(feed: number): void {
    this.settles.delete(feed);
  }

  /** What a feed says of its time. `leads`: where it is the others should be. Gives what it must be told to be in step. */
  hear(feed: number, leads: boolean, said: Playback, now: number): Command | null {
    const until = this.settles.get(feed);
    if (until !== undefined && now < until) return null;
    const first = until === undefined;
    if (!this.head || (leads && !first)) {
      this.head = { at: said.at, plays: said.plays, speed: said.speed, end: said.end, since: now };
      this.settles.set(feed, now);
      return null;
    }
    this.settles.set(feed, now + SETTLES);
    const { plays, speed } = this.head;
    const at = this.at(now);
    const apart = Math.abs(said.at - at) > APART * Math.max(1, speed);
    if (!apart && said.plays === plays && said.speed === speed) return null;
    return { seek: at, speed, play: plays };
  }

  private at(now: number): number {
    const { at, plays, speed, end, since } = this.head!;
    return plays ? Math.min(end, at + (speed * (now - since)) / 1e3) : at;
  }
}
