// The robots in the scene: bodies, trails, links, scan points.

import * as THREE from "three";
import { Lines, type Piece } from "./lines";
import type { Stage } from "./stage";
import type { RobotState } from "./swarm";

/** A body is at least so many pixels long, however far it is. */
const PIXELS = 13;
const BODY = 0.4;
const ROBOTS_MAX = 32;
const POINTS_MAX = 2_048;

/** An arrow that points along x, or an octahedron where the heading is not known. */
function shape(heading: boolean): THREE.BufferGeometry {
  const corners = heading
    ? { nose: [1.1, 0, 0], left: [-0.85, 0.75, 0], tail: [-0.45, 0, 0], right: [-0.85, -0.75, 0], top: [-0.15, 0, 0.38], low: [-0.15, 0, -0.26] }
    : { nose: [0.6, 0, 0], left: [0, 0.6, 0], tail: [-0.6, 0, 0], right: [0, -0.6, 0], top: [0, 0, 0.6], low: [0, 0, -0.6] };
  const { nose, left, tail, right, top, low } = corners;
  const ring = [nose, left, tail, right];
  const points = ring.flatMap((from, i) => {
    const to = ring[(i + 1) % 4]!;
    return [...from, ...to, ...top, ...to, ...from, ...low];
  });
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  geometry.computeVertexNormals();
  return geometry;
}

export class Bodies {
  readonly group = new THREE.Group();
  private readonly material = new THREE.MeshLambertMaterial();
  private readonly turned = new THREE.InstancedMesh(shape(true), this.material, ROBOTS_MAX);
  private readonly plain = new THREE.InstancedMesh(shape(false), this.material, ROBOTS_MAX);
  /** Backs of somewhat larger bodies: a rim that sets them off from what is behind. */
  private readonly rims = new THREE.MeshBasicMaterial({ color: 0xffffff, side: THREE.BackSide });
  private readonly turnedRim = new THREE.InstancedMesh(this.turned.geometry, this.rims, ROBOTS_MAX);
  private readonly plainRim = new THREE.InstancedMesh(this.plain.geometry, this.rims, ROBOTS_MAX);
  private readonly trails = new Lines(2.6);
  private readonly links = new Lines(2, 10);
  private readonly points: THREE.Points<THREE.BufferGeometry, THREE.PointsMaterial>;

  constructor(private readonly stage: Stage) {
    const sun = new THREE.DirectionalLight(0xffffff, 2.2);
    sun.position.set(-0.5, -0.8, 1.4);
    const geometry = new THREE.BufferGeometry();
    this.points = new THREE.Points(geometry, new THREE.PointsMaterial({ size: 3, sizeAttenuation: false, vertexColors: true }));
    this.points.frustumCulled = false;
    // Points lie in the voxels that they made: they are drawn somewhat nearer to the eye, at the same place of the screen.
    this.points.material.onBeforeCompile = (shader) => {
      shader.vertexShader = shader.vertexShader.replace(
        "#include <project_vertex>",
        "#include <project_vertex>\nmvPosition.xyz *= 1.0 - min(0.35 / length(mvPosition.xyz), 0.3);\ngl_Position = projectionMatrix * mvPosition;",
      );
    };
    for (const mesh of [this.turned, this.plain, this.turnedRim, this.plainRim]) {
      mesh.frustumCulled = false;
      mesh.count = 0;
    }
    // Robots are seen through what they have mapped around them: rims first, then bodies, both after the map.
    this.material.depthTest = this.rims.depthTest = false;
    for (const [order, meshes] of [[this.turnedRim, this.plainRim], [this.turned, this.plain]].entries()) {
      for (const mesh of meshes) mesh.renderOrder = 1 + order;
    }
    this.group.add(this.turned, this.plain, this.turnedRim, this.plainRim, this.trails.mesh, this.links.mesh, this.points, sun, new THREE.HemisphereLight(0xffffff, 0xa0a0b8, 2.3));
    this.points.visible = false;
  }

  setTheme(dark: boolean): void {
    this.rims.color.setStyle(dark ? "#f2f1fa" : "#ffffff", THREE.LinearSRGBColorSpace);
  }

  resize(): void {
    const { width, height, ratio } = this.stage;
    this.trails.resize(width, height, ratio);
    this.links.resize(width, height, ratio);
    this.points.material.size = 3 * ratio;
  }

