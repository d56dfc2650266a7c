// The camera, the renderer and when a frame is drawn: only when something changed.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { FACES_MAX, FACES_MIN, FINEST, Governor, NODES_MAX, SLOW, type Budget, type Camera } from "./lod";

/** Milliseconds between two words to the worker about the camera. */
const TELL = 120;
const MOVE = 450;
/** A picture that stands still is drawn as sharp as the screen; before, a slow one may be coarser. */
const REST = 350;
const FENCE_MAX = 3_000;
/** A camera that has stood for so long sees more faces than one that moves, where frames are slow. */
const STANDS = 800;
const FACES_STANDING = 500_000;
/** Share of the free picture that the map takes. */
const FILLED = 0.92;
const HOMES = [[-0.42, -0.78, 0.62], [0.78, -0.42, 0.62]] as const;

export class Stage {
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera(50, 1, 0.1, 1_000);
  readonly renderer: THREE.WebGLRenderer;
  readonly controls: OrbitControls;
  readonly governor: Governor;
  /** Called before each frame. */
  before: (() => void) | null = null;
  tell: ((camera: Camera, budget: Budget) => void) | null = null;
  resized: (() => void) | null = null;
  /** The user has moved the camera: it is not moved any more to fit the map. */
  touched = false;
  fps = 0;
  drawCalls = 0;
  triangles = 0;
  width = 1;
  height = 1;
  voxel = 1;
  readonly origin = new THREE.Vector3();

  /** Milliseconds that the newest frame took. */
  frameMs = 0;

  private wanted = false;
  private drawing = false;
  private sized = false;
  /** A frame was asked for while one was drawn. */
  private asked = false;
  private lastFrame = 0;
  private told = 0;
  private tellTimer: ReturnType<typeof setTimeout> | undefined;
  private restTimer: ReturnType<typeof setTimeout> | undefined;
  private standTimer: ReturnType<typeof setTimeout> | undefined;
  private stands = false;
  private scale = 1;
  /** Of `HOMES`. */
  private side = 0;
  private radius = 50;
  private centre = new THREE.Vector3();
  /** The map as it was when the camera was fitted to it last. */
  private fitted = { centre: new THREE.Vector3(), radius: 0 };
  private outline: THREE.Vector3[] = [];
  private flight: { from: THREE.Vector3; to: THREE.Vector3; fromTarget: THREE.Vector3; toTarget: THREE.Vector3; begin: number } | null = null;
  private inset = { left: 0, bottom: 0, top: 0 };

  constructor(canvas: HTMLCanvasElement) {
    // Without a graphics card smooth edges cost more than all else, and there must be fewer faces from the start.
    const software = isSoftware();
    this.governor = new Governor(software ? 4 * FACES_MIN : FACES_MAX / 4);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !software, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-30, -45, 40);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.18;
    this.controls.zoomToCursor = true;
    this.controls.minDistance = 0.2;
    this.controls.maxDistance = 50_000;
    this.controls.maxPolarAngle = Math.PI * 0.98;
    this.controls.addEventListener("change", () => {
      this.moves();
      this.request();
    });
    this.controls.addEventListener("start", () => {
      this.touched = true;
      this.flight = null;
      this.moves();
    });
    this.moves();
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  private moves(): void {
    clearTimeout(this.standTimer);
    this.standTimer = setTimeout(() => this.stand(true), STANDS);
    if (this.stands) this.stand(false);
  }

  private stand(stands: boolean): void {
    this.stands = stands;
    this.told = 0;
    this.tellSoon();
  }

