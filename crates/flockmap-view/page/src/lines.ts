// Lines that are some pixels wide, also on large screens: each piece is a quad that the vertex shader turns to the eye.

import * as THREE from "three";

const VERTEX = /* glsl */ `
precision highp float;
uniform mat4 projectionMatrix;
uniform mat4 modelViewMatrix;
uniform vec2 size;
uniform float width;
in vec3 a;
in vec3 b;
in vec4 tint;
out vec4 colour;
out float along;

void main() {
  vec4 from = modelViewMatrix * vec4(a, 1.0);
  vec4 to = modelViewMatrix * vec4(b, 1.0);
  // What lies behind the eye has no place on the screen: the piece ends before it.
  float near = -0.02;
  if (from.z > near && to.z > near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (from.z > near) from = mix(to, from, (near - to.z) / (from.z - to.z));
  if (to.z > near) to = mix(from, to, (near - from.z) / (to.z - from.z));
  vec4 p = projectionMatrix * from;
  vec4 q = projectionMatrix * to;
  vec2 way = (q.xy / q.w - p.xy / p.w) * size;
  float length = max(length(way), 1e-4);
  vec2 beside = vec2(-way.y, way.x) / length;
  float end = float(gl_VertexID & 1);
  vec4 at = mix(p, q, end);
  at.xy += beside * (float(gl_VertexID >> 1) - 0.5) * 2.0 * width / size * at.w;
  gl_Position = at;
  colour = tint;
  along = end * length * 0.5;
}`;

const FRAGMENT = /* glsl */ `
precision highp float;
in vec4 colour;
in float along;
uniform float dash;
out vec4 result;
void main() {
  if (dash > 0.0 && mod(along, dash) > dash * 0.6) discard;
  result = colour;
}`;

export interface Piece {
  a: readonly [number, number, number];
  b: readonly [number, number, number];
  tint: readonly [number, number, number, number];
}

export class Lines {
  readonly mesh: THREE.Mesh<THREE.InstancedBufferGeometry, THREE.RawShaderMaterial>;

  constructor(private readonly width: number, dash = 0) {
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setIndex([0, 1, 2, 2, 1, 3]);
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: { size: { value: new THREE.Vector2(1, 1) }, width: { value: width }, dash: { value: dash } },
      transparent: true,
      depthWrite: false,
      side: THREE.DoubleSide,
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** Pixels of the canvas, and how many of them are one of the page. */
  resize(width: number, height: number, ratio: number): void {
    (this.mesh.material.uniforms.size!.value as THREE.Vector2).set(width * ratio, height * ratio);
    this.mesh.material.uniforms.width!.value = this.width * ratio;
  }

  set(pieces: Piece[]): void {
    this.mesh.visible = pieces.length > 0;
    const [a, b, tint] = [new Float32Array(3 * pieces.length), new Float32Array(3 * pieces.length), new Float32Array(4 * pieces.length)];
    pieces.forEach((piece, i) => {
      a.set(piece.a, 3 * i);
      b.set(piece.b, 3 * i);
      tint.set(piece.tint, 4 * i);
    });
    const { geometry } = this.mesh;
    geometry.dispose();
    geometry.setAttribute("a", new THREE.InstancedBufferAttribute(a, 3));
    geometry.setAttribute("b", new THREE.InstancedBufferAttribute(b, 3));
    geometry.setAttribute("tint", new THREE.InstancedBufferAttribute(tint, 4));
    geometry.instanceCount = pieces.length;
  }
}
