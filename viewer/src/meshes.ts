/**
 * Discs, ellipses and lines as plain triangles.
 *
 * deck.gl's own layers draw one small shape many times (instances). Where there is no graphics card, in a virtual machine
 * or over a remote desktop, every instance costs as much as a call of its own: four times what the same triangles cost
 * in one list, and most of what a frame costs.
 */

import { type DefaultProps, Layer, project32 } from "@deck.gl/core";
import { Buffer, type VertexArray } from "@luma.gl/core";
import { Model } from "@luma.gl/engine";
import type { Slices } from "./ground";
import { PART, partsWithin } from "./parts";

/** Discs in the order in which they are drawn. */
export interface Discs {
  length: number;
  /** East and north of each. */
  position: Float32Array;
  /** The colour of each, packed. */
  fill: Uint32Array;
  line: Uint32Array;
  /** For ellipses in metres: the major half axis, cosine and sine of its angle, minor by major. */
  shape?: Float32Array;
  /** Of every part (parts.ts), where it is known. */
  bounds?: Float32Array;
  family?: object;
}

/** Lines in the order in which they are drawn. */
export interface Lines {
  length: number;
  /** East and north of one end, then of the other one. */
  ends: Float32Array;
  /** Packed. */
  colors: Uint32Array;
  bounds?: Float32Array;
  family?: object;
}

/** What discs and lines have in common. */
interface Mesh {
  length: number;
  bounds?: Float32Array;
  /** What the GPU holds of a mesh is kept for later while meshes of its family are drawn. */
  family?: object;
}

const CORNERS = 4;
const INDICES = [0, 1, 2, 2, 1, 3];

/** What a list of triangles for a part reads. */
function rectangles(): Uint16Array {
  const indices = new Uint16Array(INDICES.length * PART);
  for (let i = 0, at = 0; i < PART; i++) for (const index of INDICES) indices[at++] = CORNERS * i + index;
  return indices;
}

/** Each row of some numbers once for every corner. */
function repeated<T extends Float32Array | Uint32Array>(rows: T, size: number, into: T): T {
  for (let from = 0, at = 0; from < rows.length; from += size) {
    for (let corner = 0; corner < CORNERS; corner++) for (let part = 0; part < size; part++) into[at++] = rows[from + part];
  }
  return into;
}

const repeatedNumbers = (numbers: Float32Array, size: number) => repeated(numbers, size, new Float32Array(CORNERS * numbers.length));
const repeatedColors = (colors: Uint32Array) => repeated(colors, 1, new Uint32Array(CORNERS * colors.length));

type Attributes = Record<string, Float32Array | Uint32Array>;

/** A part of a mesh on the GPU. */
interface Part {
  buffers: Buffer[];
  vertices: VertexArray;
  count: number;
}

interface MeshState {
  [key: string]: unknown;
  model: Model;
  indices: Buffer;
  /** By mesh, those that were in view. */
  parts: Map<Mesh, Part[]>;
}

interface MeshProps {
  /** Of a picture, of which a few parts are painted in every frame; what is drawn in every frame has none. */
  slices: Slices | null;
}

interface Shaders {
  vs: string;
  fs: string;
  modules: object[];
}

/** What both kinds have in common: a mesh in parts, which are handed to the GPU once they are in view. */
abstract class MeshLayer<Props extends object> extends Layer<Props & MeshProps> {
  static layerName = "MeshLayer";
  declare state: MeshState;

  protected abstract mesh(): Mesh | null;
  /** What the GPU reads of the rows from one to before the other. */
  protected abstract filled(from: number, to: number): Attributes;
  protected abstract layout(): { name: string; format: "float32x2" | "float32x4" | "unorm8x4" }[];
  protected abstract shaders(): Shaders;
  protected abstract uniforms(): Record<string, Record<string, number>>;
  /** How many pixels a shape reaches beyond its points. */
  protected abstract reachPx(): number;

  getShaders() {
    return super.getShaders(this.shaders());
  }

  initializeState(): void {
    const { device } = this.context;
    // At once, while the page opens: to compile takes long.
    const model = new Model(device, { ...this.getShaders(), id: this.props.id, topology: "triangle-list", bufferLayout: this.layout() });
    const indices = device.createBuffer({ usage: Buffer.INDEX, data: rectangles() });
    this.state = { model, indices, parts: new Map() };
  }

  draw(): void {
    const { state } = this;
    const { slices } = this.props;
    const mesh = this.mesh();
    if (!mesh) return;
    for (const other of [...state.parts.keys()]) if (other !== mesh && (!mesh.family || other.family !== mesh.family)) this.forget(other);
    const inView = this.partsInView(mesh);
    const made = this.partsOf(mesh);
    state.model.shaderInputs.setProps(this.uniforms());
    for (const number of slices ? slices.take(this.id, inView) : inView) {
      const part = (made[number] ??= this.made(number, mesh));
      state.model.vertexArray = part.vertices;
      state.model.setVertexCount(INDICES.length * part.count);
      state.model.draw(this.context.renderPass);
    }
  }