  /** Asks for a frame. */
  request(): void {
    if (this.drawing) {
      this.asked = true;
      return;
    }
    this.asked = false;
    if (this.wanted) return;
    this.wanted = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  /** What lies over the picture: the map is fitted into the rest. */
  setInset(inset: { left: number; bottom: number; top: number }): void {
    const same = inset.left === this.inset.left && inset.bottom === this.inset.bottom && inset.top === this.inset.top;
    this.inset = inset;
    if (!same) this.resize();
  }

  /** Metres in the frame of the map, to the scene. */
  toScene(at: readonly [number, number, number]): [number, number, number] {
    const r = this.voxel;
    return [at[0] - this.origin.x * r, at[1] - this.origin.y * r, at[2] - this.origin.z * r];
  }

  /** Where the map is, and places on its outline, in voxels. Gives whether that is much different from before. */
  setBounds(bounds: readonly number[], outline: readonly number[]): boolean {
    const r = this.voxel;
    const low = new THREE.Vector3(bounds[0], bounds[1], bounds[2]).sub(this.origin).multiplyScalar(r);
    const high = new THREE.Vector3(bounds[3], bounds[4], bounds[5]).sub(this.origin).multiplyScalar(r);
    const centre = low.clone().add(high).multiplyScalar(0.5);
    const radius = Math.max(low.distanceTo(high) / 2, 1);
    [this.centre, this.radius] = [centre, radius];
    this.outline = [];
    for (let i = 0; i + 2 < outline.length; i += 3) this.outline.push(new THREE.Vector3(outline[i], outline[i + 1], outline[i + 2]).sub(this.origin).multiplyScalar(r));
    const { fitted } = this;
    if (Math.abs(radius - fitted.radius) <= 0.12 * fitted.radius && centre.distanceTo(fitted.centre) <= 0.15 * fitted.radius) return false;
    this.fitted = { centre, radius };
    return true;
  }

  home(atOnce = false): void {
    // From that side from which a long map is seen larger; not from another one for a little.
    const sides = HOMES.map(([x, y, z]) => new THREE.Vector3(x, y, z).normalize());
    const other = 1 - this.side;
    if (this.whole(sides[other]!).distance < 0.85 * this.whole(sides[this.side]!).distance) this.side = other;
    this.fit(sides[this.side]!, atOnce);
  }

  top(): void {
    this.fit(new THREE.Vector3(0, -0.02, 1).normalize(), false);
  }

  /** Moves the target, and the camera with it: for what is followed. */
  carry(to: readonly [number, number, number], share: number): void {
    const step = new THREE.Vector3(...to).sub(this.controls.target).multiplyScalar(share);
    if (step.length() < 1e-4) return;
    this.controls.target.add(step);
    this.camera.position.add(step);
    this.request();
  }

  /** Comes as near to the target as one looks at a robot. */
  near(to: readonly [number, number, number]): void {
    const target = new THREE.Vector3(...to);
    const way = this.camera.position.clone().sub(this.controls.target);
    const length = Math.min(way.length(), Math.max(60 * this.voxel, 8));
    this.fly(target.clone().add(way.setLength(length)), target, false);
  }

  /** Pixels of the page that a metre takes at distance 1. */
  get focal(): number {
    return this.height / (2 * Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2)));
  }

  private fit(direction: THREE.Vector3, atOnce: boolean): void {
    const { target, distance } = this.whole(direction);
    this.fly(target.clone().addScaledVector(direction, distance), target, atOnce);
  }

  /** Where a camera must look, and how far away it must be, to see all of the map. */
  private whole(direction: THREE.Vector3): { target: THREE.Vector3; distance: number } {
    // How much of the picture is free, as tangents; a camera that looks at the middle of it sees that much to each side.
    const tan = Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const { left, bottom, top } = this.inset;
    const wide = (FILLED * tan * Math.max(this.width - left, 0.2 * this.width)) / this.height;
    const tall = (FILLED * tan * Math.max(this.height - bottom - top, 0.2 * this.height)) / this.height;
    const right = new THREE.Vector3().crossVectors(this.camera.up, direction).normalize();
    const up = new THREE.Vector3().crossVectors(direction, right);
    const target = this.centre.clone();
    let distance = 1;
    // What is nearer is seen larger: the middle of the picture is found in steps.
    for (let step = 0; step < 4; step++) {
      const from = distance;
      let [low, high, least, most] = [Infinity, -Infinity, Infinity, -Infinity];
      distance = 1;
      for (const place of this.outline) {
        const p = place.clone().sub(target);
        const [x, y, z] = [p.dot(right), p.dot(up), p.dot(direction)];
        // Along the way of the camera a place stays where it is; so it says itself from where it is seen.
        distance = Math.max(distance, Math.max(Math.abs(x) / wide, Math.abs(y) / tall) + z);
        const seen = step === 0 ? 1 : from / Math.max(from - z, 0.1 * from);
        [low, high] = [Math.min(low, x * seen), Math.max(high, x * seen)];
        [least, most] = [Math.min(least, y * seen), Math.max(most, y * seen)];
      }
      if (step < 3 && low <= high) target.addScaledVector(right, (low + high) / 2).addScaledVector(up, (least + most) / 2);
    }
    return { target, distance };
  }

  private fly(to: THREE.Vector3, toTarget: THREE.Vector3, atOnce: boolean): void {
    this.flight = { from: this.camera.position.clone(), to, fromTarget: this.controls.target.clone(), toTarget, begin: performance.now() };
    if (atOnce || matchMedia("(prefers-reduced-motion: reduce)").matches) this.flight.begin = -Infinity;
    this.request();
  }

  private moveOn(now: number): void {
    const flight = this.flight;
    if (!flight) return;
    const t = Math.min(1, (now - flight.begin) / MOVE);
    const share = t * t * (3 - 2 * t);
    this.camera.position.lerpVectors(flight.from, flight.to, share);
    this.controls.target.lerpVectors(flight.fromTarget, flight.toTarget, share);
    if (t >= 1) this.flight = null;
    this.request();
  }

  private frame(now: number): void {
    this.wanted = false;
    const ms = now - this.lastFrame;
    this.lastFrame = now;
    if (ms > 0 && ms < 1_500) this.fps = this.fps === 0 ? 1e3 / ms : 0.85 * this.fps + 0.15 * (1e3 / ms);
    this.moveOn(performance.now());
    this.controls.update();
    this.before?.();
    const distance = this.camera.position.distanceTo(this.centre);
    this.camera.near = Math.max(0.05, Math.min(this.camera.position.distanceTo(this.controls.target) * 0.02, 5));
    this.camera.far = distance + 1.3 * this.radius + 200;
    this.camera.updateProjectionMatrix();
    if (!this.sized) {
      this.renderer.setPixelRatio(this.ratio);
      this.renderer.setSize(this.width, this.height, false);
      this.sized = true;
    }
    const begin = performance.now();
    this.renderer.render(this.scene, this.camera);
    this.drawCalls = this.renderer.info.render.calls;
    this.triangles = this.renderer.info.render.triangles;
    this.fence(begin);
    clearTimeout(this.restTimer);
    if (this.scale < 1) this.restTimer = setTimeout(() => this.rescale(1), REST);
    this.tellSoon();
  }

  /** Waits until the graphics card is done: no next frame before that, and the time it took goes to the governor. */
  private fence(begin: number): void {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.drawing = true;
    const look = (): void => {
      const done = !sync || gl.isContextLost() || gl.clientWaitSync(sync, 0, 0) !== gl.TIMEOUT_EXPIRED;
      if (!done && performance.now() - begin < FENCE_MAX) {
        setTimeout(look, 3);
        return;
      }
      if (sync) gl.deleteSync(sync);
      this.drawing = false;
      this.frameMs = performance.now() - begin;
      // The sharp picture after a movement may take its time.
      const moving = this.asked;
      if (!this.stands && (this.scale === this.governor.sharpness || moving)) {
        if (this.governor.frame(this.frameMs, this.triangles / 2)) this.told = 0;
        if (moving && this.scale !== this.governor.sharpness) this.rescale(this.governor.sharpness);
      }
      if (!this.asked) return;
      // While only the map changes, a slow picture leaves half of the time to others.
      if (this.stands && this.frameMs > SLOW) setTimeout(() => this.asked && this.request(), this.frameMs);
      else this.request();
    };
    setTimeout(look, 1);
  }

  private rescale(scale: number): void {
    if (scale === this.scale) return;
    this.scale = scale;
    this.resize();
  }

  private resize(): void {
    const canvas = this.renderer.domElement;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (width === 0 || height === 0) return;
    [this.width, this.height] = [width, height];
    // The canvas is emptied when its size changes: so that is left to the next frame.
    this.sized = false;
    this.camera.aspect = width / height;
    const { left, bottom, top } = this.inset;
    this.camera.setViewOffset(width, height, -left / 2, (bottom - top) / 2, width, height);
    this.resized?.();
    this.request();
  }

  get ratio(): number {
    return Math.min(devicePixelRatio, 2) * this.scale;
  }

  /** Tells the worker where the camera is, now and then while it moves and once when it stands. */
  tellSoon(): void {
    clearTimeout(this.tellTimer);
    const wait = this.told + TELL - performance.now();
    if (wait > 0) {
      this.tellTimer = setTimeout(() => this.tellSoon(), wait);
      return;
    }
    this.told = performance.now();
    const r = this.voxel;
    const frustum = new THREE.Frustum().setFromProjectionMatrix(
      new THREE.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse),
    );
    const planes = frustum.planes.flatMap(({ normal: n, constant }) => [n.x, n.y, n.z, constant / r - n.dot(this.origin)]);
    const eye = this.camera.position.clone().divideScalar(r).add(this.origin);
    const density = Math.min(devicePixelRatio, 1.5);
    this.tell?.(
      { eye: [eye.x, eye.y, eye.z], planes, focal: this.focal * density },
      { pixels: FINEST, nodes: NODES_MAX, faces: this.stands ? Math.max(this.governor.faces, FACES_STANDING) : this.governor.faces },
    );
  }
}

/** Whether the browser draws without a graphics card. */
function isSoftware(): boolean {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? String(gl!.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