  /** Before each frame: bodies are at least some pixels large, so they depend on the camera. */
  place(robots: RobotState[], silent: (robot: RobotState) => boolean): void {
    const { stage } = this;
    let [turned, plain] = [0, 0];
    const matrix = new THREE.Matrix4();
    const colour = new THREE.Color();
    for (const robot of robots) {
      if (!robot.pose) continue;
      const at = new THREE.Vector3(...stage.toScene(robot.pose.at));
      const size = Math.max(BODY, (PIXELS * at.distanceTo(stage.camera.position)) / stage.focal);
      const q = robot.pose.turned ? new THREE.Quaternion(...robot.pose.turned).normalize() : new THREE.Quaternion();
      matrix.compose(at, q, new THREE.Vector3(size, size, size));
      const mesh = robot.pose.turned ? this.turned : this.plain;
      const i = robot.pose.turned ? turned++ : plain++;
      mesh.setMatrixAt(i, matrix);
      (robot.pose.turned ? this.turnedRim : this.plainRim).setMatrixAt(i, matrix.scale(new THREE.Vector3(1.3, 1.3, 1.3)));
      colour.setRGB(...robot.colour, THREE.LinearSRGBColorSpace);
      if (silent(robot)) colour.setRGB(0.5, 0.5, 0.54, THREE.LinearSRGBColorSpace);
      mesh.setColorAt(i, colour);
    }
    for (const [mesh, count] of [[this.turned, turned], [this.plain, plain], [this.turnedRim, turned], [this.plainRim, plain]] as const) {
      mesh.count = count;
      mesh.visible = count > 0;
      mesh.instanceMatrix.needsUpdate = true;
      if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
  }

  setTrails(robots: RobotState[]): void {
    const pieces: Piece[] = [];
    for (const robot of robots) {
      const { points } = robot.trail;
      const n = points.length / 3;
      let before: [number, number, number] | null = null;
      for (let i = 0; i <= n; i++) {
        // The last piece goes on to where the robot is.
        const at = i < n ? (points.slice(3 * i, 3 * i + 3) as [number, number, number]) : robot.pose?.at;
        if (!at) continue;
        const here = this.stage.toScene(at);
        if (before) pieces.push({ a: before, b: here, tint: [...robot.colour, 0.25 + 0.7 * (i / n)] });
        before = here;
      }
    }
    this.trails.set(pieces);
  }

  setLinks(pairs: { a: RobotState; b: RobotState; lost: number }[], good: [number, number, number], bad: [number, number, number]): void {
    this.links.set(
      pairs.map(({ a, b, lost }) => {
        const part = Math.min(1, lost / 0.5);
        const mix = (c: 0 | 1 | 2) => good[c] + part * (bad[c] - good[c]);
        return { a: this.stage.toScene(a.pose!.at), b: this.stage.toScene(b.pose!.at), tint: [mix(0), mix(1), mix(2), 0.9] };
      }),
    );
  }

  setScans(robots: RobotState[]): void {
    const seen = robots.filter((robot) => robot.scan).slice(0, ROBOTS_MAX);
    const total = seen.reduce((sum, robot) => sum + Math.min(POINTS_MAX, robot.scan!.points.length / 3), 0);
    const at = new Float32Array(3 * total);
    const tints = new Float32Array(3 * total);
    let i = 0;
    const p = new THREE.Vector3();
    for (const robot of seen) {
      const scan = robot.scan!;
      const q = new THREE.Quaternion(...scan.turned).normalize();
      const from = new THREE.Vector3(...this.stage.toScene(scan.at));
      for (let k = 0; k + 2 < scan.points.length && i < total; k += 3, i++) {
        p.set(scan.points[k]!, scan.points[k + 1]!, scan.points[k + 2]!).applyQuaternion(q).add(from);
        at.set([p.x, p.y, p.z], 3 * i);
        tints.set(robot.colour.map((c) => 0.6 + 0.4 * c), 3 * i);
      }
    }
    const { geometry } = this.points;
    geometry.dispose();
    geometry.setAttribute("position", new THREE.BufferAttribute(at, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(tints, 3));
    this.points.visible = total > 0;
  }
}
