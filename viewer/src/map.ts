/** The map: deck.gl draws labels, ellipses, tracks and rays from above, in metres; a basemap may lie beneath. */

import { Deck, type Layer, OrthographicView } from "@deck.gl/core";
import { LineLayer, ScatterplotLayer } from "@deck.gl/layers";
import KDBush from "kdbush";
import type { LabelDetails, PlaceDetails, Shot, State } from "./api";
import { classColor, type Color, existenceColor, OUTCOMES, passColor, STATES } from "./colors";
import type { Columns } from "./columns";
import { EllipseLayer } from "./ellipses";
import { MAX_ZOOM, MIN_ZOOM, type Settings, type View } from "./state";
import { type Box, flat, type Level, Tracks, within } from "./tracks";

const ELLIPSE_95 = Math.sqrt(5.991464547107979); // Half axis of 95 % of a normal distribution in the plane, in sigmas.
const STREET_M = 9;
const PICK_PX = 12;
const RAYS_FROM_ZOOM = -2;
/** From this many pixels of a metre on ellipses are drawn, and only what is around the view. */
const NEAR_SCALE = 0.8;
const EVERYWHERE: Box = { left: -Infinity, bottom: -Infinity, right: Infinity, top: Infinity };

/** What the GPU reads of labels, in the order in which they are drawn. */
interface Buffers {
  length: number;
  position: Float32Array;
  fill: Uint8Array;
  line: Uint8Array;
  radius: Float32Array;
  shape: Float32Array;
}

export interface Labels {
  count: number;
  id: Float64Array;
  position: Float32Array;
  ellipse: Float32Array;
  class: Int32Array;
  votes: Int32Array;
  passes: Int32Array;
  existence: Float32Array;
  rowOf: Map<number, number>;
}

export function readLabels(columns: Columns): Labels {
  const id = columns.get<Float64Array>("id");
  return {
    count: id.length,
    id,
    position: flat(columns.get("position")),
    ellipse: columns.get("ellipse"),
    class: columns.get<Int32Array>("class"),
    votes: columns.get<Int32Array>("votes"),
    passes: columns.get<Int32Array>("passes"),
    existence: columns.get("existence"),
    rowOf: new Map(Array.from(id, (value, row) => [value, row])),
  };
}

export interface Truth {
  position: Float32Array;
  outcome: Uint8Array;
  labelOutcome: Uint8Array;
}

export interface MapEvents {
  onView(view: View): void;
  onLabel(id: number): void;
  onPlace(east: number, north: number): void;
  onHover(row: number | null, x: number, y: number, east: number, north: number): void;
  onDrawn(): void;
}

export class MapView {
  private readonly deck: Deck<OrthographicView>;
  private readonly tracks: Tracks;
  private view: View;
  private settings: Settings;
  private states: State[];
  private shown: Uint32Array = new Uint32Array();
  private index: KDBush | null = null;
  private dark = false;
  private truth: Truth | null = null;
  private rejected: Float32Array | null = null;
  private selected: { at: [number, number]; row: number | null } | null = null;
  private rays: { shots: Shot[]; misses: Shot[]; to: [number, number] } | null = null;
  private lit: Shot | null = null;
  private labelLayers: Layer[] = [];
  private buffers: Buffers | null = null;
  /** What the layers of labels hold: all of them, or those in a box around the view. */
  private held: Box | null = null;
  private trackLayers: { key: string; box: Box; layers: Layer[] } = { key: "", box: EVERYWHERE, layers: [] };
  private pressed: { x: number; y: number } | null = null;

  constructor(
    private readonly parent: HTMLElement,
    private readonly labels: Labels,
    cameras: Columns,
    private readonly outcomes: string[],
    settings: Settings,
    states: State[],
    view: View | null,
    private readonly events: MapEvents,
  ) {
    this.tracks = new Tracks(cameras);
    this.settings = settings;
    this.states = states;
    this.view = view ?? this.fitting();
    this.deck = new Deck({
      parent: parent as HTMLDivElement,
      style: { position: "absolute", inset: "0" } as never,
      views: new OrthographicView({ id: "plan", flipY: false }),
      viewState: this.deckView(),
      controller: { doubleClickZoom: false, keyboard: false, scrollZoom: { speed: 0.02, smooth: false }, inertia: false },
      useDevicePixels: true,
      onViewStateChange: ({ viewState }) => {
        const [east, north] = viewState.target as number[];
        this.setView({ east, north, zoom: viewState.zoom as number });
      },
      onAfterRender: () => this.events.onDrawn(),
      getCursor: ({ isDragging }) => (isDragging ? "grabbing" : "crosshair"),
      layers: [],
    });
    this.listen();
  }

