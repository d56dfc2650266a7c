// The way of a robot, as far as it was seen. It lies in the submaps in which it was flown, and moves with them.

import type { Run, SubmapPose } from "./feed";
import { apply, unapply, type Vector } from "./rigid";

export const TRAIL_MAX = 1_500;
const TRAIL_STEP = 0.15;

export class Trail {
  /** Three numbers for each point, in the map as it is now. */
  readonly points: number[] = [];
  /** The submap of each point. */
  private readonly submaps: number[] = [];

  clear(): void {
    this.points.length = this.submaps.length = 0;
  }

  /** Adds a point; when there are too many, every second one of the older half goes. */
  add([x, y, z]: Vector, submap: number): void {
    const { points, submaps } = this;
    const n = points.length;
    if (n > 0 && Math.hypot(points[n - 3]! - x, points[n - 2]! - y, points[n - 1]! - z) < TRAIL_STEP) return;
    points.push(x, y, z);
    submaps.push(submap);
    if (submaps.length <= TRAIL_MAX) return;
    let to = 0;
    const half = Math.floor(TRAIL_MAX / 2);
    for (let from = 0; from < submaps.length; from++) {
      if (from < half && from % 2 === 1) continue;
      for (let c = 0; c < 3; c++) points[3 * to + c] = points[3 * from + c]!;
      submaps[to++] = submaps[from]!;
    }
    submaps.length = to;
    points.length = 3 * to;
  }

  /** The submaps lie otherwise now. Says how far the way was moved at most, in metres. */
  move(before: Run, now: Run): number {
    // As a rule one has begun, and lies as the one before it.
    if (before.poses.length === now.poses.length && before.poses.every((pose, i) => pose.submap === now.poses[i]!.submap && same(pose, now.poses[i]!))) return 0;
    let far = 0;
    for (const [i, submap] of this.submaps.entries()) {
      const [was, is] = [poseOf(before, submap), poseOf(now, submap)];
      if (!was || !is || same(was, is)) continue;
      const old = this.points.slice(3 * i, 3 * i + 3) as Vector;
      const at = apply(is, unapply(was, old));
      for (let c = 0; c < 3; c++) this.points[3 * i + c] = at[c]!;
      far = Math.max(far, Math.hypot(at[0] - old[0], at[1] - old[1], at[2] - old[2]));
    }
    return far;
  }
}

/** How a submap of a run lies, if that was told. */
export function poseOf({ poses }: Run, submap: number): SubmapPose | undefined {
  let [low, high] = [0, poses.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (poses[middle]!.submap <= submap) low = middle + 1;
    else high = middle;
  }
  return poses[low - 1];
}

function same(a: SubmapPose, b: SubmapPose): boolean {
  return a.at.every((v, i) => v === b.at[i]) && a.turned.every((v, i) => v === b.turned[i]);
}
