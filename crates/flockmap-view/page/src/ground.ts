// What lies flat in the scene: the grid under the map, and a slice of it.

import * as THREE from "three";
import type { SliceMessage } from "./protocol";
import type { Stage } from "./stage";

const GRID_LINES = 40;

export class Ground {
  readonly group = new THREE.Group();
  private readonly grid = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ transparent: true }));
  private readonly plane: THREE.Mesh<THREE.PlaneGeometry, THREE.RawShaderMaterial>;
  private texture: THREE.DataTexture | null = null;

  constructor(private readonly stage: Stage) {
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      transparent: true,
      side: THREE.DoubleSide,
      uniforms: {
        states: { value: null },
        unknown: { value: new THREE.Vector4() },
        free: { value: new THREE.Vector4() },
        occupied: { value: new THREE.Vector4() },
      },
      vertexShader: `precision highp float;
uniform mat4 projectionMatrix; uniform mat4 modelViewMatrix;
in vec3 position; in vec2 uv; out vec2 at;
void main() { at = uv; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
      fragmentShader: `precision highp float; precision highp usampler2D;
uniform usampler2D states; uniform vec4 unknown; uniform vec4 free; uniform vec4 occupied;
in vec2 at; out vec4 colour;
void main() {
  uint state = texelFetch(states, ivec2(min(at, 0.999999) * vec2(textureSize(states, 0))), 0).r;
  colour = state == 2u ? occupied : state == 1u ? free : unknown;
}`,
    });
    this.plane = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), material);
    this.plane.frustumCulled = false;
    this.plane.visible = false;
    this.grid.frustumCulled = false;
    this.group.add(this.grid, this.plane);
  }

  /** A grid of 1, 2 or 5 times a power of ten metres under the map. Gives the step. */
  setGrid(bounds: readonly number[], floor: number): number {
    const r = this.stage.voxel;
    const side = Math.max(bounds[3]! - bounds[0]!, bounds[4]! - bounds[1]!) * r;
    const power = 10 ** Math.floor(Math.log10(side / GRID_LINES));
    const step = [1, 2, 5, 10].find((n) => (side * 1.2) / (n * power) <= GRID_LINES)! * power;
    const range = (axis: number): [number, number] => [Math.floor((bounds[axis]! * r) / step) - 1, Math.ceil((bounds[axis + 3]! * r) / step) + 1];
    const [x0, x1] = range(0);
    const [y0, y1] = range(1);
    const z = floor * r - 0.02;
    const points: number[] = [];
    const line = (a: [number, number], b: [number, number]) => points.push(...this.stage.toScene([...a, z]), ...this.stage.toScene([...b, z]));
    for (let x = x0; x <= x1; x++) line([x * step, y0 * step], [x * step, y1 * step]);
    for (let y = y0; y <= y1; y++) line([x0 * step, y * step], [x1 * step, y * step]);
    this.grid.geometry.dispose();
    this.grid.geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
    return step;
  }

  setSlice(slice: SliceMessage | null): void {
    this.texture?.dispose();
    this.texture = null;
    this.plane.visible = slice !== null && slice.width > 0;
    if (!slice || slice.width === 0) return;
    const texture = new THREE.DataTexture(slice.texels, slice.width, slice.height, THREE.RedIntegerFormat, THREE.UnsignedByteType);
    texture.internalFormat = "R8UI";
    texture.unpackAlignment = 1;
    texture.needsUpdate = true;
    this.texture = texture;
    this.plane.material.uniforms.states!.value = texture;
    const r = this.stage.voxel;
    const [width, height] = [slice.width * slice.step * r, slice.height * slice.step * r];
    const low = this.stage.toScene([slice.x * r, slice.y * r, (slice.z + 0.5) * r]);
    this.plane.position.set(low[0] + width / 2, low[1] + height / 2, low[2]);
    this.plane.scale.set(width, height, 1);
  }

  setColours(grid: THREE.Color, opacity: number, unknown: number[], free: number[], occupied: number[]): void {
    this.grid.material.color = grid;
    this.grid.material.opacity = opacity;
    for (const [name, colour] of [["unknown", unknown], ["free", free], ["occupied", occupied]] as const) {
      (this.plane.material.uniforms[name]!.value as THREE.Vector4).fromArray(colour);
    }
  }
}
