/**
 * Discs, ellipses and lines as plain triangles.
 *
 * deck.gl's own layers draw one small shape many times (instances). Where there is no graphics card, in a virtual machine
 * or over a remote desktop, every instance costs as much as a call of its own: four times what the same triangles cost
 * in one list, and most of what a frame costs.
 */

import { type DefaultProps, Layer, project32, type UpdateParameters } from "@deck.gl/core";
import { Model } from "@luma.gl/engine";
import { Buffer } from "@luma.gl/core";

/** Discs in the order in which they are drawn. */
export interface Discs {
  length: number;
  /** East, north, 0 of each. */
  position: Float32Array;
  /** The colour of each, packed. */
  fill: Uint32Array;
  line: Uint32Array;
  /** For ellipses in metres: the major half axis, cosine and sine of its angle, minor by major. */
  shape?: Float32Array;
}

/** Lines from each point to the next one; none where the colour is 0. */
export interface Lines {
  points: Float32Array;
  /** Packed, as many as points. */
  colors: Uint32Array;
}

const CORNERS = 4;
const INDICES = [0, 1, 2, 2, 1, 3];

/** What a list of triangles for `count` rectangles reads. */
function rectangles(count: number): Uint32Array {
  const indices = new Uint32Array(INDICES.length * count);
  for (let i = 0, at = 0; i < count; i++) for (const index of INDICES) indices[at++] = CORNERS * i + index;
  return indices;
}

/** Each row of some numbers once for every corner. */
function repeated<T extends Float32Array | Uint32Array>(rows: T, size: number, into: T): T {
  for (let from = 0, at = 0; from < rows.length; from += size) {
    for (let corner = 0; corner < CORNERS; corner++) for (let part = 0; part < size; part++) into[at++] = rows[from + part];
  }
  return into;
}

const repeatedColors = (colors: Uint32Array) => repeated(colors, 1, new Uint32Array(CORNERS * colors.length));

type Attributes = Record<string, Float32Array | Uint32Array>;

interface MeshState {
  [key: string]: unknown;
  model?: Model;
  buffers: Buffer[];
  count: number;
}

interface Shaders {
  vs: string;
  fs: string;
  modules: object[];
}

/** What both kinds have in common: buffers that are filled once, and drawn as one list of triangles. */
abstract class MeshLayer<Props extends object> extends Layer<Props> {
  static layerName = "MeshLayer";
  declare state: MeshState;

  protected abstract filled(): { count: number; attributes: Attributes };
  protected abstract mesh(props: Props): unknown;
  protected abstract layout(): { name: string; format: "float32x2" | "float32x4" | "unorm8x4" }[];
  protected abstract shaders(): Shaders;
  protected abstract uniforms(): Record<string, Record<string, number>>;

  getShaders() {
    return super.getShaders(this.shaders());
  }

  initializeState(): void {
    this.state = { buffers: [], count: 0 };
  }

  updateState({ props, oldProps }: UpdateParameters<this>): void {
    if (this.state.model && this.mesh(props as Props) === this.mesh(oldProps as Props)) return;
    const { device } = this.context;
    const { count, attributes } = this.filled();
    const before = this.state.buffers;
    const indexBuffer = device.createBuffer({ usage: Buffer.INDEX, data: rectangles(count) });
    const buffers = Object.fromEntries(Object.entries(attributes).map(([name, data]) => [name, device.createBuffer({ data })]));
    this.state.buffers = [indexBuffer, ...Object.values(buffers)];
    this.state.count = count;
    if (this.state.model) {
      this.state.model.setAttributes(buffers);
      this.state.model.setIndexBuffer(indexBuffer);
    } else {
      this.state.model = new Model(device, { ...this.getShaders(), id: this.props.id, topology: "triangle-list", bufferLayout: this.layout(), attributes: buffers, indexBuffer });
    }
    this.state.model.setVertexCount(INDICES.length * count);
    for (const buffer of before) buffer.destroy();
  }

