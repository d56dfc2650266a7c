// What the page and its worker tell each other.

import type { Counters, Link, Playback, Pose, Run, Scan } from "./feed";
import type { Budget, Camera } from "./lod";
import type { Wish } from "./present";

export interface RobotName {
  id: number;
  name: string;
}

export type ToWorker =
  | { kind: "start"; feeds: string; query: string; live: boolean; robots: RobotName[] }
  | { kind: "choose"; robot: number; origins: boolean; scans: boolean }
  | { kind: "camera"; camera: Camera; budget: Budget }
  | { kind: "slice"; z: number | null }
  | { kind: "pause"; paused: boolean }
  | { kind: "playback"; wish: Wish }
  | { kind: "ask"; what: "blocks" | "faces"; ask: number };

/** What is known of a connection. `retry` is the time, by `Date.now()`, at which it is tried again. */
export type Connected =
  | { state: "connecting" }
  | { state: "open" }
  | { state: "waiting"; reason: string; retry: number }
  | { state: "over"; reason: string };

export interface MapState {
  robot: number;
  name: string;
  frame: string;
  /** Side of a voxel in metres. */
  voxel: number;
  upto: string;
  newest: string;
  /** When the map came to `newest`, in seconds on the clock of the feed. */
  stamp: number;
  complete: boolean;
  /** A new map is coming, and the one before is shown. */
  renewing: boolean;
  occupied: number;
  free: number;
  blocks: number;
  /** In voxels, low corner and high corner; null while nothing is occupied. */
  bounds: [number, number, number, number, number, number] | null;
  /** Places that are outermost in some direction, in voxels, three numbers each. */
  outline: number[];
  heights: [number, number] | null;
  pending: number;
  /** Bytes that the worker holds of the map. */
  bytes: number;
}

export interface MeshMessage {
  kind: "mesh";
  id: number;
  level: number;
  /** Low corner in voxels. */
  origin: [number, number, number];
  faces: number;
  words: Uint32Array<ArrayBuffer>;
}

export interface SliceMessage {
  kind: "slice";
  /** Low corner in voxels, voxels of a texel, size in texels; a texel is 0 unknown, 1 free, 2 occupied. */
  x: number;
  y: number;
  z: number;
  step: number;
  width: number;
  height: number;
  texels: Uint8Array<ArrayBuffer>;
}

export type FromWorker =
  | MeshMessage
  | SliceMessage
  | { kind: "show"; ids: number[]; drop: number[] }
  | { kind: "map"; map: MapState; clock: number }
  | { kind: "connected"; robot: number; connected: Connected }
  | { kind: "heard"; robot: number }
  | { kind: "poses"; robot: number; poses: Pose[] }
  | { kind: "submaps"; robot: number; runs: Run[] }
  | { kind: "counters"; robot: number; counters: Counters }
  | { kind: "links"; robot: number; links: Link[]; at: number }
  | { kind: "scan"; robot: number; scan: Scan }
  | { kind: "shown-playback"; playback: Playback }
  | { kind: "answer"; ask: number; value: unknown };
