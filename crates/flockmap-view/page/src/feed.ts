// The bytes of the feed (docs/map-output.md): frames out of pieces that are cut anywhere, and what is in each frame.

import type { Rigid } from "./rigid";

export const FRAME_MAX = 1 << 20;
export const WANT_ORIGINS = 1;
export const WANT_NO_MAP = 2;
export const WANT_LINKS = 4;
export const WANT_SCANS = 8;
export const WANT_SUBMAPS = 16;
/** Of one frame, of all runs together. */
const SUBMAP_POSES_MAX = 8_192;

/** What the reader has of a map. All three are 0 if it has nothing. */
export interface Have {
  feed: bigint;
  anew: bigint;
  upto: bigint;
}

export interface Hello {
  origins: boolean;
  goesOn: boolean;
  robot: number;
  micrometres: number;
  feed: bigint;
  name: string;
  frame: string;
}

/** A blocks frame. The blocks themselves are read from `body` one by one, by `readBlocks`. */
export interface BlocksHead {
  upto: bigint;
  newest: bigint;
  stamp: number;
  origins: boolean;
  count: number;
}

export interface Pose {
  robot: number;
  epoch: string;
  at: [number, number, number];
  turned: [number, number, number, number] | null;
  age: number;
}

export interface Counters {
  time: number;
  values: Map<string, number>;
}

export interface Link {
  robot: number;
  hears: boolean;
  /** Seconds, or null where it is not known. */
  roundTrip: number | null;
  lost: number;
  bytesIn: number;
  bytesOut: number;
  missing: number;
  unconfirmed: number;
  heardAge: number;
}

export interface Scan {
  stamp: number;
  at: [number, number, number];
  turned: [number, number, number, number];
  had: number;
  points: Float32Array;
}

/** The submaps of one run of a robot. */
export interface Run {
  robot: number;
  epoch: string;
  newest: number;
  /** Ascending. A submap that is not there lies as the one before it. */
  poses: SubmapPose[];
}

/** How a submap lies in the map that is fed. */
export interface SubmapPose extends Rigid {
  submap: number;
}

/** Times in seconds. */
export interface Playback {
  begin: number;
  end: number;
  at: number;
  speed: number;
  plays: boolean;
  grows: boolean;
}

/** Something in the feed is not as the document says. */
export class FeedError extends Error {}

export function helloBytes(flags: number, have: Have): Uint8Array {
  const bytes = new Uint8Array(35);
  const view = new DataView(bytes.buffer);
  view.setUint32(0, 31, true);
  bytes.set([1, 0x46, 0x4c, 0x4b, 0x4d, 1, flags], 4);
  view.setBigUint64(11, have.feed, true);
  view.setBigUint64(19, have.anew, true);
  view.setBigUint64(27, have.upto, true);
  return bytes;
}

/** Takes pieces of the stream and gives whole frames. Holds less than one frame. */
export class Splitter {
  private held: Uint8Array = new Uint8Array(0);

  push(piece: Uint8Array, frame: (kind: number, body: Uint8Array) => void): void {
    let data = piece;
    if (this.held.length > 0) {
      data = new Uint8Array(this.held.length + piece.length);
      data.set(this.held);
      data.set(piece, this.held.length);
    }
    const view = new DataView(data.buffer, data.byteOffset, data.length);
    let from = 0;
    while (data.length - from >= 4) {
      const length = view.getUint32(from, true);
      if (length < 1 || length > FRAME_MAX) throw new FeedError(`a frame of ${length} bytes`);
      if (data.length - from - 4 < length) break;
      frame(data[from + 4]!, data.subarray(from + 5, from + 4 + length));
      from += 4 + length;
    }
    this.held = data.slice(from);
  }
}

/** Reads a body from its beginning. Every read past the end is an error. */
class Reader {
  private readonly view: DataView;
  private at = 0;

  constructor(private readonly body: Uint8Array) {
    this.view = new DataView(body.buffer, body.byteOffset, body.length);
  }

  get left(): number {
    return this.body.length - this.at;
  }

  take(bytes: number): number {
    if (this.left < bytes) throw new FeedError("a frame is too short");
    this.at += bytes;
    return this.at - bytes;
  }

  u8 = () => this.view.getUint8(this.take(1));
  u16 = () => this.view.getUint16(this.take(2), true);
  u32 = () => this.view.getUint32(this.take(4), true);
  i32 = () => this.view.getInt32(this.take(4), true);
  u64 = () => this.view.getBigUint64(this.take(8), true);
  /** For what stays far below 2^53: bytes, packages, microseconds. */
  count = () => Number(this.u64());
  f32 = () => this.view.getFloat32(this.take(4), true);
  f64 = () => finite(this.view.getFloat64(this.take(8), true));
  seconds = () => Number(this.view.getBigInt64(this.take(8), true)) / 1e6;
  vector = (): [number, number, number] => [this.f64(), this.f64(), this.f64()];
  quaternion = (): [number, number, number, number] => [this.f64(), this.f64(), this.f64(), this.f64()];

  bytes(length: number): Uint8Array {
    const from = this.take(length);
    return this.body.subarray(from, from + length);
  }

  text(): string {
    return new TextDecoder().decode(this.bytes(this.u8()));
  }
}

function finite(value: number): number {
  if (!Number.isFinite(value)) throw new FeedError("a number that is not finite");
  return value;
}

