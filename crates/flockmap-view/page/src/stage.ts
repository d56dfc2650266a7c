// The camera, the renderer and when a frame is drawn: only when something changed.

import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { FACES_MAX, FACES_MIN, FINEST, Governor, MOVING, NODES_MAX, STILL, type Budget, type Camera } from "./lod";

/** Milliseconds between two words to the worker about the camera. */
const TELL = 120;
const MOVE = 450;
/** After so long without a movement the camera stands: the picture becomes as fine and sharp as a still one may be. */
const REST = 350;
const FENCE_MAX = 3_000;

export class Stage {
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera(50, 1, 0.1, 1_000);
  readonly renderer: THREE.WebGLRenderer;
  readonly controls: OrbitControls;
  /** Whether the browser draws without a graphics card. */
  readonly software = isSoftware();
  readonly moving: Governor;
  readonly still: Governor;
  /** Called before each frame. */
  before: (() => void) | null = null;
  tell: ((camera: Camera, budget: Budget) => void) | null = null;
  resized: (() => void) | null = null;
  /** The user has moved the camera: it is not moved any more to fit the map. */
  touched = false;
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
  /** A frame was asked for while one was drawn, or too soon after it. */
  private asked = false;
  private askedTimer: ReturnType<typeof setTimeout> | undefined;
  /** When the camera moved last. */
  private moved = -Infinity;
  private drawnAt = 0;
  private lastFrame = 0;
  /** Milliseconds from frame to frame. */
  private between = 0;
  private told = 0;
  private tellTimer: ReturnType<typeof setTimeout> | undefined;
  private restTimer: ReturnType<typeof setTimeout> | undefined;
  private scale = 1;
  private radius = 50;
  private readonly centre = new THREE.Vector3();
  private readonly half = new THREE.Vector3(50, 50, 5);
  private flight: { from: THREE.Vector3; to: THREE.Vector3; fromTarget: THREE.Vector3; toTarget: THREE.Vector3; begin: number } | null = null;
  private inset = { left: 0, bottom: 0, top: 0 };

  constructor(canvas: HTMLCanvasElement) {
    // Without a graphics card smooth edges cost more than all else, and there must be fewer faces from the start.
    this.moving = new Governor(this.software ? 2 * FACES_MIN : FACES_MAX / 4, MOVING);
    this.still = new Governor(this.software ? 4 * FACES_MIN : FACES_MAX / 4, STILL);
    const context = canvas.getContext("webgl2", { alpha: false, stencil: false, antialias: !this.software, powerPreference: "high-performance" })!;
    this.renderer = new THREE.WebGLRenderer({ canvas, context });
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
    this.controls.addEventListener("change", () => this.move());
    this.controls.addEventListener("start", () => {
      this.touched = true;
      this.flight = null;
    });
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /**
   * Asks for a frame because something else than the camera changed. Where frames are slow there is a pause between such ones, so that
   * the page and the machine have time for other things.
   */
  request(): void {
    if (this.drawing || this.isMoving) {
      this.asked = true;
      if (!this.drawing) this.move();
      return;
    }
    if (this.wanted) return;
    const wait = this.drawnAt + Math.min(this.frameMs < 20 ? 0 : 0.7 * this.frameMs, 500) - performance.now();
    if (wait > 4) {
      clearTimeout(this.askedTimer);
      this.askedTimer = setTimeout(() => this.request(), wait);
      return;
    }
    this.draw();
  }

  /** Asks for a frame because the camera moved. */
  private move(): void {
    const stood = !this.isMoving;
    this.moved = performance.now();
    if (stood) {
      this.rescale(this.moving.sharpness);
      this.told = 0;
    }
    if (this.drawing) this.asked = true;
    else this.draw();
  }

  private draw(): void {
    this.asked = false;
    if (this.wanted) return;
    this.wanted = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  private get isMoving(): boolean {
    return performance.now() - this.moved < REST;
  }

  /** What lies over the picture: the map is fitted into the rest. */
  setInset(inset: { left: number; bottom: number; top: number }): void {
    this.inset = inset;
    this.resize();
  }

  /** Metres in the frame of the map, to the scene. */
  toScene(at: readonly [number, number, number]): [number, number, number] {
    const r = this.voxel;
    return [at[0] - this.origin.x * r, at[1] - this.origin.y * r, at[2] - this.origin.z * r];
  }

  /** Where the map is, in voxels. Gives whether that is much different from before. */
  setBounds(bounds: readonly number[]): boolean {
    const r = this.voxel;
    const low = new THREE.Vector3(bounds[0], bounds[1], bounds[2]).sub(this.origin).multiplyScalar(r);
    const high = new THREE.Vector3(bounds[3], bounds[4], bounds[5]).sub(this.origin).multiplyScalar(r);
    const centre = low.clone().add(high).multiplyScalar(0.5);
    const radius = Math.max(low.distanceTo(high) / 2, 1);
    const much = Math.abs(radius - this.radius) > 0.12 * this.radius || centre.distanceTo(this.centre) > 0.15 * this.radius;
    if (!much) return false;
    this.centre.copy(centre);
    this.half.copy(high).sub(low).multiplyScalar(0.5);
    this.radius = radius;
    return true;
  }

  home(at_once = false): void {
    this.fit(new THREE.Vector3(-0.42, -0.78, 0.62).normalize(), at_once);
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
    this.move();
  }

  /** Comes as near to the target as one looks at a robot. */
  near(to: readonly [number, number, number]): void {
    const target = new THREE.Vector3(...to);
    const way = this.camera.position.clone().sub(this.controls.target);
    const length = Math.min(way.length(), Math.max(60 * this.voxel, 8));
    this.fly(target.clone().add(way.setLength(length)), target, false);
  }

  /** Frames a second, of those that followed each other. */
  get fps(): number {
    return this.between === 0 ? 0 : 1e3 / this.between;
  }

  /** Pixels of the page that a metre takes at distance 1. */
  get focal(): number {
    return this.height / (2 * Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2)));
  }

