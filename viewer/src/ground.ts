/**
 * The ground of the map as a picture: labels, ellipses, tracks and what else lies still is painted once, a few parts in
 * every frame, and a frame of somebody who moves the map draws one rectangle.
 *
 * Without a graphics card a frame costs what its shapes cost, and 50,000 labels with the tracks of 400,000 images cost a
 * third of a second. A picture reaches beyond the view, so that it can be moved. Until the picture of another zoom or of
 * other filters is whole, the one before is shown, as large as it has to be.
 */

import { _LayersPass as LayersPass, type DefaultProps, type Effect, Layer, OrthographicView } from "@deck.gl/core";
import type { Device, Framebuffer } from "@luma.gl/core";
import { Model } from "@luma.gl/engine";
import { uniformModule } from "./meshes";
import type { View } from "./state";

/** So far a picture reaches beyond the view on every side, in pixels of the page. */
const MARGIN_PX = 256;

/** A picture is painted anew when the view has moved by so much: what is left of the margin lasts until it is there. */
const MOVED_PX = 96;

/** By so much (a power of two, a fifth) a picture is stretched while somebody zooms, before another one is painted. */
const STRETCH = 0.25;

/** So many parts (parts.ts) are painted in one frame: without a graphics card they take as long as all the rest of it. */
const PARTS_A_FRAME = 16;

const PASS = "ground";

/** Which parts of a picture are painted in this frame: those of the lowest layers first. */
export class Slices {
  private readonly done = new Map<string, number>();
  private left = 0;
  /** Whether nothing is left to be painted. */
  whole = false;

  begin(): void {
    this.left = PARTS_A_FRAME;
    this.whole = true;
  }

  take(layer: string, parts: number[]): number[] {
    const from = this.done.get(layer) ?? 0;
    const now = parts.slice(from, from + this.left);
    this.done.set(layer, from + now.length);
    this.left -= now.length;
    if (from + now.length < parts.length) this.whole = false;
    return now;
  }
}

/** What a picture shows. */
interface Wanted {
  view: View;
  /** Of the map, in pixels of the page. */
  width: number;
  height: number;
  /** Changes whenever something else is to be painted. */
  content: number;
}

interface Picture extends Wanted {
  /** Of the picture, in pixels of the page. */
  size: [number, number];
  layers: Layer[];
  slices: Slices;
  framebuffer: Framebuffer | null;
}

/** Paints pictures before deck.gl draws the frame. */
export class Ground implements Effect {
  readonly id = PASS;
  readonly props = {};
  private pass: LayersPass | null = null;
  private device: Device | null = null;
  /** The last whole one, and the one that is being painted. */
  private shown: Picture | null = null;
  private next: Picture | null = null;
  private readonly plan = new OrthographicView({ id: PASS, flipY: false });

  setup({ device }: { device: Device }): void {
    this.device = device;
    this.pass = new LayersPass(device, { id: PASS });
  }

  /** The layers of the last picture, which keep what the GPU holds of them. */
  layers: Layer[] = [];

  /** Whether a layer is drawn in a pass: those of pictures in no other than their own. */
  drawn = ({ layer, renderPass }: { layer: Layer; renderPass: string }): boolean => (renderPass === PASS) === this.layers.includes(layer);

  get painting(): boolean {
    return this.next !== null;
  }

  /** Whether the picture shows what is wanted, as sharp as it can be. */
  shows(wanted: Wanted, movedPx = MOVED_PX): boolean {
    const { shown } = this;
    if (!shown || shown.content !== wanted.content || shown.view.zoom !== wanted.view.zoom) return false;
    if (shown.width !== wanted.width || shown.height !== wanted.height) return false;
    const scale = 2 ** wanted.view.zoom;
    return Math.max(Math.abs(wanted.view.east - shown.view.east), Math.abs(wanted.view.north - shown.view.north)) * scale <= movedPx;
  }

  /** Whether the picture will do while somebody zooms. */
  servesZoom({ content, view, width, height }: Wanted): boolean {
    const { shown } = this;
    return !!shown && shown.content === content && shown.width === width && shown.height === height && Math.abs(shown.view.zoom - view.zoom) < STRETCH;
  }

  /** Whether there is a picture of this content or a later one. */
  has(content: number): boolean {
    return this.shown !== null && this.shown.content >= content;
  }

  /** Begin a picture, unless one is being painted that has to be finished first: else somebody who zooms sees none. */
  need(wanted: Wanted, layersOf: (size: [number, number], slices: Slices) => Layer[]): void {
    if (this.next || !wanted.width || !wanted.height || this.shows(wanted)) return;
    const size: [number, number] = [wanted.width + 2 * MARGIN_PX, wanted.height + 2 * MARGIN_PX];
    const slices = new Slices();
    this.layers = layersOf(size, slices);
    this.next = { ...wanted, size, slices, layers: this.layers, framebuffer: null };
  }