  // The place

  getView(): View {
    return this.view;
  }

  setView(view: View): void {
    this.view = { ...view, zoom: Math.min(MAX_ZOOM, Math.max(MIN_ZOOM, view.zoom)) };
    this.deck.setProps({ viewState: this.deckView() });
    this.draw();
    this.events.onView(this.view);
  }

  zoomBy(steps: number): void {
    this.setView({ ...this.view, zoom: this.view.zoom + steps });
  }

  panBy(xPx: number, yPx: number): void {
    const metres = this.metresPerPixel();
    this.setView({ ...this.view, east: this.view.east + xPx * metres, north: this.view.north - yPx * metres });
  }

  fit(): void {
    this.setView(this.fitting());
  }

  /** Show a place: the view moves only if it is not well inside, and comes nearer if it is far away. */
  show(east: number, north: number, zoom = 4): void {
    const [x, y] = this.toScreen(east, north);
    const { clientWidth, clientHeight: height } = this.parent;
    const width = clientWidth - this.covered;
    const inside = x > 0.1 * width && x < 0.9 * width && y > 0.1 * height && y < 0.9 * height;
    if (inside && this.view.zoom >= 1) return;
    const nearer = Math.max(this.view.zoom, zoom);
    this.setView({ east: east + this.covered / 2 / 2 ** nearer, north, zoom: nearer });
  }

  /** How many pixels on the right something lies over the map. */
  private covered = 0;

  cover(px: number): void {
    this.covered = px < this.parent.clientWidth / 2 ? px : 0;
  }

  metresPerPixel(): number {
    return 2 ** -this.view.zoom;
  }

  toScreen(east: number, north: number): [number, number] {
    const scale = 2 ** this.view.zoom;
    return [
      this.parent.clientWidth / 2 + (east - this.view.east) * scale,
      this.parent.clientHeight / 2 - (north - this.view.north) * scale,
    ];
  }

  toGround(x: number, y: number): [number, number] {
    const metres = this.metresPerPixel();
    return [
      this.view.east + (x - this.parent.clientWidth / 2) * metres,
      this.view.north - (y - this.parent.clientHeight / 2) * metres,
    ];
  }

  private deckView() {
    return {
      target: [this.view.east, this.view.north, 0] as [number, number, number],
      zoom: this.view.zoom,
      minZoom: MIN_ZOOM,
      maxZoom: MAX_ZOOM,
    };
  }

  private fitting(): View {
    const box = bounds([this.labels.position, this.tracks.levels[this.tracks.levels.length - 1]?.points ?? new Float32Array()]);
    const width = Math.max(20, box.right - box.left);
    const height = Math.max(20, box.top - box.bottom);
    const zoom = Math.log2(Math.min(this.parent.clientWidth / width, this.parent.clientHeight / height) * 0.88);
    return {
      east: (box.left + box.right) / 2,
      north: (box.bottom + box.top) / 2,
      zoom: Math.min(5, Math.max(MIN_ZOOM, zoom)),
    };
  }

  // What is drawn

  setSettings(settings: Settings): void {
    this.settings = settings;
    this.rebuild();
  }

  setStates(states: State[]): void {
    this.states = states;
    this.rebuild();
  }

  setDark(dark: boolean): void {
    this.dark = dark;
    this.rebuild();
  }

  setTruth(truth: Truth): void {
    this.truth = truth;
    const rows = truth.outcome.length;
    this.truthColors = new Uint8Array(4 * rows);
    for (let i = 0; i < rows; i++) {
      this.truthColors.set([...(OUTCOMES[this.outcomes[truth.outcome[i]]] ?? OUTCOMES.found), 255], 4 * i);
    }
    this.rebuild();
  }

  setRejected(position: Float32Array): void {
    this.rejected = flat(position);
    this.rebuild();
  }

  select(at: [number, number] | null, row: number | null = null): void {
    this.selected = at && { at, row };
    this.rays = null;
    this.lit = null;
    this.draw();
  }

