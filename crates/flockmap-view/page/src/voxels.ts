// The meshes of the map: one draw for each node, faces of 8 bytes, one material for all.
//
// The vertex shader reads its face from a texture, by the number of the vertex. Instanced quads would need no texture, but software
// renderers take each instance for a draw of its own, which was some 10 µs a face.

import * as THREE from "three";
import { OLDER, RAMP, ramp } from "./colours";
import { ROW_FACES } from "./mesher";
import type { MeshMessage } from "./protocol";

export type Colouring = "height" | "robot" | "age";
export const ROBOTS_SHOWN = 33;

const VERTEX = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D faces;
uniform float cell;
uniform vec3 origin;
uniform vec2 heights;
uniform float cut;
uniform float clock;
uniform int colouring;
uniform vec3 ramps[${2 * RAMP}];
uniform vec3 robots[${ROBOTS_SHOWN}];
uniform vec3 older;
uniform float light[6];
out vec3 tint;
out vec2 place;
out float shade;
flat out float side;

vec3 along(int from, float at) {
  float step = clamp(at, 0.0, 1.0) * ${RAMP - 1}.0;
  int low = min(int(step), ${RAMP - 2});
  return mix(ramps[from + low], ramps[from + low + 1], step - float(low));
}

void main() {
  int number = gl_VertexID >> 2;
  uvec2 face = texelFetch(faces, ivec2(number % ${ROW_FACES}, number / ${ROW_FACES}), 0).rg;
  uint a = face.x;
  uint b = face.y;
  vec3 at = vec3(float(a & 63u), float((a >> 6) & 63u), float((a >> 12) & 63u));
  int direction = int((a >> 18) & 7u);
  uint shades = b >> 24;
  vec4 s = vec4(float(shades & 3u), float((shades >> 2) & 3u), float((shades >> 4) & 3u), float(shades >> 6)) / 3.0;
  // The diagonal goes where it does not bend the shade; then the way round makes the outside the front.
  int corner = gl_VertexID & 3;
  if (s.x + s.w > s.y + s.z) corner = corner == 0 ? 1 : corner == 1 ? 3 : corner == 3 ? 2 : 0;
  if (direction == 0 || direction == 3 || direction == 4) corner = corner == 1 ? 2 : corner == 2 ? 1 : corner;
  float u = float(corner & 1);
  float v = float(corner >> 1);
  shade = corner == 0 ? s.x : corner == 1 ? s.y : corner == 2 ? s.z : s.w;
  int axis = direction >> 1;
  float outside = float(direction & 1);
  vec3 p = at + (axis == 0 ? vec3(outside, u, v) : axis == 1 ? vec3(u, outside, v) : vec3(u, v, outside));
  float low = origin.z + at.z * cell;
  vec3 local = p * cell;
  local.z = min(local.z, cut - origin.z);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(local, 1.0);
  // A face whose cell is above the cut goes where nothing is drawn.
  if (low >= cut) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  place = vec2(u, v);
  side = cell;
  float high = clamp((low + 0.5 * cell - heights.x) / max(heights.y - heights.x, 1.0), 0.0, 1.0);
  vec3 colour;
  if (colouring == 1) {
    // What is higher is lighter: one colour alone would have no shape.
    colour = mix(robots[min(int(a >> 21 & 255u), ${ROBOTS_SHOWN - 1})] * (0.78 + 0.22 * high), vec3(1.0), 0.32 * high);
  } else if (colouring == 2) {
    float born = float(b & 0xffffffu);
    colour = born == 0.0 ? older : along(${RAMP}, log(1.0 + max(clock - born, 0.0) / 10.0) / log(601.0));
  } else {
    colour = along(0, high);
  }
  tint = colour * light[direction];
}`;

const FRAGMENT = /* glsl */ `
precision highp float;
in vec3 tint;
in vec2 place;
in float shade;
flat in float side;
uniform vec3 section;
out vec4 colour;