  finalizeState(context: Layer["context"]): void {
    for (const mesh of [...this.state.parts.keys()]) this.forget(mesh);
    this.state.indices.destroy();
    super.finalizeState(context); // It destroys the model.
  }

  private partsOf(mesh: Mesh): Part[] {
    let parts = this.state.parts.get(mesh);
    if (!parts) this.state.parts.set(mesh, (parts = []));
    return parts;
  }

  private partsInView({ length, bounds }: Mesh): number[] {
    const { viewport } = this.context;
    const [left, bottom, right, top] = viewport.getBounds();
    const reach = (this.reachPx() * (right - left)) / viewport.width;
    const box = { left: left - reach, bottom: bottom - reach, right: right + reach, top: top + reach };
    return partsWithin(Math.ceil(length / PART), bounds, box);
  }

  private made(part: number, mesh: Mesh): Part {
    const { device } = this.context;
    const { model, indices } = this.state;
    const [from, to] = [part * PART, Math.min(mesh.length, (part + 1) * PART)];
    const buffers = Object.fromEntries(Object.entries(this.filled(from, to)).map(([name, data]) => [name, device.createBuffer({ data })]));
    const { shaderLayout, bufferLayout } = model.pipeline;
    model.vertexArray = device.createVertexArray({ shaderLayout, bufferLayout });
    model.setIndexBuffer(indices);
    model.setAttributes(buffers);
    return { buffers: Object.values(buffers), vertices: model.vertexArray, count: to - from };
  }

  private forget(mesh: Mesh): void {
    for (const part of this.partsOf(mesh)) {
      if (!part) continue;
      part.vertices.destroy();
      for (const buffer of part.buffers) buffer.destroy();
    }
    this.state.parts.delete(mesh);
  }
}

const discUniforms = `\
layout(std140) uniform discUniforms {
  float radius;
  float lineWidth;
  float minRadius;
} disc;
`;

interface DiscProps {
  discs: Discs | null;
  /** Whether the discs are ellipses. */
  shaped: boolean;
  /** In pixels; for ellipses what the half axes are multiplied with. */
  radius: number;
  /** The width of the outline in pixels. */
  lineWidth: number;
  /** In pixels: ellipses are no smaller than that. */
  minRadius: number;
}

export class DiscLayer extends MeshLayer<DiscProps> {
  static layerName = "DiscLayer";
  static defaultProps: DefaultProps<DiscProps & MeshProps> = {
    slices: { type: "object", value: null, optional: true },
    discs: { type: "object", value: null, optional: true },
    shaped: false,
    radius: 1,
    lineWidth: 0,
    minRadius: 0.5,
  };

  protected shaders() {
    const { shaped } = this.props;
    return {
      vs: `#version 300 es
#define SHADER_NAME disc-vertex
in vec2 centers;
in vec4 fillColors;
in vec4 lineColors;
${shaped ? "in vec4 shapes;" : ""}
out vec2 unit;
flat out vec2 axes;
flat out vec4 fillColor;
flat out vec4 lineColor;

void main(void) {
  vec2 corner = vec2(float(gl_VertexID & 1), float((gl_VertexID >> 1) & 1)) * 2.0 - 1.0;
  ${
    shaped
      ? `axes = max(project_size_to_pixel(disc.radius * shapes.x, UNIT_COMMON) * vec2(1.0, shapes.w), disc.minRadius);
  vec2 along = shapes.yz;`
      : `axes = vec2(disc.radius);
  vec2 along = vec2(1.0, 0.0);`
  }
  axes += 0.5 * disc.lineWidth;
  // One pixel more on every side, for a smooth edge.
  vec2 reach = corner * (axes + 1.0);
  unit = reach / axes;
  vec2 offset = vec2(reach.x * along.x - reach.y * along.y, reach.x * along.y + reach.y * along.x);
  gl_Position = project_position_to_clipspace(vec3(centers, 0.0), vec3(0.0), vec3(0.0), geometry.position);
  gl_Position.xy += project_pixel_size_to_clipspace(offset);
  fillColor = fillColors;
  lineColor = lineColors;
}
`,
      fs: `#version 300 es
#define SHADER_NAME disc-fragment
precision highp float;
in vec2 unit;
flat in vec2 axes;
flat in vec4 fillColor;
flat in vec4 lineColor;
out vec4 fragColor;

void main(void) {
  // How many pixels outside of the edge, to the first order; the slope of \`reach\` is known without asking neighbours.
  float reach = length(unit);
  float outside = (reach - 1.0) * max(reach, 1e-3) / max(length(unit / axes), 1e-9);
  float inside = clamp(0.5 - outside, 0.0, 1.0);
  if (inside == 0.0) discard;
  float onLine = disc.lineWidth > 0.0 ? clamp(0.5 + outside + disc.lineWidth, 0.0, 1.0) : 0.0;
  fragColor = mix(fillColor, lineColor, onLine);
  fragColor.a *= inside;
}
`,
      modules: [project32, uniformModule("disc", discUniforms, ["radius", "lineWidth", "minRadius"])],
    };
  }

