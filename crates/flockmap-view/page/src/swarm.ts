// What is known of the robots: where they are, where they were, whom they hear, what they see.

import { robotColour } from "./colours";
import type { Counters, Link, Pose, Run, Scan } from "./feed";
import type { Connected, RobotName } from "./protocol";
import { GAP_MAX } from "./series";
import { Trail } from "./trail";

/** After so many seconds without a word a robot is shown as silent. */
export const SILENT = 3;

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
  trail: Trail;
  /** The submaps of its run, with which its trail moves. */
  run: Run | null;
  /** How far the trail was moved when a loop was closed last, in metres. */
  moved: number | null;
  /** The submaps of all runs, as its feed tells of them. */
  runs: Run[];
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
      trail: new Trail(),
      run: null,
      moved: null,
      runs: [],
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
      if (robot.pose && robot.pose.epoch !== pose.epoch) robot.trail.clear();
      const moved = !robot.pose || robot.pose.at.some((v, i) => v !== pose.at[i]);
      // A robot that stands still is as well known as one that moves: what counts is what it said last.
      robot.pose = pose;
      robot.poseAt = now - 1e3 * pose.age;
      if (moved) robot.trail.add(pose.at, robot.run?.epoch === pose.epoch ? robot.run.newest : 0);
    }
  }

  /** Submaps as `from` knows them: trails move with those of the newest runs. Of whom is as with poses. */
  submaps(from: number, runs: Run[]): void {
    const teller = this.byId.get(from);
    if (teller) teller.runs = runs;
    for (const robot of this.robots) {
      const run = newestOf(runs, robot.id);
      if (!run || (robot.id !== from && this.own.has(robot.id))) continue;
      const before = robot.run;
      robot.run = run;
      if (before?.epoch !== run.epoch) robot.moved = null;
      else robot.moved = robot.trail.move(before, run) || robot.moved;
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
      robot.trail.clear();
      robot.moved = null;
      robot.scan = null;
    }
  }

  /** Seconds since a robot was heard or seen, as far as it is known. */
  silence(robot: RobotState, now: number): number | null {
    const last = Math.max(this.own.has(robot.id) ? robot.heard : 0, robot.poseAt);
    return last === 0 ? null : (now - last) / 1e3;
  }
}

/** The run of a robot that began last: runs ascend. */
function newestOf(runs: Run[], robot: number): Run | undefined {
  return runs.filter((run) => run.robot === robot).at(-1);
}