export function readHello(body: Uint8Array): Hello {
  const r = new Reader(body);
  const magic = new TextDecoder().decode(r.bytes(4));
  const version = r.u8();
  if (magic !== "FLKM" || version !== 1) throw new FeedError("not a feed of version 1");
  const flags = r.u8();
  const robot = r.u16();
  const micrometres = r.u32();
  if (micrometres < 1_000 || micrometres > 100_000_000) throw new FeedError("voxels of no possible side");
  const feed = r.u64();
  if (feed === 0n) throw new FeedError("a feed without an id");
  return { origins: (flags & 1) !== 0, goesOn: (flags & 2) !== 0, robot, micrometres, feed, name: r.text(), frame: r.text() };
}

export function readAnew(body: Uint8Array): bigint {
  return new Reader(body).u64();
}

/** One block of a blocks frame. The arrays are views of the frame, and good until the call returns. */
export interface BlockBytes {
  x: number;
  y: number;
  z: number;
  /** 64 bytes of Free, 64 bytes of Occupied; byte 8·z + y, bit x. */
  planes: Uint8Array;
  robots: number[];
  /** The 64 bytes of each of `robots`, if there are two or more. */
  shares: Uint8Array[];
}

/**
 * Reads a blocks frame. `begin` sees its head; then each block, if `begin` says so. The frame is checked as a whole before
 * that, so that of a damaged one nothing is taken.
 */
export function readBlocks(body: Uint8Array, begin: (head: BlocksHead) => boolean, each: (block: BlockBytes) => void): void {
  const r = new Reader(body);
  const head: BlocksHead = {
    upto: r.u64(),
    newest: r.u64(),
    stamp: r.seconds(),
    origins: (r.u8() & 1) !== 0,
    count: r.u32(),
  };
  if (head.newest < head.upto) throw new FeedError("blocks newer than the newest");
  const blocks: BlockBytes[] = [];
  for (let i = 0; i < head.count; i++) {
    const block: BlockBytes = { x: r.i32(), y: r.i32(), z: r.i32(), planes: r.bytes(128), robots: [], shares: [] };
    for (const index of [block.x, block.y, block.z]) {
      if (Math.abs(index) > 1 << 25) throw new FeedError("a block outside of every map");
    }
    for (let byte = 0; byte < 64; byte++) {
      if ((block.planes[byte]! & block.planes[64 + byte]!) !== 0) throw new FeedError("a voxel that is Free and Occupied");
    }
    if (head.origins) readOrigins(r, block);
    blocks.push(block);
  }
  if (begin(head)) blocks.forEach(each);
}

function readOrigins(r: Reader, block: BlockBytes): void {
  const count = r.u16();
  if (count > 512) throw new FeedError("a block of more than 512 robots");
  for (let i = 0; i < count; i++) {
    block.robots.push(r.u16());
    if (count > 1) block.shares.push(r.bytes(64));
  }
}

export function readPoses(body: Uint8Array): Pose[] {
  const r = new Reader(body);
  return Array.from({ length: r.u16() }, () => {
    const robot = r.u16();
    const epoch = r.u64().toString();
    const at = r.vector();
    const known = r.u8() === 1;
    const turned = r.quaternion();
    return { robot, epoch, at, turned: known ? turned : null, age: r.count() / 1e6 };
  });
}

export function readCounters(body: Uint8Array): Counters {
  const r = new Reader(body);
  const time = r.seconds();
  const values = new Map<string, number>();
  for (let left = r.u16(); left > 0; left--) values.set(r.text(), r.count());
  return { time, values };
}

export function readLinks(body: Uint8Array): Link[] {
  const r = new Reader(body);
  return Array.from({ length: r.u16() }, () => {
    const robot = r.u16();
    r.u64();
    const flags = r.u8();
    const roundTrip = r.u32() / 1e6;
    return {
      robot,
      hears: (flags & 1) !== 0,
      roundTrip: (flags & 2) !== 0 ? roundTrip : null,
      lost: r.u32() / 65_536,
      bytesIn: r.count(),
      bytesOut: r.count(),
      missing: r.u32(),
      unconfirmed: r.u32(),
      heardAge: r.count() / 1e6,
    };
  });
}

export function readScan(body: Uint8Array): Scan {
  const r = new Reader(body);
  const stamp = r.seconds();
  const at = r.vector();
  const turned = r.quaternion();
  const had = r.u32();
  const count = r.u32();
  if (count > 2_048) throw new FeedError("a scan of more than 2,048 points");
  const points = Float32Array.from({ length: count * 3 }, () => r.f32());
  return { stamp, at, turned, had, points };
}

export function readSubmaps(body: Uint8Array): Run[] {
  const r = new Reader(body);
  let room = SUBMAP_POSES_MAX;
  return Array.from({ length: r.u16() }, () => {
    const [robot, epoch, newest] = [r.u16(), r.u64().toString(), r.u16()];
    r.u16();
    const count = r.u16();
    room -= count;
    if (room < 0) throw new FeedError(`more than ${SUBMAP_POSES_MAX} submaps`);
    const poses = Array.from({ length: count }, (): SubmapPose => {
      const pose = { submap: r.u16(), at: r.vector(), turned: r.quaternion() };
      if (Math.abs(Math.hypot(...pose.turned) - 1) > 1e-3) throw new FeedError("a rotation that is none");
      return pose;
    });
    return { robot, epoch, newest, poses };
  });
}

export function readPlayback(body: Uint8Array): Playback {
  const r = new Reader(body);
  const [begin, end, at, speed, flags] = [r.seconds(), r.seconds(), r.seconds(), r.f32(), r.u8()];
  return { begin, end, at, speed, plays: (flags & 1) !== 0, grows: (flags & 2) !== 0 };
}

export function readEnd(body: Uint8Array): string {
  return new TextDecoder().decode(body);
}
