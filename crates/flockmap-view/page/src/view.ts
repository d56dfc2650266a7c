// The page: reads what the worker tells, and puts it where it belongs.

import * as THREE from "three";
import { Bodies } from "./bodies";
import { css, rgb } from "./colours";
import { byId, write } from "./dom";
import { clockTime, metres, rate, share } from "./format";
import type { Playback, Run } from "./feed";
import { Ground } from "./ground";
import { Labels, type Label } from "./labels";
import { fail, tell } from "./notices";
import { Legend, Panel } from "./panel";
import type { FromWorker, MapState, RobotName, ToWorker } from "./protocol";
import { isSeries, Series } from "./series";
import { Stage } from "./stage";
import { SILENT, Swarm, type RobotState } from "./swarm";
import { Timeline } from "./timeline";
import { ROBOTS_SHOWN, Voxels, type Colouring } from "./voxels";

const ROBOTS_MAX = 32;
const SERIES_AGAIN = 5_000;
const SEEK_EVERY = 60;
const token = new URLSearchParams(location.hash.slice(1)).get("token");
const query = token === null ? "" : `?token=${encodeURIComponent(token)}`;

interface Listing {
  title: string;
  live: boolean;
  robots: RobotName[];
}

async function listing(): Promise<Listing> {
  const answer = await fetch(`robots${query}`);
  if (!answer.ok) throw new Error(answer.status === 401 || answer.status === 403 ? "The server wants a token: open the address that it printed." : `The server answers ${answer.status}.`);
  const json = (await answer.json()) as { title?: unknown; kind?: unknown; robots?: unknown };
  const robots = (Array.isArray(json.robots) ? json.robots : [])
    .filter((r: { id?: unknown }) => Number.isInteger(r?.id))
    .slice(0, ROBOTS_MAX)
    .map((r: { id: number; name?: unknown }) => ({ id: r.id, name: typeof r.name === "string" && r.name ? r.name : `robot ${r.id}` }));
  if (robots.length === 0) throw new Error("The server has no robot to show.");
  return { title: String(json.title ?? ""), live: json.kind !== "playback", robots };
}

class View {
  private readonly stage: Stage;
  private readonly swarm: Swarm;
  private readonly voxels = new Voxels();
  private readonly bodies: Bodies;
  private readonly labels: Labels;
  private readonly ground: Ground;
  private readonly panel: Panel;
  private readonly legend = new Legend();
  private readonly timeline: Timeline;
  private readonly series = new Map<number, Series>();
  private readonly live: boolean;
  private readonly asks = new Map<number, (value: never) => void>();

  private chosen: number;
  private followed: number | null = null;
  private colouring: Colouring = "height";
  private map: MapState | null = null;
  private mapClock = 0;
  private mapAt = 0;
  private behindSince = 0;
  private changedAt = 0;
  private paused = false;
  /** Submaps that were told of while it was paused. */
  private readonly held = new Map<number, Run[]>();
  private frozenAt = 0;
  private playback: Playback | null = null;
  /** The time that the players are told next. */
  private seekTo: number | null = null;
  /** Why nothing goes on any more. */
  private fault: string | null = null;
  private placed = false;
  private homed = false;
  private dirty = { trails: true, links: true, scans: true, chart: true };

