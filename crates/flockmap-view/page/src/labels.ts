// Words over the scene: names of robots and what goes over links. Text in the page, so it is sharp at every size.

import * as THREE from "three";
import type { Stage } from "./stage";

const LABELS_MAX = 72;
const ROOM = 11;

export interface Label {
  at: readonly [number, number, number];
  text: string;
  kind: string;
  colour: string;
  /** Pixels above the place. */
  above: number;
  /** The ends of what is labelled: where they are close on the screen, there is no room for words. */
  ends?: readonly [number, number, number][];
}

export class Labels {
  private readonly spans: HTMLSpanElement[] = [];

  constructor(private readonly host: HTMLElement, private readonly stage: Stage) {}

  draw(labels: Label[]): void {
    const p = new THREE.Vector3();
    let used = 0;
    const em = parseFloat(getComputedStyle(this.host).fontSize);
    for (const label of labels.slice(0, LABELS_MAX)) {
      p.set(...this.stage.toScene(label.at)).project(this.stage.camera);
      if (p.z > 1 || Math.abs(p.x) > 1.1 || Math.abs(p.y) > 1.1) continue;
      if (label.ends && this.distance(label.ends) < ROOM * em) continue;
      const span = this.spans[used] ?? this.add();
      used++;
      if (span.textContent !== label.text) span.textContent = label.text;
      if (span.className !== label.kind) span.className = label.kind;
      span.style.setProperty("--c", label.colour);
      const x = ((p.x + 1) / 2) * this.stage.width;
      const y = ((1 - p.y) / 2) * this.stage.height - label.above;
      span.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -100%)`;
      span.hidden = false;
    }
    for (const span of this.spans.slice(used)) span.hidden = true;
  }

  /** Pixels between two places. */
  private distance(ends: readonly (readonly [number, number, number])[]): number {
    const [a, b] = ends.map((at) => new THREE.Vector3(...this.stage.toScene(at)).project(this.stage.camera));
    return Math.hypot(((a!.x - b!.x) / 2) * this.stage.width, ((a!.y - b!.y) / 2) * this.stage.height);
  }

  private add(): HTMLSpanElement {
    const span = document.createElement("span");
    this.host.append(span);
    this.spans.push(span);
    return span;
  }
}