void main() {
  if (!gl_FrontFacing) {
    colour = vec4(section, 1.0);
    return;
  }
  vec2 width = fwidth(place);
  float size = max(width.x, width.y);
  vec2 near = min(place, 1.0 - place);
  vec2 line = smoothstep(width * 0.4, width * 1.3, near);
  // Edges fade where a cell is only some pixels wide.
  float edge = (1.0 - line.x * line.y) * 0.3 * (1.0 - smoothstep(0.06, 0.16, size));
  colour = vec4(tint * (0.62 + 0.38 * shade) * (1.0 - edge), 1.0);
}`;

/** Two triangles for each face, shared by all meshes up to a number of faces. */
const indexes = new Map<number, THREE.BufferAttribute>();

function indexFor(faces: number): THREE.BufferAttribute {
  const size = Math.max(4_096, 2 ** Math.ceil(Math.log2(Math.max(faces, 1))));
  let index = indexes.get(size);
  if (!index) {
    const quads = new Uint32Array(6 * size);
    for (let i = 0; i < size; i++) quads.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    indexes.set(size, (index = new THREE.BufferAttribute(quads, 1)));
  }
  return index;
}

interface Of {
  cell: number;
  origin: [number, number, number];
  faces: number;
  texture: THREE.DataTexture;
}

export class Voxels {
  readonly group = new THREE.Group();
  /** Faces of all meshes that are held, shown or not. */
  held = 0;
  private readonly material: THREE.RawShaderMaterial;
  private readonly meshes = new Map<number, THREE.Mesh<THREE.BufferGeometry>>();
  private shown = new Set<number>();
  private voxel = 1;
  private readonly offset = new THREE.Vector3();

  constructor() {
    const ramps = new Float32Array(6 * RAMP);
    ramps.set(ramp("height"));
    ramps.set(ramp("age"), 3 * RAMP);
    this.material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: "uniform mat4 projectionMatrix;\nuniform mat4 modelViewMatrix;\n" + VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        faces: { value: null },
        cell: { value: 1 },
        origin: { value: new THREE.Vector3() },
        heights: { value: new THREE.Vector2(0, 1) },
        cut: { value: 1e9 },
        clock: { value: 0 },
        colouring: { value: 0 },
        ramps: { value: ramps },
        robots: { value: new Float32Array(3 * ROBOTS_SHOWN).fill(0.5) },
        older: { value: new THREE.Vector3(...OLDER) },
        light: { value: new Float32Array(6) },
        section: { value: new THREE.Color(0.2, 0.2, 0.25) },
      },
    });
    this.group.matrixAutoUpdate = false;
  }

  /** Side of a voxel, and the voxel at which the scene has its zero: so that coordinates on the graphics card stay small. */
  setFrame(voxel: number, origin: THREE.Vector3): void {
    this.voxel = voxel;
    this.offset.copy(origin);
    for (const mesh of this.meshes.values()) this.placeMesh(mesh);
  }

  put(message: MeshMessage): void {
    const before = this.meshes.get(message.id);
    if (before) this.drop(message.id, false);
    if (message.faces === 0) return;
    const { faces, words } = message;
    const texture = new THREE.DataTexture(words, ROW_FACES, words.length / (2 * ROW_FACES), THREE.RGIntegerFormat, THREE.UnsignedIntType);
    texture.internalFormat = "RG32UI";
    texture.needsUpdate = true;
    // The graphics card has them then; nobody else needs them.
    texture.onUpdate = () => ((texture.image as { data: unknown }).data = null);
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(indexFor(faces));
    geometry.setDrawRange(0, 6 * faces);
    const cell = 2 ** message.level;
    const half = 32 * cell;
    geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(half, half, half), half * Math.sqrt(3));
    const mesh = new THREE.Mesh(geometry, this.material);
    mesh.matrixAutoUpdate = false;
    const of: Of = { cell, origin: message.origin, faces, texture };
    mesh.userData = of;
    this.placeMesh(mesh);
    mesh.onBeforeRender = () => {
      const { uniforms } = this.material;
      uniforms.cell!.value = cell;
      uniforms.faces!.value = texture;
      (uniforms.origin!.value as THREE.Vector3).set(...of.origin);
      this.material.uniformsNeedUpdate = true;
    };
    this.meshes.set(message.id, mesh);
    this.held += faces;
    if (this.shown.has(message.id)) this.group.add(mesh);
  }

  show(ids: number[], drop: number[]): void {
    for (const id of drop) this.drop(id, true);
    const next = new Set(ids);
    for (const id of this.shown) {
      const mesh = this.meshes.get(id);
      if (mesh && !next.has(id)) this.group.remove(mesh);
    }
    for (const id of next) {
      const mesh = this.meshes.get(id);
      if (mesh && mesh.parent === null) this.group.add(mesh);
    }
    this.shown = next;
  }

  set(name: "heights" | "cut" | "clock" | "colouring" | "light" | "section" | "robots", value: unknown): void {
    this.material.uniforms[name]!.value = value;
    if (name === "cut") {
      const side = (value as number) < 1e8 ? THREE.DoubleSide : THREE.FrontSide;
      if (side !== this.material.side) {
        this.material.side = side;
        this.material.needsUpdate = true;
      }
    }
  }

  /** Shown meshes by level, and their faces. */
  counts(): { levels: Record<number, number>; faces: number } {
    const levels: Record<number, number> = {};
    let faces = 0;
    for (const child of this.group.children) {
      const { cell, faces: here } = child.userData as Of;
      const level = Math.log2(cell);
      levels[level] = (levels[level] ?? 0) + 1;
      faces += here;
    }
    return { levels, faces };
  }

  private placeMesh(mesh: THREE.Mesh): void {
    const [x, y, z] = (mesh.userData as Of).origin;
    const r = this.voxel;
    mesh.matrix.makeScale(r, r, r).setPosition((x - this.offset.x) * r, (y - this.offset.y) * r, (z - this.offset.z) * r);
    mesh.matrixWorldNeedsUpdate = true;
  }

  private drop(id: number, forget: boolean): void {
    const mesh = this.meshes.get(id);
    if (!mesh) return;
    this.meshes.delete(id);
    if (forget) this.shown.delete(id);
    this.group.remove(mesh);
    const { faces, texture } = mesh.userData as Of;
    this.held -= faces;
    texture.dispose();
    // The index is shared: it must not go with the first geometry that goes.
    mesh.geometry.setIndex(null);
    mesh.geometry.dispose();
  }
}