  private fit(direction: THREE.Vector3, atOnce: boolean): void {
    const target = this.centre.clone();
    const probe = this.camera.clone();
    probe.clearViewOffset();
    // How much of the picture is free, as tangents; a camera that looks at the middle of it sees that much to each side.
    const tan = Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const { left, bottom, top } = this.inset;
    const [wide, tall] = [(0.94 * tan * (this.width - left)) / this.height, (0.94 * tan * (this.height - bottom - top)) / this.height];
    let distance = 3 * this.radius;
    probe.position.copy(target).addScaledVector(direction, distance);
    probe.lookAt(target);
    probe.updateMatrixWorld();
    const inverse = probe.matrixWorldInverse.copy(probe.matrixWorld).invert();
    const p = new THREE.Vector3();
    let nearest = 0;
    for (let corner = 0; corner < 8; corner++) {
      p.set(corner & 1 ? 1 : -1, corner & 2 ? 1 : -1, corner & 4 ? 1 : -1).multiply(this.half).add(target).applyMatrix4(inverse);
      // Along the way of the camera the corner stays where it is; so it says itself from where it is seen.
      nearest = Math.max(nearest, Math.max(Math.abs(p.x) / wide, Math.abs(p.y) / tall) + p.z + distance);
    }
    distance = Math.max(nearest, 1);
    this.fly(target.clone().addScaledVector(direction, distance), target, atOnce);
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
    else this.move();
  }

  private frame(now: number): void {
    this.wanted = false;
    // From here on what asks for a frame waits for this one: also the camera, which glides on.
    this.drawing = true;
    const ms = now - this.lastFrame;
    this.lastFrame = now;
    if (ms > 0 && ms < 1_500) this.between = this.between === 0 ? ms : 0.85 * this.between + 0.15 * ms;
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
    this.tellSoon();
  }

  /** Waits until the graphics card is done: no next frame before that, and the time it took goes to the governor. */
  private fence(begin: number): void {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = (): void => {
      const done = !sync || gl.isContextLost() || gl.clientWaitSync(sync, 0, 0) !== gl.TIMEOUT_EXPIRED;
      if (!done && performance.now() - begin < FENCE_MAX) {
        setTimeout(look, 3);
        return;
      }
      if (sync) gl.deleteSync(sync);
      this.drawing = false;
      this.drawnAt = performance.now();
      this.frameMs = this.drawnAt - begin;
      const moving = this.isMoving;
      const governor = moving ? this.moving : this.still;
      if (governor.frame(this.frameMs, this.triangles / 2)) this.told = 0;
      if (moving) this.rescale(this.moving.sharpness);
      clearTimeout(this.restTimer);
      if (moving) this.restTimer = setTimeout(() => this.rest(), REST);
      // Where there is room, a still picture becomes finer with each frame.
      const more = !moving && this.still.hasRoom(this.frameMs, this.triangles / 2);
      if (this.asked || more) moving ? this.draw() : this.request();
    };
    setTimeout(look, 1);
  }

  /** The camera stands. */
  private rest(): void {
    this.moved = -Infinity;
    this.rescale(1);
    this.told = 0;
    this.request();
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
    if (!this.isMoving) this.request();
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
      { pixels: FINEST, nodes: NODES_MAX, faces: this.isMoving ? this.moving.faces : Math.max(this.still.faces, this.moving.faces) },
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