  protected mesh(): Discs | null {
    return this.props.discs;
  }

  protected layout() {
    return [
      { name: "centers", format: "float32x2" as const },
      { name: "fillColors", format: "unorm8x4" as const },
      { name: "lineColors", format: "unorm8x4" as const },
      ...(this.props.shaped ? [{ name: "shapes", format: "float32x4" as const }] : []),
    ];
  }

  protected filled(from: number, to: number) {
    const { position, fill, line, shape } = this.props.discs!;
    const attributes: Attributes = {
      centers: repeatedNumbers(position.subarray(2 * from, 2 * to), 2),
      fillColors: repeatedColors(fill.subarray(from, to)),
      lineColors: repeatedColors(line.subarray(from, to)),
    };
    if (this.props.shaped && shape) attributes.shapes = repeatedNumbers(shape.subarray(4 * from, 4 * to), 4);
    return attributes;
  }

  protected reachPx(): number {
    return this.props.radius + this.props.lineWidth + 1;
  }

  protected uniforms() {
    const { radius, lineWidth, minRadius } = this.props;
    return { disc: { radius, lineWidth, minRadius } };
  }
}

const lineUniforms = `\
layout(std140) uniform linesUniforms {
  float widthPixels;
} lines;
`;

interface LineProps {
  lines: Lines | null;
  /** In pixels. */
  width: number;
}

export class LinesLayer extends MeshLayer<LineProps> {
  static layerName = "LinesLayer";
  static defaultProps: DefaultProps<LineProps & MeshProps> = {
    slices: { type: "object", value: null, optional: true },
    lines: { type: "object", value: null, optional: true },
    width: 1,
  };

  protected shaders() {
    return {
      vs: `#version 300 es
#define SHADER_NAME lines-vertex
in vec4 ends;
in vec4 colors;
flat out vec4 lineColor;
out float across;

void main(void) {
  vec4 from = project_position_to_clipspace(vec3(ends.xy, 0.0), vec3(0.0), vec3(0.0), geometry.position);
  vec4 to = project_position_to_clipspace(vec3(ends.zw, 0.0), vec3(0.0), vec3(0.0), geometry.position);
  vec2 along = (to.xy - from.xy) * project.viewportSize;
  along = dot(along, along) > 0.0 ? normalize(along) : vec2(1.0, 0.0);
  gl_Position = (gl_VertexID & 1) == 0 ? from : to;
  // Half a pixel more on both sides, for a smooth edge.
  across = ((gl_VertexID & 2) == 0 ? -0.5 : 0.5) * (lines.widthPixels + 1.0);
  gl_Position.xy += project_pixel_size_to_clipspace(vec2(-along.y, along.x) * across);
  lineColor = colors;
}
`,
      fs: `#version 300 es
#define SHADER_NAME lines-fragment
precision highp float;
flat in vec4 lineColor;
in float across;
out vec4 fragColor;

void main(void) {
  fragColor = lineColor;
  fragColor.a *= clamp(0.5 + 0.5 * lines.widthPixels - abs(across), 0.0, 1.0);
}
`,
      modules: [project32, uniformModule("lines", lineUniforms, ["widthPixels"])],
    };
  }

  protected mesh(): Lines | null {
    return this.props.lines;
  }

  protected layout() {
    return [
      { name: "ends", format: "float32x4" as const },
      { name: "colors", format: "unorm8x4" as const },
    ];
  }

  protected filled(from: number, to: number) {
    const { ends, colors } = this.props.lines!;
    return { ends: repeatedNumbers(ends.subarray(4 * from, 4 * to), 4), colors: repeatedColors(colors.subarray(from, to)) };
  }

  protected reachPx(): number {
    return this.props.width + 1;
  }

  protected uniforms() {
    return { lines: { widthPixels: this.props.width } };
  }
}

export function uniformModule(name: string, source: string, uniforms: string[]) {
  return { name, vs: source, fs: source, uniformTypes: Object.fromEntries(uniforms.map((each) => [each, "f32" as const])) };
}