  preRender({ layers, onViewportActive }: Parameters<Effect["preRender"]>[0]): void {
    const { device, next } = this;
    if (!device || !next) return;
    const begins = !next.framebuffer;
    next.framebuffer ??= this.blank(next);
    const { view, framebuffer, slices } = next;
    const [width, height] = next.size;
    const target: [number, number, number] = [view.east, view.north, 0];
    slices.begin();
    this.pass!.render({
      pass: PASS,
      layers: layers.filter((layer) => next.layers.includes(layer)),
      viewports: [this.plan.makeViewport({ width, height, viewState: { target, zoom: view.zoom } })!],
      onViewportActive,
      target: framebuffer,
      clearCanvas: begins,
    });
    if (!slices.whole) return;
    this.shown?.framebuffer?.destroy();
    this.shown = next;
    this.next = null;
  }

  cleanup(): void {
    for (const picture of [this.shown, this.next]) picture?.framebuffer?.destroy();
    this.shown = this.next = null;
  }

  /** The view moved by less than a pixel, so that the pixels of the picture fall on those of the screen. */
  aligned(view: View): View {
    const { shown, device } = this;
    if (!shown || !device || shown.view.zoom !== view.zoom) return view;
    const pixels = 2 ** view.zoom * device.canvasContext!.cssToDeviceRatio();
    const onPixel = (at: number, from: number): number => from + Math.round((at - from) * pixels) / pixels;
    return { ...view, east: onPixel(view.east, shown.view.east), north: onPixel(view.north, shown.view.north) };
  }

  /** Where the picture lies in a view: left, bottom, right, top, from -1 to 1. */
  place({ east, north, zoom }: View, width: number, height: number): [number, number, number, number] {
    if (!this.shown) return [0, 0, 0, 0];
    const { view, size } = this.shown;
    const scale = 2 ** zoom;
    const larger = 2 ** (zoom - view.zoom);
    const [x, y] = [(2 * (view.east - east) * scale) / width, (2 * (view.north - north) * scale) / height];
    const [reachX, reachY] = [(size[0] * larger) / width, (size[1] * larger) / height];
    return [x - reachX, y - reachY, x + reachX, y + reachY];
  }

  get texture() {
    return this.shown?.framebuffer?.colorAttachments[0] ?? null;
  }

  private blank({ size }: Picture): Framebuffer {
    const ratio = this.device!.canvasContext!.cssToDeviceRatio();
    const [width, height] = size.map((px) => Math.round(px * ratio));
    const sampler = { minFilter: "linear", magFilter: "linear" } as const;
    const texture = this.device!.createTexture({ format: "rgba8unorm", width, height, sampler });
    return this.device!.createFramebuffer({ width, height, colorAttachments: [texture] });
  }
}

const pictureUniforms = `\
layout(std140) uniform pictureUniforms {
  float left;
  float bottom;
  float right;
  float top;
} picture;
`;

interface PictureProps {
  ground: Ground;
  place: [number, number, number, number];
}

/** The picture in the frame. */
export class PictureLayer extends Layer<PictureProps> {
  static layerName = "PictureLayer";
  static defaultProps: DefaultProps<PictureProps> = { ground: { type: "object", value: null as never }, place: { type: "array", value: [0, 0, 0, 0] } };
  declare state: { model: Model };

  getShaders() {
    return super.getShaders({
      vs: `#version 300 es
#define SHADER_NAME picture-vertex
out vec2 at;

void main(void) {
  at = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1));
  gl_Position = vec4(mix(vec2(picture.left, picture.bottom), vec2(picture.right, picture.top), at), 0.0, 1.0);
}
`,
      fs: `#version 300 es
#define SHADER_NAME picture-fragment
precision highp float;
uniform sampler2D painted;
in vec2 at;
out vec4 fragColor;

void main(void) {
  fragColor = texture(painted, at);
}
`,
      modules: [uniformModule("picture", pictureUniforms, ["left", "bottom", "right", "top"])],
    });
  }

  initializeState(): void {
    this.state = { model: new Model(this.context.device, { ...this.getShaders(), id: this.props.id, topology: "triangle-strip", vertexCount: 4 }) };
  }

  draw(): void {
    const { ground, place } = this.props;
    // The next parts in the next frame.
    if (ground.painting) this.setNeedsRedraw();
    const { texture } = ground;
    if (!texture) return;
    const { model } = this.state;
    const [left, bottom, right, top] = place;
    model.shaderInputs.setProps({ picture: { left, bottom, right, top } });
    model.setBindings({ painted: texture });
    model.draw(this.context.renderPass);
  }
}