  showRays(details: LabelDetails | PlaceDetails): void {
    const to: [number, number] = [details.local_m[0], details.local_m[1]];
    this.rays =
      "voters" in details
        ? { shots: details.voters, misses: details.misses, to }
        : { shots: details.passing ?? [], misses: [], to };
    this.draw();
  }

  light(shot: Shot | null): void {
    this.lit = shot;
    this.draw();
  }

  shownRows(): Uint32Array {
    return this.shown;
  }

  /** How many labels are inside the picture now. */
  inView(): number {
    if (!this.index) return 0;
    const [left, top] = this.toGround(0, 0);
    const [right, bottom] = this.toGround(this.parent.clientWidth, this.parent.clientHeight);
    return this.index.range(left, bottom, right, top).length;
  }

  labelColor(row: number): Color {
    const { labels, settings } = this;
    if (settings.colorBy === "class") return classColor(labels.class[row]);
    if (settings.colorBy === "state") return STATES[this.states[row]];
    if (settings.colorBy === "outcome") {
      return OUTCOMES[this.outcomes[this.truth?.labelOutcome[row] ?? 0]] ?? STATES.open;
    }
    return existenceColor(labels.existence[row], this.dark);
  }

  private isShown(row: number): boolean {
    const { labels, settings: s } = this;
    const existence = labels.existence[row];
    return (
      labels.votes[row] >= s.minVotes &&
      labels.passes[row] >= s.minPasses &&
      !(existence < s.minExistence) &&
      !(existence > s.maxExistence) &&
      !s.hiddenStates.has(this.states[row]) &&
      !this.hiddenCodes.has(labels.class[row])
    );
  }

  private hiddenCodes = new Set<number>();

  setHiddenCodes(codes: Set<number>): void {
    this.hiddenCodes = codes;
  }

  /** Filter labels anew, and fill the buffers that the GPU reads. */
  private rebuild(): void {
    const { labels } = this;
    const rows: number[] = [];
    for (let row = 0; row < labels.count; row++) if (this.isShown(row)) rows.push(row);
    // Doubtful ones are drawn last, so that they are not hidden.
    this.shown = Uint32Array.from(rows).sort((a, b) => (labels.existence[b] || 0) - (labels.existence[a] || 0) || a - b);
    const length = rows.length;
    const position = new Float32Array(3 * length);
    const fill = new Uint8Array(4 * length);
    const line = new Uint8Array(4 * length);
    const radius = new Float32Array(length);
    const shape = new Float32Array(3 * length);
    this.index = length ? new KDBush(length) : null;
    this.shown.forEach((row, i) => {
      const east = labels.position[3 * row];
      const north = labels.position[3 * row + 1];
      position[3 * i] = east;
      position[3 * i + 1] = north;
      const color = this.labelColor(row);
      const rejected = this.states[row] === "rejected";
      fill.set([...color, rejected ? 30 : 255], 4 * i);
      line.set(rejected ? [...color, 230] : this.states[row] === "check again" ? [...STATES["check again"], 255] : this.dark ? [16, 20, 26, 255] : [255, 255, 255, 255], 4 * i);
      const major = labels.ellipse[3 * row];
      radius[i] = ELLIPSE_95 * major;
      shape[3 * i] = Math.cos(labels.ellipse[3 * row + 2]);
      shape[3 * i + 1] = Math.sin(labels.ellipse[3 * row + 2]);
      shape[3 * i + 2] = major > 0 ? labels.ellipse[3 * row + 1] / major : 1;
      this.index!.add(east, north);
    });
    this.index?.finish();
    this.buffers = { length, position, fill, line, radius, shape };
    this.held = null;
    this.trackLayers.key = "";
    this.draw();
  }

  /** The ground that the map shows, widened by a part of its own size on every side. */
  private ground(margin: number): Box {
    const [left, top] = this.toGround(0, 0);
    const [right, bottom] = this.toGround(this.parent.clientWidth, this.parent.clientHeight);
    const [x, y] = [margin * (right - left), margin * (top - bottom)];
    return { left: left - x, right: right + x, bottom: bottom - y, top: top + y };
  }

