// One feed over a WebSocket: says hello, gives frames, and connects again when it breaks, with growing pauses.

import { FeedError, helloBytes, readEnd, Splitter, type Have } from "./feed";
import type { Connected } from "./protocol";

const PAUSE_MIN = 1_000;
const PAUSE_MAX = 15_000;
/** The feed sends something each second; a reader that hears nothing for so long connects again. */
const SILENCE = 10_000;

export interface FeedReader {
  flags(): number;
  have(): Have;
  frame(kind: number, body: Uint8Array): void;
  state(connected: Connected): void;
  /** Whether silence means that something is wrong. */
  talks(): boolean;
}

/** The reader cannot go on, and connecting again would not help. */
export class Refused extends Error {}

export class Connection {
  private socket: WebSocket | null = null;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private watch: ReturnType<typeof setInterval> | undefined;
  private pause = PAUSE_MIN;
  private last = 0;

  constructor(private readonly url: string, private readonly reader: FeedReader) {
    this.open();
  }

  close(): void {
    clearTimeout(this.timer);
    this.drop();
  }

  /** Connects again at once, for another hello. */
  renew(): void {
    this.close();
    this.open();
  }

  say(text: string): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(text);
  }

  private open(): void {
    this.reader.state({ state: "connecting" });
    const socket = new WebSocket(this.url);
    const splitter = new Splitter();
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.last = performance.now();
    this.watch = setInterval(() => {
      if (this.reader.talks() && performance.now() - this.last > SILENCE) this.lost("nothing was heard for 10 s");
    }, 1_000);
    let reason = "the connection broke";
    socket.onopen = () => {
      // A player hears which time it should show before it is asked for anything.
      this.reader.state({ state: "open" });
      socket.send(helloBytes(this.reader.flags(), this.reader.have()) as Uint8Array<ArrayBuffer>);
    };
    socket.onmessage = (event) => {
      this.last = performance.now();
      if (!(event.data instanceof ArrayBuffer)) return;
      try {
        splitter.push(new Uint8Array(event.data), (kind, body) => {
          if (kind === 6) reason = readEnd(body) || "the node ended the feed";
          else this.reader.frame(kind, body);
          // A feed that gives something is a good one: the next pause is short again.
          if (kind !== 6) this.pause = PAUSE_MIN;
        });
      } catch (error) {
        if (error instanceof Refused) {
          this.drop();
          this.reader.state({ state: "over", reason: error.message });
        } else if (error instanceof FeedError || error instanceof RangeError) {
          this.lost(`the feed is damaged: ${error instanceof FeedError ? error.message : "a frame is too short"}`);
        } else {
          throw error;
        }
      }
    };
    socket.onclose = () => this.lost(reason);
  }

  private drop(): void {
    clearInterval(this.watch);
    const socket = this.socket;
    this.socket = null;
    if (!socket) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
  }

  private lost(reason: string): void {
    this.drop();
    this.reader.state({ state: "waiting", reason, retry: Date.now() + this.pause });
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.open(), this.pause);
    this.pause = Math.min(PAUSE_MAX, this.pause * 1.6);
  }
}