  constructor(list: Listing, private readonly worker: Worker) {
    this.live = list.live;
    this.stage = new Stage(byId<HTMLCanvasElement>("scene"));
    this.swarm = new Swarm(list.robots);
    this.bodies = new Bodies(this.stage);
    this.labels = new Labels(byId("labels"), this.stage);
    this.ground = new Ground(this.stage);
    this.stage.scene.add(this.voxels.group, this.ground.group, this.bodies.group);
    this.timeline = new Timeline(byId<HTMLCanvasElement>("chart"), byId("keys"), () => (this.dirty.chart = true, this.chart()));
    this.panel = new Panel(this.swarm, (id) => this.choose(id), (id) => this.follow(this.followed === id ? null : id));
    this.chosen = list.robots[0]!.id;
    for (const { id } of list.robots) this.series.set(id, new Series());
    write(byId("title"), list.title);
    byId("title").title = list.title;
    document.body.classList.toggle("recorded", !this.live);
    if (list.title) document.title = `${list.title} – Flockmap`;

    const robots = new Float32Array(3 * ROBOTS_SHOWN).fill(0.5);
    this.swarm.robots.forEach((robot, i) => robots.set(robot.colour, 3 * (i + 1)));
    this.voxels.set("robots", robots);
    this.stage.before = () => this.beforeFrame();
    this.stage.tell = (camera, budget) => this.say({ kind: "camera", camera, budget });
    this.stage.resized = () => this.bodies.resize();
    worker.onmessage = (event: MessageEvent<FromWorker>) => this.hear(event.data);
    worker.onerror = (event) => {
      this.fault = `This page is at fault, and stopped: ${event.message}`;
      fail(this.fault);
    };
    const base = new URL(".", location.href);
    base.protocol = base.protocol === "https:" ? "wss:" : "ws:";
    this.say({ kind: "start", feeds: `${base.origin === "null" ? `${base.protocol}//${base.host}` : base.origin}${base.pathname}feed/`, query, live: this.live, robots: list.robots });
    this.theme(localStorage.getItem("flockmap-theme"));
    this.wire();
    this.ask();
    this.loadSeries();
    this.layout();
    setInterval(() => this.tick(), 250);
  }

  private say(message: ToWorker): void {
    this.worker.postMessage(message);
  }

  private hear(message: FromWorker): void {
    switch (message.kind) {
      case "mesh":
        this.voxels.put(message);
        return this.stage.request();
      case "show":
        this.voxels.show(message.ids, message.drop);
        return this.stage.request();
      case "map":
        return this.hearMap(message.map, message.clock);
      case "slice":
        this.ground.setSlice(this.checked("slice") ? message : null);
        return this.stage.request();
      case "answer":
        this.asks.get(message.ask)?.(message.value as never);
        this.asks.delete(message.ask);
        return;
      case "shown-playback":
        return this.hearPlayback(message.playback);
    }
    const robot = this.swarm.get(message.robot);
    if (!robot) return;
    switch (message.kind) {
      case "connected":
        robot.connected = message.connected;
        if (message.connected.state === "open") robot.heard = Date.now();
        break;
      case "heard":
        robot.heard = Date.now();
        break;
      case "poses":
        if (this.paused) break;
        this.swarm.poses(message.robot, message.poses);
        this.dirty.trails = this.dirty.links = true;
        this.stage.request();
        break;
      case "submaps":
        // They are told of only when something has changed.
        if (this.paused) this.held.set(message.robot, message.runs);
        else this.hearSubmaps(message.robot, message.runs);
        break;
      case "links":
        if (this.paused) break;
        this.swarm.links(message.robot, message.links, message.at);
        this.dirty.links = true;
        this.stage.request();
        break;
      case "scan":
        if (this.paused) break;
        robot.scan = message.scan;
        this.dirty.scans = true;
        this.stage.request();
        break;
      case "counters": {
        robot.counters = message.counters;
        const series = this.series.get(robot.id)!;
        const rates = series.count(message.counters, this.live);
        const known = (name: "sent" | "received") => rates?.[name] ?? series.at(Math.floor(message.counters.time), name);
        if (rates !== undefined) [robot.rateOut, robot.rateIn] = [known("sent"), known("received")];
        this.dirty.chart = true;
      }
    }
  }

  private hearSubmaps(robot: number, runs: Run[]): void {
    this.swarm.submaps(robot, runs);
    this.dirty.trails = true;
    this.stage.request();
  }

  private hearMap(map: MapState, clock: number): void {
    if (map.robot !== this.chosen) return;
    if (this.map?.upto !== map.upto) this.changedAt = Date.now();
    this.behindSince = map.upto === map.newest || !map.complete ? 0 : this.behindSince || Date.now();
    this.map = map;
    [this.mapClock, this.mapAt] = [clock, performance.now()];
    if (!this.placed || this.stage.voxel !== map.voxel) this.place(map);
    if (map.heights) this.voxels.set("heights", new THREE.Vector2(map.heights[0], map.heights[1]));
    if (map.bounds) {
      if (this.stage.setBounds(map.bounds, map.outline)) {
        this.ground.setGrid(map.bounds, map.heights?.[0] ?? map.bounds[2]);
        if (!this.stage.touched) {
          this.stage.home(!this.homed);
          this.homed = true;
        }
      }
      this.sliders(map);
    }
    this.stage.request();
  }

  /** Puts the zero of the scene where the map begins, and takes the side of its voxels. */
  private place(map: MapState): void {
    const bounds = map.bounds;
    if (!bounds) return;
    this.placed = true;
    this.stage.voxel = map.voxel;
    this.stage.origin.set(bounds[0], bounds[1], bounds[2]);
    this.voxels.setFrame(map.voxel, this.stage.origin);
    this.dirty.trails = this.dirty.links = this.dirty.scans = true;
  }

  private hearPlayback(playback: Playback): void {
    const before = this.playback;
    if (before && (playback.at < before.at - 0.01 || playback.at > before.at + 2 * Math.max(1, playback.speed))) this.swarm.jump();
    this.playback = playback;
    // A file has no time: what is about time is not shown then.
    document.body.classList.toggle("timeless", playback.end <= playback.begin && !playback.grows);
    const scrub = byId<HTMLInputElement>("scrub");
    byId("player").hidden = scrub.hidden = false;
    if (!before) this.layout();
    // What came since the series were loaded last.
    if (before?.grows && !playback.grows) void this.loadSeries();
    scrub.min = "0";
    scrub.max = String(Math.max(0, playback.end - playback.begin));
    scrub.step = "0.1";
    const at = playback.at - playback.begin;
    if (document.activeElement !== scrub || !scrub.matches(":active")) scrub.value = String(at);
    scrub.setAttribute("aria-valuetext", clockTime(at));
    write(byId("player-time"), `${clockTime(at)} / ${clockTime(playback.end - playback.begin)}${playback.grows ? " …" : ""}`);
    byId("play").setAttribute("aria-pressed", String(playback.plays));
    byId("play").setAttribute("aria-label", playback.plays ? "Pause" : "Play");
    const speed = byId<HTMLSelectElement>("speed");
    if (document.activeElement !== speed) {
      const option = [...speed.options].find((o) => Math.abs(Number(o.value) - playback.speed) < 0.01 * playback.speed);
      if (option) speed.value = option.value;
    }
    this.dirty.chart = true;
    if (!playback.plays) this.chart();
  }

  private async loadSeries(): Promise<void> {
    for (const [id, series] of this.series) {
      try {
        const answer = await fetch(`series/${id}${query}`);
        const json: unknown = answer.ok ? await answer.json() : null;
        if (isSeries(json)) series.load(json);
      } catch {
        // The chart goes on from the counters then.
      }
    }
    const some = [...this.series.values()].some((s) => s.has("racer") || s.has("paper"));
    if (some && !byId<HTMLInputElement>("log").dataset.chosen) byId<HTMLInputElement>("log").checked = true;
    this.dirty.chart = true;
    this.chart();
    // What other methods would have sent only the server counts, and a recording may grow.
    if (this.live ? some : this.playback?.grows !== false) setTimeout(() => void this.loadSeries(), SERIES_AGAIN);
  }

  private ask(): void {
    this.say({ kind: "choose", robot: this.chosen, origins: this.colouring === "robot", scans: this.checked("scans") });
  }

  private choose(id: number): void {
    if (id === this.chosen || !this.swarm.get(id)) return;
    this.chosen = id;
    this.map = null;
    this.placed = false;
    this.ground.setSlice(null);
    this.dirty.chart = this.dirty.links = true;
    this.ask();
    this.tick();
  }

  private follow(id: number | null): void {
    this.followed = id;
    byId("follow").setAttribute("aria-pressed", String(id !== null));
    const robot = id === null ? undefined : this.swarm.get(id);
    if (robot?.pose) {
      this.stage.touched = true;
      this.stage.near(this.stage.toScene(robot.pose.at));
    }
    this.tick();
  }

  private checked(id: string): boolean {
    return byId<HTMLInputElement>(id).checked;
  }

  private pause(): void {
    if (!this.live) {
      if (!this.playback || document.body.classList.contains("timeless")) return;
      this.say({ kind: "playback", wish: { play: !this.playback?.plays } });
      return;
    }
    this.paused = !this.paused;
    this.frozenAt = Date.now();
    byId("freeze").setAttribute("aria-pressed", String(this.paused));
    byId("freeze").setAttribute("aria-label", this.paused ? "Go on" : "Pause");
    this.say({ kind: "pause", paused: this.paused });
    if (!this.paused) {
      for (const [robot, runs] of this.held) this.hearSubmaps(robot, runs);
      this.held.clear();
    }
    this.tick();
  }

  private seek(seconds: number): void {
    const p = this.playback;
    if (!p) return;
    // A slider that is drawn says more times than a player hears: the newest one of each while counts.
    if (this.seekTo === null) {
      setTimeout(() => {
        this.say({ kind: "playback", wish: { seek: this.seekTo! } });
        this.seekTo = null;
      }, SEEK_EVERY);
    }
    this.seekTo = Math.max(p.begin, Math.min(p.end, p.begin + seconds));
  }

  private colour(colouring: Colouring): void {
    this.colouring = colouring;
    this.voxels.set("colouring", { height: 0, robot: 1, age: 2 }[colouring]);
    document.querySelector<HTMLInputElement>(`input[name=color][value=${colouring}]`)!.checked = true;
    this.ask();
    this.tick();
    this.stage.request();
  }

  private sliders(map: MapState): void {
    const bounds = map.bounds!;
    for (const id of ["cut", "slice"]) {
      const input = byId<HTMLInputElement>(`${id}-z`);
      const heights = map.heights ?? [bounds[2], bounds[5]];
      const [low, high] = [Math.min(bounds[2], heights[0] - 2), Math.max(heights[1] + 2, Math.min(bounds[5], heights[1] + 64))];
      if (input.min === String(low) && input.max === String(high)) continue;
      const fresh = !input.dataset.set;
      [input.min, input.max, input.step] = [String(low), String(high), "1"];
      input.disabled = false;
      input.dataset.set = "1";
      if (fresh) input.value = String(Math.round(heights[0] + (heights[1] - heights[0]) * (id === "cut" ? 0.6 : 0.35)));
    }
    this.cut();
  }

  private cut(): void {
    const voxel = this.map?.voxel ?? this.stage.voxel;
    const z = Number(byId<HTMLInputElement>("cut-z").value);
    const on = this.checked("cut") && this.map !== null;
    this.voxels.set("cut", on ? z : 1e9);
    write(byId("cut-at"), on ? metres(z * voxel) : "off");
    write(byId("slice-at"), this.checked("slice") && this.map ? metres((Number(byId<HTMLInputElement>("slice-z").value) + 0.5) * voxel) : "off");
    this.stage.request();
  }

  private slice(): void {
    const on = this.checked("slice");
    if (!on) this.ground.setSlice(null);
    this.say({ kind: "slice", z: on ? Number(byId<HTMLInputElement>("slice-z").value) : null });
    this.cut();
    this.tick();
  }

  private theme(chosen: string | null): void {
    const dark = chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    this.stage.scene.background = new THREE.Color().setStyle(dark ? "#15141d" : "#eceef4", THREE.LinearSRGBColorSpace);
    // Light from above and from the left, brighter where the page is bright.
    const light = [0.8, 0.7, 0.9, 0.6, 0.5, 1.0].map((l) => (dark ? 0.94 * l : 1.02 * l));
    this.voxels.set("light", Float32Array.from(light));
    this.voxels.set("section", new THREE.Color().setStyle(dark ? "#0b0a11" : "#3a3850", THREE.LinearSRGBColorSpace));
    this.bodies.setTheme(dark);
    const colours = this.sliceColours();
    this.ground.setColours(new THREE.Color().setStyle(dark ? "#8d8aa8" : "#7d7a94", THREE.LinearSRGBColorSpace), dark ? 0.16 : 0.22, colours[0]!, colours[1]!, colours[2]!);
    this.dirty.chart = this.dirty.links = true;
    this.chart();
    this.stage.request();
  }

  /** Unknown, free, occupied. */
  private sliceColours(): number[][] {
    const dark = document.documentElement.dataset.theme === "dark";
    return [
      [...rgb(dark ? "#56536b" : "#9a97ad"), 0.55],
      [...rgb(dark ? "#2f6f8f" : "#cfe7f2"), 0.85],
      [...rgb(dark ? "#ffffff" : "#1c1b29"), 1],
    ];
  }

  private wire(): void {
    byId("home").onclick = () => (this.follow(null), (this.stage.touched = false), this.stage.home());
    byId("top").onclick = () => (this.follow(null), (this.stage.touched = true), this.stage.top());
    byId("follow").onclick = () => this.follow(this.followed === null ? this.chosen : null);
    byId("freeze").onclick = () => this.pause();
    byId("freeze").hidden = !this.live;
    byId("play").onclick = () => this.pause();
    byId("theme").onclick = () => {
      const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
      localStorage.setItem("flockmap-theme", next);
      this.theme(next);
    };
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.theme(localStorage.getItem("flockmap-theme")));
    const help = byId<HTMLDialogElement>("help");
    byId("help-open").onclick = () => help.showModal();
    for (const input of document.querySelectorAll<HTMLInputElement>("input[name=color]")) {
      input.onchange = () => this.colour(input.value as Colouring);
    }
    byId("cut").onchange = byId("cut-z").oninput = () => this.cut();
    byId("slice").onchange = byId("slice-z").oninput = () => this.slice();
    byId("scans").onchange = () => {
      for (const robot of this.swarm.robots) robot.scan = null;
      this.dirty.scans = true;
      this.ask();
      this.stage.request();
    };
    byId("trails").onchange = byId("links").onchange = byId("names").onchange = () => {
      this.dirty.trails = this.dirty.links = true;
      this.stage.request();
    };
    byId("log").onchange = () => {
      byId("log").dataset.chosen = "1";
      this.dirty.chart = true;
      this.chart();
    };
    byId("scrub").oninput = () => this.seek(Number(byId<HTMLInputElement>("scrub").value));
    byId("speed").onchange = () => this.say({ kind: "playback", wish: { speed: Number(byId<HTMLSelectElement>("speed").value) } });
    const sheet = byId("sheet");
    if (matchMedia("(max-width: 760px)").matches) sheet.setAttribute("aria-expanded", "false");
    sheet.onclick = () => {
      sheet.setAttribute("aria-expanded", String(sheet.getAttribute("aria-expanded") !== "true"));
      this.layout();
    };
    window.addEventListener("keydown", (event) => this.key(event, help));
    const sizes = new ResizeObserver(() => this.layout());
    for (const element of [document.body, byId("timeline")]) sizes.observe(element);
    const scene = byId("scene");
    scene.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.fault = "The graphics card was taken away from this page. It loads again when the card is back.";
      fail(this.fault);
    });
    scene.addEventListener("webglcontextrestored", () => location.reload());
  }

  private key(event: KeyboardEvent, help: HTMLDialogElement): void {
    const target = event.target as HTMLElement;
    if (event.ctrlKey || event.metaKey || event.altKey || help.open) return;
    const typing = target instanceof HTMLInputElement || target instanceof HTMLSelectElement;
    const key = event.key.toLowerCase();
    const arrows = key === "arrowleft" || key === "arrowright";
    if ((typing && (arrows || key === " ")) || (key === " " && target instanceof HTMLButtonElement)) return;
    const colours: Colouring[] = ["height", "robot", "age"];
    const actions: Record<string, () => void> = {
      h: () => byId("home").click(),
      t: () => byId("top").click(),
      f: () => byId("follow").click(),
      d: () => byId("theme").click(),
      x: () => byId("cut").click(),
      s: () => byId("slice").click(),
      c: () => this.colour(colours[(colours.indexOf(this.colouring) + 1) % 3]!),
      " ": () => this.pause(),
      "?": () => help.showModal(),
      arrowleft: () => this.playback && this.seek(this.playback.at - this.playback.begin - 5),
      arrowright: () => this.playback && this.seek(this.playback.at - this.playback.begin + 5),
    };
    const robot = /^[1-9]$/.test(key) ? this.swarm.robots[Number(key) - 1] : undefined;
    const action = robot ? () => this.choose(robot.id) : actions[key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  /** Seconds of silence of a robot; in a recording that stands still, silence says nothing. */
  private silence(robot: RobotState): number | null {
    if (!this.live) return robot.pose ? 0 : null;
    return this.swarm.silence(robot, this.paused ? this.frozenAt : Date.now());
  }

  private isSilent = (robot: RobotState): boolean => (this.silence(robot) ?? 0) > SILENT;

  private tick(): void {
    if (this.fault) return;
    const now = Date.now();
    const robot = this.swarm.get(this.chosen)!;
    this.panel.robots(this.chosen, this.followed, (r) => this.silence(r));
    this.panel.facts(this.map, robot, this.changedAt > 0 && this.live && this.map ? (now - this.changedAt) / 1e3 : null);
    this.panel.links(robot);
    const slice = this.checked("slice") ? this.sliceColours().map(([r, g, b]) => css([r!, g!, b!])) : null;
    this.legend.draw(this.colouring, this.map, this.swarm.robots, slice);
    tell({
      connected: robot.connected,
      live: this.live,
      paused: this.paused,
      frozenAt: this.frozenAt,
      silence: robot.heard === 0 ? null : (now - robot.heard) / 1e3,
      behind: this.behindSince === 0 || this.paused ? 0 : (now - this.behindSince) / 1e3,
      map: this.map,
      playback: this.playback,
    });
    this.chart();
    // Colours by age change with time, and silent robots become grey.
    if (this.colouring === "age" && !this.paused && now % 1_000 < 250) this.stage.request();
    if (this.swarm.robots.some(this.isSilent)) this.stage.request();
  }

  private chart(): void {
    if (!this.dirty.chart) return;
    this.dirty.chart = false;
    this.timeline.draw({
      series: this.series,
      chosen: this.chosen,
      chosenName: this.swarm.get(this.chosen)!.name,
      playback: this.playback,
      log: this.checked("log"),
    });
  }

  /** The map is fitted into what the panels leave free. */
  private layout(): void {
    const timeline = byId("timeline").getBoundingClientRect();
    document.documentElement.style.setProperty("--timeline", `${timeline.height}px`);
    const narrow = matchMedia("(max-width: 760px)").matches;
    const panel = byId("panel").getBoundingClientRect();
    const bar = byId("bar").getBoundingClientRect();
    this.stage.setInset(
      narrow
        ? { left: 0, bottom: innerHeight - panel.top, top: bar.bottom }
        : { left: panel.right, bottom: timeline.height > 0 ? innerHeight - timeline.top : 0, top: 0 },
    );
    this.dirty.chart = true;
    this.chart();
  }

  private pairs(): { a: RobotState; b: RobotState; lost: number; bytes: number | null; missing: number }[] {
    const pairs = [];
    const { robots } = this.swarm;
    for (const [i, a] of robots.entries()) {
      for (const b of robots.slice(i + 1)) {
        const there = a.links.get(b.id);
        const back = b.links.get(a.id);
        if (!a.pose || !b.pose || !(there?.hears || back?.hears)) continue;
        const rates = [there?.rateIn, back?.rateIn].filter((r): r is number => r != null);
        pairs.push({
          a,
          b,
          lost: Math.max(there?.lost ?? 0, back?.lost ?? 0),
          bytes: rates.length > 0 ? rates.reduce((x, y) => x + y) : null,
          missing: (there?.missing ?? 0) + (back?.missing ?? 0),
        });
      }
    }
    return pairs;
  }

  private beforeFrame(): void {
    const { robots } = this.swarm;
    this.voxels.set("clock", this.mapClock + (this.paused ? 0 : (performance.now() - this.mapAt) / 100));
    const follow = this.followed === null ? undefined : this.swarm.get(this.followed);
    if (follow?.pose) this.stage.carry(this.stage.toScene(follow.pose.at), 0.25);
    this.bodies.place(robots, this.isSilent);
    if (this.dirty.trails) this.bodies.setTrails(this.checked("trails") ? robots : []);
    const pairs = this.checked("links") ? this.pairs() : [];
    const dark = document.documentElement.dataset.theme === "dark";
    if (this.dirty.links) this.bodies.setLinks(pairs, rgb(dark ? "#6dc996" : "#2f9e57"), rgb(dark ? "#f0686c" : "#d1383d"));
    if (this.dirty.scans) this.bodies.setScans(this.checked("scans") ? robots : []);
    this.dirty.trails = this.dirty.links = this.dirty.scans = false;
    this.labels.draw(this.checked("names") ? this.words(pairs) : []);
  }

  private words(pairs: ReturnType<View["pairs"]>): Label[] {
    const labels: Label[] = this.swarm.robots
      .filter((robot) => robot.pose)
      .map((robot) => {
        const silent = this.isSilent(robot) ? ` · silent ${Math.round(this.silence(robot)!)} s` : "";
        const own = robot.id === this.chosen ? " own" : "";
        const kind = `robot${own}${silent ? " silent" : ""}`;
        return { at: robot.pose!.at, text: `${robot.name}${silent}`, kind, colour: css(robot.colour), above: 16 };
      });
    for (const { a, b, bytes, lost, missing } of pairs) {
      // With many robots only what goes to and from the chosen one is in words.
      if (this.swarm.robots.length > 5 && a.id !== this.chosen && b.id !== this.chosen) continue;
      const at = a.pose!.at.map((v, i) => (v + b.pose!.at[i]!) / 2) as [number, number, number];
      const text = `${bytes === null ? "" : `${rate(bytes)} · `}${share(lost)} lost${missing > 0 ? ` · ${missing} missing` : ""}`;
      labels.push({ at, text, kind: "link", colour: "", above: 2, ends: [a.pose!.at, b.pose!.at] });
    }
    return labels;
  }

  question(what: "blocks" | "faces"): Promise<never> {
    const ask = Math.max(0, ...this.asks.keys()) + 1;
    return new Promise((resolve) => {
      this.asks.set(ask, resolve);
      this.say({ kind: "ask", what, ask });
    });
  }

  state() {
    const { stage, map } = this;
    const { levels, faces } = this.voxels.counts();
    return {
      robot: this.chosen,
      upto: map?.upto ?? null,
      newest: map?.newest ?? null,
      connected: this.swarm.get(this.chosen)!.connected.state === "open",
      complete: map?.complete ?? false,
      occupied: map?.occupied ?? null,
      free: map?.free ?? null,
      blocks: map?.blocks ?? null,
      drawCalls: stage.drawCalls,
      triangles: stage.triangles,
      faces,
      levels,
      distance: stage.camera.position.distanceTo(stage.controls.target),
      fps: stage.fps,
      frameMs: stage.frameMs,
      meshBytes: 8 * this.voxels.held,
      mapBytes: map?.bytes ?? null,
      pendingMeshes: map?.pending ?? null,
      facesWanted: Math.round(stage.governor.faces),
      color: this.colouring,
      theme: document.documentElement.dataset.theme,
      paused: this.live ? this.paused : !this.playback?.plays,
      playback: this.playback,
      follows: this.followed,
      trails: this.swarm.robots.map(({ trail, moved }) => ({ points: trail.points.length / 3, moved })),
    };
  }
}

async function begin(): Promise<void> {
  if (!document.createElement("canvas").getContext("webgl2")) {
    fail("This browser gives no WebGL 2, which the map needs. Another browser, or its settings for graphics, may help.");
    return;
  }
  let list: Listing;
  try {
    list = await listing();
  } catch (error) {
    fail(`${error instanceof TypeError ? "The server does not answer." : (error as Error).message} Trying again every 5 s.`);
    setTimeout(begin, 5_000);
    return;
  }
  const view = new View(list, new Worker("worker.js"));
  Object.assign(window, {
    flockmap: { blocks: () => view.question("blocks"), faces: () => view.question("faces"), state: () => view.state() },
  });
}

void begin();