  /** Hand the GPU what is around the view, anew only when the view leaves that. */
  private holdLabels(): void {
    const near = 2 ** this.view.zoom > NEAR_SCALE;
    const now = near ? this.ground(0) : EVERYWHERE;
    if (!this.buffers || (this.held && contains(this.held, now) && (near || this.held === EVERYWHERE))) return;
    this.held = near ? this.ground(1) : EVERYWHERE;
    const { left, bottom, right, top } = this.held;
    const rows = near && this.index ? this.index.range(left, bottom, right, top).sort((a, b) => a - b) : null;
    this.labelLayers = labelLayers(rows ? taken(this.buffers, rows) : this.buffers);
  }

  private draw(): void {
    const scale = 2 ** this.view.zoom;
    this.holdLabels();
    // Dots shrink where labels would cover each other; their size changes no buffer.
    // From near they shrink again, so that ellipses show.
    const small = scale < 0.15 ? 2.6 : scale < 1 ? 3.6 : scale < 24 ? 5 : 3.5;
    const layers: (Layer | null)[] = [
      ...this.trackLayersNow(),
      this.truthLayer(),
      this.rejectedLayer(),
      this.labelLayers[0]?.clone({ visible: this.settings.layers.has("ellipses") && scale > NEAR_SCALE }) ?? null,
      ...this.rayLayers(),
      this.labelLayers[1]?.clone({ getRadius: small, getLineWidth: small < 3 ? 0.5 : 1.25 } as never) ?? null,
      this.markLayer(),
    ];
    this.deck.setProps({ layers });
  }

  private trackLayersNow(): Layer[] {
    const whole = this.tracks.at(this.metresPerPixel());
    const { layers, hiddenPasses } = this.settings;
    if (!whole) return [];
    const showTracks = layers.has("tracks");
    const showCameras = layers.has("cameras") && this.view.zoom > 1.5;
    const key = `${whole.spacing} ${this.dark} ${this.showStreets} ${[...hiddenPasses].join()}`;
    if (this.trackLayers.key !== key || !contains(this.trackLayers.box, this.ground(0))) {
      const box = this.ground(1);
      const level = within(whole, box);
      const rows = level.pass.length;
      const lines = new Uint8Array(4 * rows);
      const dots = new Uint8Array(4 * rows);
      const palette = new Map<number, Color>();
      for (let i = 0; i < rows; i++) {
        const number = level.pass[i];
        if (hiddenPasses.has(number)) continue;
        let color = palette.get(number);
        if (!color) palette.set(number, (color = passColor(number, this.dark)));
        lines[4 * i] = dots[4 * i] = color[0];
        lines[4 * i + 1] = dots[4 * i + 1] = color[1];
        lines[4 * i + 2] = dots[4 * i + 2] = color[2];
        lines[4 * i + 3] = level.joined[i] ? 130 : 0;
        dots[4 * i + 3] = 200;
      }
      this.trackLayers = {
        key,
        box: level === whole ? EVERYWHERE : box,
        layers: [
          ...(this.showStreets ? this.streetLayers(within(this.tracks.streets(whole), box)) : []),
          wayLines(`tracks-${level.spacing}`, level, lines, { widthUnits: "pixels", getWidth: 1.5 }),
          wayDots(`cameras-${level.spacing}`, level, dots, { radiusUnits: "pixels", getRadius: 2 }),
        ],
      };
    }
    return this.trackLayers.layers.map((layer) => layer.clone({ visible: layer.id.startsWith("cameras") ? showCameras : showTracks }));
  }

  private showStreets = true;

  /** Whether the ground that was driven is drawn as streets: not over a basemap, which has its own. */
  setStreets(shown: boolean): void {
    this.showStreets = shown;
    this.draw();
  }

  /** Wide, pale lines beneath the tracks, with round ends: what was driven looks like a street. */
  private streetLayers(level: Level): Layer[] {
    const rows = level.pass.length;
    const color = this.dark ? [34, 42, 51] : [255, 255, 255];
    const lines = new Uint8Array(4 * rows);
    const ends = new Uint8Array(4 * rows);
    for (let i = 0; i < rows; i++) {
      if (this.settings.hiddenPasses.has(level.pass[i])) continue;
      lines.set([...color, level.joined[i] ? 255 : 0], 4 * i);
      ends.set([...color, 255], 4 * i);
    }
    return [
      wayLines(`tracks-streets-${level.spacing}`, level, lines, { widthUnits: "common", getWidth: STREET_M, widthMinPixels: 3 }),
      wayDots(`tracks-corners-${level.spacing}`, level, ends, { radiusUnits: "common", getRadius: STREET_M / 2, radiusMinPixels: 1.5 }),
    ];
  }

