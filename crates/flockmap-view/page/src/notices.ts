// What the page does not know, in words: the state in the bar, and notices over the scene.

import { byId, make, write } from "./dom";
import { seconds } from "./format";
import type { Connected, MapState } from "./protocol";

export interface Known {
  connected: Connected;
  live: boolean;
  paused: boolean;
  /** Seconds since the chosen feed was heard, null: never. */
  silence: number | null;
  /** Seconds for which the map has been behind its newest state. */
  behind: number;
  map: MapState | null;
  playback: { plays: boolean; begin: number; end: number } | null;
  frozenAt: number;
}

type Level = "good" | "notice" | "failure" | "info";

const LATE = 3;

export function tell(known: Known): void {
  const notices: [Level, string][] = [];
  let state: [Level, string] = known.live ? ["good", "Live"] : ["good", wordOf(known.playback)];
  const { connected, map } = known;
  const old = known.silence === null ? "" : ` What is shown is from ${seconds(known.silence)} ago.`;
  if (connected.state === "over") {
    state = ["failure", "Stopped"];
    notices.push(["failure", connected.reason]);
  } else if (connected.state === "waiting") {
    const wait = Math.max(0, Math.ceil((connected.retry - Date.now()) / 1e3));
    state = ["failure", "Not connected"];
    notices.push(["failure", `Not connected: ${connected.reason}.${old} Trying again in ${wait} s.`]);
  } else if (connected.state === "connecting") {
    state = ["notice", "Connecting"];
  } else if (known.live && known.silence !== null && known.silence > LATE) {
    state = ["notice", `Late, ${seconds(known.silence)}`];
    notices.push(["notice", `Nothing was heard for ${seconds(known.silence)}. What is shown may be old.`]);
  } else if (!map || !map.complete) {
    state = ["notice", "Map comes"];
    if (map) notices.push(["info", `The map is coming: ${map.blocks.toLocaleString("en")} blocks so far.`]);
  } else if (map.renewing) {
    notices.push(["info", "The map begins anew. The one before is shown until the new one is whole."]);
  } else if (known.behind > LATE) {
    state = ["notice", "Behind"];
    notices.push(["notice", `For ${seconds(known.behind)} there has been newer than what is shown: the connection is slow.`]);
  }
  if (known.paused) {
    state = ["notice", "Paused"];
    notices.push(["info", `Paused ${seconds((Date.now() - known.frozenAt) / 1e3)}${known.frozenAt > Date.now() - 950 ? "" : " ago"}. What is new is kept, and shown when it goes on.`]);
  }
  show(state, notices);
}

function wordOf(playback: Known["playback"]): string {
  if (playback && playback.end <= playback.begin) return "File";
  return playback?.plays ? "Playing" : "Recording";
}

/** Words in place of a map, when there can be none. */
export function fail(text: string): void {
  show(["failure", "Stopped"], [["failure", text]]);
}

function show([level, words]: [Level, string], notices: [Level, string][]): void {
  const status = byId("status");
  if (status.dataset.level !== level) status.dataset.level = level;
  write(status.querySelector<HTMLElement>(".words")!, words);
  const host = byId("notices");
  while (host.children.length > notices.length) host.lastElementChild!.remove();
  while (host.children.length < notices.length) host.append(make("p"));
  notices.forEach(([kind, text], i) => {
    const p = host.children[i] as HTMLElement;
    if (p.className !== kind) p.className = kind;
    write(p, text);
  });
}
