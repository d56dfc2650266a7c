// What is known of the robots: where they are, where they were, whom they hear, what they see.

import { robotColour } from "./colours";
import type { Counters, Link, Pose, Scan } from "./feed";
import type { Connected, RobotName } from "./protocol";
import { GAP_MAX } from "./series";

/** After so many seconds without a word a robot is shown as silent. */
export const SILENT = 3;
export const TRAIL_MAX = 1_500;
const TRAIL_STEP = 0.15;

export interface LinkState extends Link {
  /** Bytes of a second, null before there were two reports. */
  rateIn: number | null;
  rateOut: number | null;
  /** When it was so, in seconds on the clock of what is shown. */
  at: number;
}

export interface RobotState {
  id: number;
  name: string;
  colour: [number, number, number];
  connected: Connected;
  /** `Date.now()` of its last frame; 0: never. */
  heard: number;
  pose: Pose | null;
  /** `Date.now()` at which the pose was true. */
  poseAt: number;
  trail: number[];
  links: Map<number, LinkState>;
  scan: Scan | null;
  counters: Counters | null;
  /** Bytes on the wire of the last second. */
  rateOut: number | null;
  rateIn: number | null;
}

export class Swarm {
  readonly robots: RobotState[];
  private readonly byId: Map<number, RobotState>;
  private readonly own = new Set<number>();

  constructor(names: RobotName[]) {
    this.robots = names.map(({ id, name }, place) => ({
      id,
      name,
      colour: robotColour(place),
      connected: { state: "connecting" },
      heard: 0,
      pose: null,
      poseAt: 0,
      trail: [],
      links: new Map(),
      scan: null,
      counters: null,
      rateOut: null,
      rateIn: null,
    }));
    this.byId = new Map(this.robots.map((robot) => [robot.id, robot]));
  }

  get(id: number): RobotState | undefined {
    return this.byId.get(id);
  }

  /** Poses as `from` knows them. Of a robot whose own feed is there only that one counts. */
  poses(from: number, poses: Pose[]): void {
    const now = Date.now();
    for (const pose of poses) {
      const robot = this.byId.get(pose.robot);
      if (!robot || (pose.robot !== from && this.own.has(pose.robot))) continue;
      if (pose.robot === from) this.own.add(from);
      if (robot.pose && robot.pose.epoch !== pose.epoch) robot.trail = [];
      const moved = !robot.pose || robot.pose.at.some((v, i) => v !== pose.at[i]);
      // A robot that stands still is as well known as one that moves: what counts is what it said last.
      robot.pose = pose;
      robot.poseAt = now - 1e3 * pose.age;
      if (moved) extend(robot.trail, pose.at);
    }
  }

  /** Links of a robot at a time, in seconds on the clock of what is shown. */
  links(from: number, links: Link[], now: number): void {
    const robot = this.byId.get(from);
    if (!robot) return;
    const next = new Map<number, LinkState>();
    for (const link of links) {
      const before = robot.links.get(link.robot);
      const dt = now - (before?.at ?? NaN);
      const rate = (a: number, b: number | undefined) => (b !== undefined && dt >= 0.2 && dt <= GAP_MAX && a >= b ? (a - b) / dt : null);
      next.set(link.robot, { ...link, at: now, rateIn: rate(link.bytesIn, before?.bytesIn), rateOut: rate(link.bytesOut, before?.bytesOut) });
    }
    robot.links = next;
  }

  /** Time went back, or a long way: what was between is not a way that was flown. */
  jump(): void {
    this.own.clear();
    for (const robot of this.robots) {
      robot.trail = [];
      robot.scan = null;
    }
  }

  /** Seconds since a robot was heard or seen, as far as it is known. */
  silence(robot: RobotState, now: number): number | null {
    const last = Math.max(this.own.has(robot.id) ? robot.heard : 0, robot.poseAt);
    return last === 0 ? null : (now - last) / 1e3;
  }
}

/** Adds a point; when there are too many, every second one of the older half goes. */
function extend(trail: number[], [x, y, z]: [number, number, number]): void {
  const n = trail.length;
  if (n > 0 && Math.hypot(trail[n - 3]! - x, trail[n - 2]! - y, trail[n - 1]! - z) < TRAIL_STEP) return;
  trail.push(x, y, z);
  if (trail.length <= 3 * TRAIL_MAX) return;
  let to = 0;
  const half = 3 * Math.floor(TRAIL_MAX / 2);
  for (let from = 0; from < trail.length; from += 3) {
    if (from < half && (from / 3) % 2 === 1) continue;
    for (let c = 0; c < 3; c++) trail[to + c] = trail[from + c]!;
    to += 3;
  }
  trail.length = to;
}