  draw(): void {
    const { model, count } = this.state;
    if (!model || !count) return;
    model.shaderInputs.setProps(this.uniforms());
    model.draw(this.context.renderPass);
  }

  finalizeState(context: Layer["context"]): void {
    super.finalizeState(context); // It destroys the model.
    for (const buffer of this.state.buffers) buffer.destroy();
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
  discs: Discs;
  /** In pixels; for ellipses what the half axes are multiplied with. */
  radius: number;
  /** The width of the outline in pixels. */
  lineWidth: number;
  /** In pixels: ellipses are no smaller than that. */
  minRadius: number;
}

export class DiscLayer extends MeshLayer<DiscProps> {
  static layerName = "DiscLayer";
  static defaultProps: DefaultProps<DiscProps> = {
    discs: { type: "object", value: null as never },
    radius: 1,
    lineWidth: 0,
    minRadius: 0.5,
  };

  protected shaders() {
    const shaped = !!this.props.discs.shape;
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

  protected mesh({ discs }: DiscProps): Discs {
    return discs;
  }

  protected layout() {
    return [
      { name: "centers", format: "float32x2" as const },
      { name: "fillColors", format: "unorm8x4" as const },
      { name: "lineColors", format: "unorm8x4" as const },
      ...(this.props.discs.shape ? [{ name: "shapes", format: "float32x4" as const }] : []),
    ];
  }

  protected filled() {
    const { length, position, fill, line, shape } = this.props.discs;
    const attributes: Attributes = {
      centers: repeated(flattened(position), 2, new Float32Array(2 * CORNERS * length)),
      fillColors: repeatedColors(fill),
      lineColors: repeatedColors(line),
    };
    if (shape) attributes.shapes = repeated(shape, 4, new Float32Array(shape.length * CORNERS));
    return { count: length, attributes };
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
  lines: Lines;
  /** In pixels. */
  width: number;
}

export class LinesLayer extends MeshLayer<LineProps> {
  static layerName = "LinesLayer";
  static defaultProps: DefaultProps<LineProps> = { lines: { type: "object", value: null as never }, width: 1 };

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

  protected mesh({ lines }: LineProps): Lines {
    return lines;
  }

  protected layout() {
    return [
      { name: "ends", format: "float32x4" as const },
      { name: "colors", format: "unorm8x4" as const },
    ];
  }

  protected filled() {
    const { points, colors } = this.props.lines;
    const rows = points.length / 3;
    let count = 0;
    for (let row = 0; row + 1 < rows; row++) if (colors[row]) count++;
    const ends = new Float32Array(4 * count);
    const drawn = new Uint32Array(count);
    for (let row = 0, i = 0; row + 1 < rows; row++) {
      if (!colors[row]) continue;
      ends[4 * i] = points[3 * row];
      ends[4 * i + 1] = points[3 * row + 1];
      ends[4 * i + 2] = points[3 * row + 3];
      ends[4 * i + 3] = points[3 * row + 4];
      drawn[i++] = colors[row];
    }
    return {
      count,
      attributes: { ends: repeated(ends, 4, new Float32Array(CORNERS * ends.length)), colors: repeatedColors(drawn) },
    };
  }

  protected uniforms() {
    return { lines: { widthPixels: this.props.width } };
  }
}

function uniformModule(name: string, source: string, uniforms: string[]) {
  return { name, vs: source, fs: source, uniformTypes: Object.fromEntries(uniforms.map((each) => [each, "f32" as const])) };
}

/** East and north of points that have a third number. */
function flattened(position: Float32Array): Float32Array {
  const rows = position.length / 3;
  const plane = new Float32Array(2 * rows);
  for (let i = 0; i < rows; i++) {
    plane[2 * i] = position[3 * i];
    plane[2 * i + 1] = position[3 * i + 1];
  }
  return plane;
}