  private truthLayer(): Layer | null {
    if (!this.truth || !this.truth.position.length) return null;
    const rows = this.truth.outcome.length;
    return new ScatterplotLayer({
      id: "truth",
      visible: this.settings.layers.has("truth"),
      data: { length: rows, attributes: { getPosition: { value: this.truth.position, size: 3 }, getLineColor: { value: this.truthColors, size: 4, normalized: true } } } as never,
      radiusUnits: "pixels",
      getRadius: this.view.zoom < 0 ? 5 : 9,
      filled: false,
      stroked: true,
      lineWidthUnits: "pixels",
      getLineWidth: 1.75,
    });
  }

  /** Made once: the same array again uploads nothing when the map moves. */
  private truthColors = new Uint8Array();

  private rejectedLayer(): Layer | null {
    if (!this.rejected) return null;
    return new ScatterplotLayer({
      id: "rejected",
      visible: this.settings.layers.has("rejected"),
      data: { length: this.rejected.length / 3, attributes: { getPosition: { value: this.rejected, size: 3 } } } as never,
      radiusUnits: "pixels",
      getRadius: this.view.zoom < 0 ? 1.5 : 3,
      getFillColor: this.dark ? [190, 190, 190, 150] : [90, 90, 90, 150],
    });
  }

  private rayLayers(): Layer[] {
    if (!this.rays) return [];
    const { shots, misses, to } = this.rays;
    const visible = this.view.zoom > RAYS_FROM_ZOOM;
    const seen = shots.filter((shot) => !this.settings.hiddenPasses.has(shot.pass));
    const lines = (id: string, data: Shot[], getColor: (shot: Shot) => [number, number, number, number], getWidth: number) =>
      new LineLayer<Shot>({
        id,
        visible,
        data,
        getSourcePosition: (shot) => [shot.camera_m[0], shot.camera_m[1], 0],
        getTargetPosition: () => [...to, 0],
        getColor,
        widthUnits: "pixels",
        getWidth,
      });
    return [
      lines("misses", misses, () => [213, 94, 0, 70], 1),
      lines("rays", seen, (shot) => [...passColor(shot.pass, this.dark), 120], 1),
      new ScatterplotLayer<Shot>({
        id: "voters",
        visible,
        data: [...misses, ...seen],
        getPosition: (shot) => [shot.camera_m[0], shot.camera_m[1], 0],
        getFillColor: (shot) => (misses.includes(shot) ? [213, 94, 0, 255] : [...passColor(shot.pass, this.dark), 255]),
        radiusUnits: "pixels",
        getRadius: 2.6,
      }),
      lines("lit", this.lit ? [this.lit] : [], () => (this.dark ? [255, 255, 255, 255] : [20, 20, 20, 255]), 2.5),
    ];
  }

  private markLayer(): Layer | null {
    if (!this.selected) return null;
    return new ScatterplotLayer<{ at: [number, number] }>({
      id: "selected",
      data: [this.selected],
      getPosition: ({ at }) => [...at, 0],
      filled: false,
      stroked: true,
      radiusUnits: "pixels",
      getRadius: 11,
      lineWidthUnits: "pixels",
      getLineWidth: 2.5,
      getLineColor: this.dark ? [255, 255, 255] : [10, 20, 30],
    });
  }

  // What the pointer does. The index on the CPU answers in less than a millisecond, where reading back from the GPU waits.

  /** The row of the label nearest to a pixel, null where there is none close to it. */
  pick(x: number, y: number): number | null {
    if (!this.index) return null;
    const [east, north] = this.toGround(x, y);
    let best: number | null = null;
    let bestAway = Infinity;
    for (const i of this.index.within(east, north, PICK_PX * this.metresPerPixel())) {
      const row = this.shown[i];
      const away = Math.hypot(this.labels.position[3 * row] - east, this.labels.position[3 * row + 1] - north);
      if (away < bestAway) [best, bestAway] = [row, away];
    }
    return best;
  }

