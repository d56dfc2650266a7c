// The panel: robots, what the map has, links; and the legend.

import { css, OLDER, ramp, RAMP } from "./colours";
import { byId, icon, make, write } from "./dom";
import { count, metres, rate, seconds, share, UNKNOWN } from "./format";
import type { MapState } from "./protocol";
import { SILENT, type RobotState, type Swarm } from "./swarm";
import type { Colouring } from "./voxels";

/** Robots whose submaps are in words. */
const SUBMAPS_OF = 6;

interface Row {
  row: HTMLElement;
  radio: HTMLInputElement;
  what: HTMLElement;
  follow: HTMLButtonElement;
}

export class Panel {
  private readonly rows = new Map<number, Row>();

  constructor(
    private readonly swarm: Swarm,
    choose: (robot: number) => void,
    follow: (robot: number) => void,
  ) {
    const host = byId("robots");
    for (const robot of swarm.robots) {
      const row = make("div", "robot-row");
      row.style.setProperty("--c", css(robot.colour));
      const label = make("label");
      const radio = make("input");
      radio.type = "radio";
      radio.name = "robot";
      radio.value = String(robot.id);
      radio.addEventListener("change", () => choose(robot.id));
      const what = make("span", "what");
      label.append(radio, make("span", "swatch"), make("span", "name", robot.name), what);
      const button = make("button", "icon");
      button.append(icon("M12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8", "M12 2v4m0 12v4M2 12h4m12 0h4"));
      button.title = "Follow";
      button.setAttribute("aria-label", `Follow ${robot.name}`);
      button.setAttribute("aria-pressed", "false");
      button.addEventListener("click", () => follow(robot.id));
      row.append(label, button);
      host.append(row);
      this.rows.set(robot.id, { row, radio, what, follow: button });
    }
  }

  robots(chosen: number, followed: number | null, silence: (robot: RobotState) => number | null): void {
    for (const robot of this.swarm.robots) {
      const { row, radio, what, follow } = this.rows.get(robot.id)!;
      const silent = silence(robot);
      const lost = robot.connected.state === "waiting" || robot.connected.state === "over";
      radio.checked = robot.id === chosen;
      row.classList.toggle("lost", lost);
      row.classList.toggle("silent", !lost && silent !== null && silent > SILENT);
      follow.setAttribute("aria-pressed", String(robot.id === followed));
      follow.disabled = robot.pose === null;
      const words = lost ? "not connected" : silent !== null && silent > SILENT ? `silent for ${seconds(silent)}` : rate(robot.rateOut);
      write(what, words);
    }
  }

  facts(map: MapState | null, robot: RobotState | undefined, age: number | null): void {
    write(byId("map-name"), map ? `of ${map.name || `robot ${map.robot}`}, voxels of ${+(map.voxel * 100).toFixed(2)} cm` : "");
    write(byId("f-occupied"), count(map?.occupied));
    write(byId("f-free"), count(map?.free));
    write(byId("f-blocks"), count(map?.blocks));
    write(byId("f-age"), age === null ? UNKNOWN : age < 0.95 ? "now" : `${seconds(age)} ago`);
    write(byId("f-out"), rate(robot?.rateOut));
    write(byId("f-in"), rate(robot?.rateIn));
    write(byId("f-submaps"), this.submaps(robot));
    const links = [...(robot?.links.values() ?? [])];
    const missing = links.filter((link) => link.missing > 0).map((link) => `${count(link.missing)} of ${this.nameOf(link.robot)}`);
    write(byId("f-missing"), links.length === 0 ? UNKNOWN : missing.length === 0 ? "no package" : `packages: ${missing.join(", ")}`);
  }