  private listen(): void {
    const at = (event: PointerEvent): [number, number] => {
      const box = this.parent.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    this.parent.addEventListener("pointerdown", (event) => {
      const [x, y] = at(event);
      this.pressed = event.button === 0 ? { x, y } : null;
      this.parent.focus({ preventScroll: true });
    });
    this.parent.addEventListener("pointerup", (event) => {
      const [x, y] = at(event);
      const pressed = this.pressed;
      this.pressed = null;
      if (!pressed || Math.hypot(x - pressed.x, y - pressed.y) > 4) return;
      const row = this.pick(x, y);
      if (row === null) this.events.onPlace(...this.toGround(x, y));
      else this.events.onLabel(this.labels.id[row]);
    });
    this.parent.addEventListener("pointermove", (event) => {
      const [x, y] = at(event);
      const [east, north] = this.toGround(x, y);
      this.events.onHover(this.pressed ? null : this.pick(x, y), x, y, east, north);
    });
    this.parent.addEventListener("pointerleave", () => this.events.onHover(null, 0, 0, NaN, NaN));
    new ResizeObserver(() => this.draw()).observe(this.parent);
  }
}

function contains(outer: Box, inner: Box): boolean {
  return outer.left <= inner.left && outer.right >= inner.right && outer.bottom <= inner.bottom && outer.top >= inner.top;
}

function taken(all: Buffers, rows: number[]): Buffers {
  const length = rows.length;
  const part: Buffers = {
    length,
    position: new Float32Array(3 * length),
    fill: new Uint8Array(4 * length),
    line: new Uint8Array(4 * length),
    radius: new Float32Array(length),
    shape: new Float32Array(3 * length),
  };
  rows.forEach((row, i) => {
    part.position.set(all.position.subarray(3 * row, 3 * row + 3), 3 * i);
    part.fill.set(all.fill.subarray(4 * row, 4 * row + 4), 4 * i);
    part.line.set(all.line.subarray(4 * row, 4 * row + 4), 4 * i);
    part.radius[i] = all.radius[row];
    part.shape.set(all.shape.subarray(3 * row, 3 * row + 3), 3 * i);
  });
  return part;
}

function labelLayers({ length, position, fill, line, radius, shape }: Buffers): Layer[] {
  const getPosition = { value: position, size: 3 };
  const getFillColor = { value: fill, size: 4, normalized: true };
  const getLineColor = { value: line, size: 4, normalized: true };
  return [
    new EllipseLayer({
      id: "ellipses",
      data: { length, attributes: { getPosition, getFillColor, getRadius: { value: radius, size: 1 }, getShape: { value: shape, size: 3 } } } as never,
      radiusUnits: "common",
      stroked: false,
      antialiasing: false,
    }),
    new ScatterplotLayer({
      id: "labels",
      data: { length, attributes: { getPosition, getFillColor, getLineColor } } as never,
      radiusUnits: "pixels",
      getRadius: 5,
      lineWidthUnits: "pixels",
      getLineWidth: 1.25,
      stroked: true,
    }),
  ];
}

/** Lines from each image to the next of its pass; `colors` has an opacity of 0 where there is none. */
function wayLines(id: string, { points, pass }: Level, colors: Uint8Array, width: object): Layer {
  return new LineLayer({
    id,
    data: {
      length: Math.max(0, pass.length - 1),
      attributes: {
        getSourcePosition: { value: points, size: 3 },
        getTargetPosition: { value: points, size: 3, offset: 12 },
        getColor: { value: colors, size: 4, normalized: true },
      },
    } as never,
    ...width,
  });
}

/** Dots where images are. */
function wayDots(id: string, { points, pass }: Level, colors: Uint8Array, radius: object): Layer {
  const attributes = { getPosition: { value: points, size: 3 }, getFillColor: { value: colors, size: 4, normalized: true } };
  return new ScatterplotLayer({ id, data: { length: pass.length, attributes } as never, antialiasing: false, ...radius });
}

function bounds(arrays: Float32Array[]) {
  const box = { left: Infinity, right: -Infinity, bottom: Infinity, top: -Infinity };
  for (const points of arrays) {
    for (let i = 0; i < points.length; i += 3) {
      box.left = Math.min(box.left, points[i]);
      box.right = Math.max(box.right, points[i]);
      box.bottom = Math.min(box.bottom, points[i + 1]);
      box.top = Math.max(box.top, points[i + 1]);
    }
  }
  return box.left <= box.right ? box : { left: -10, right: 10, bottom: -10, top: 10 };
}