  links(robot: RobotState | undefined): void {
    write(byId("links-of"), robot ? `of ${robot.name}` : "");
    const body = byId("link-table").querySelector("tbody")!;
    const links = [...(robot?.links.values() ?? [])].sort((a, b) => a.robot - b.robot);
    while (body.rows.length > Math.max(1, links.length)) body.deleteRow(-1);
    while (body.rows.length < Math.max(1, links.length)) body.insertRow();
    if (links.length === 0) {
      const cell = body.rows[0]!;
      if (cell.cells.length !== 1) cell.replaceChildren(make("td"));
      cell.cells[0]!.colSpan = 5;
      write(cell.cells[0]!, "none are known");
      return;
    }
    links.forEach((link, i) => {
      const row = body.rows[i]!;
      if (row.cells.length !== 5) row.replaceChildren(...Array.from({ length: 5 }, () => make("td")));
      row.className = link.hears ? "" : "deaf";
      const kb = (bytes: number | null) => (bytes === null ? UNKNOWN : (bytes / 1e3).toFixed(1));
      const texts = [this.nameOf(link.robot), kb(link.rateOut), kb(link.rateIn), share(link.lost), count(link.missing)];
      texts.forEach((text, k) => write(row.cells[k]!, text));
      row.cells[3]!.className = link.lost > 0.3 ? "warn" : "";
      row.cells[4]!.className = link.missing > 0 ? "warn" : "";
      const trip = link.roundTrip === null ? "" : `, round trip ${(link.roundTrip * 1e3).toFixed(0)} ms`;
      row.title = link.hears ? `heard ${seconds(link.heardAge)}${link.heardAge < 0.95 ? "" : " ago"}${trip}` : "not heard";
    });
  }

  /** How many submaps the newest run of each robot has, if there are several, and how far they were moved last. */
  private submaps(robot: RobotState | undefined): string {
    if (!robot || robot.runs.length === 0) return UNKNOWN;
    const newest = new Map(robot.runs.map((run) => [run.robot, run]));
    const several = [...newest.values()].filter((run) => run.newest > 0);
    const words = several.slice(0, SUBMAPS_OF).map((run) => {
      const moved = this.swarm.get(run.robot)?.moved ?? null;
      return `${run.newest + 1} of ${this.nameOf(run.robot)}${moved === null ? "" : `, moved ${moved.toFixed(2)} m`}`;
    });
    if (several.length > SUBMAPS_OF) words.push(`and of ${several.length - SUBMAPS_OF} more`);
    return words.join("; ") || "one of each robot";
  }

  nameOf(id: number): string {
    return this.swarm.get(id)?.name ?? `robot ${id}`;
  }
}

/** What the colours mean. */
export class Legend {
  private key = "";

  draw(colouring: Colouring, map: MapState | null, robots: RobotState[], slice: string[] | null): void {
    const heights = map?.heights ? map.heights.map((z) => metres(z * map.voxel)) : null;
    const key = [colouring, heights?.join(), robots.map((r) => r.name).join(), slice?.join()].join("|");
    if (key === this.key) return;
    this.key = key;
    const host = byId("legend");
    host.replaceChildren();
    if (colouring === "height") {
      host.append(make("b", "", "Height"), scale("height", heights ? [heights[1]!, heights[0]!] : [UNKNOWN, UNKNOWN]));
    } else if (colouring === "age") {
      host.append(make("b", "", "Last change"), scale("age", ["10 min", "1 min", "10 s", "now"]), list([["older than this page", css(OLDER)]]));
    } else {
      host.append(make("b", "", "Seen last by"), list([...robots.map((r) => [r.name, css(r.colour)] as [string, string]), ["not known", "rgb(128 128 128)"]]));
    }
    if (slice) host.append(make("b", "", "Slice"), list([["occupied", slice[2]!], ["free", slice[1]!], ["unknown", slice[0]!]]));
  }
}

function scale(kind: "height" | "age", ticks: string[]): HTMLElement {
  const host = make("div", "ramp");
  const canvas = make("canvas");
  [canvas.width, canvas.height] = [1, RAMP];
  const g = canvas.getContext("2d")!;
  const colours = ramp(kind);
  for (let i = 0; i < RAMP; i++) {
    g.fillStyle = css([colours[3 * i]!, colours[3 * i + 1]!, colours[3 * i + 2]!]);
    g.fillRect(0, RAMP - 1 - i, 1, 1);
  }
  const words = make("div");
  words.append(...ticks.map((tick) => make("span", "", tick)));
  host.append(canvas, words);
  return host;
}

function list(entries: [string, string][]): HTMLElement {
  const host = make("ul");
  for (const [text, colour] of entries.slice(0, 34)) {
    const item = make("li", "", text);
    item.style.setProperty("--c", colour);
    host.append(item);
  }
  return host;
}
