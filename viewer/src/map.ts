/** The map: deck.gl draws labels, ellipses, tracks and rays from above, in metres; a basemap may lie beneath. */

import { Deck, type Layer, OrthographicView } from "@deck.gl/core";
import KDBush from "kdbush";
import type { LabelDetails, PlaceDetails, Shot, State } from "./api";
import { classColor, type Color, existenceColor, OUTCOMES, packed, passColor, STATES } from "./colors";
import type { Columns } from "./columns";
import { DiscLayer, type Discs, LinesLayer } from "./meshes";
import { MAX_ZOOM, MIN_ZOOM, type Settings, type View } from "./state";
import { type Box, distinct, flat, type Level, Tracks, within } from "./tracks";

const ELLIPSE_95 = Math.sqrt(5.991464547107979); // Half axis of 95 % of a normal distribution in the plane, in sigmas.
const STREET_M = 9;
const PICK_PX = 12;
const RAYS_FROM_ZOOM = -2;
const CAMERAS_FROM_ZOOM = 1.5;
/** From this many pixels of a metre on ellipses are drawn, and only what is around the view. */
const NEAR_SCALE = 0.8;
const EVERYWHERE: Box = { left: -Infinity, bottom: -Infinity, right: Infinity, top: Infinity };

/** Streets narrower than that have no round ends, which nobody would see. */
const ROUND_FROM_PX = 4;

/** Labels as they are drawn, with ellipses in true scale. */
type Buffers = Discs & { shape: Float32Array };

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
  onLabel(id: number, east: number, north: number): void;
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
  /** Where the selected is, and where somebody moved it. */
  private selected: [number, number][] = [];
  private rays: { shots: Shot[]; misses: Shot[]; to: [number, number] } | null = null;
  private lit: Shot | null = null;
  private labelLayers: Layer[] = [];
  private buffers: Buffers | null = null;
  /** What the layers of labels hold: all of them, or those in a box around the view. */
  private held: Box | null = null;
  private trackLayers: { key: string; box: Box; layers: Layer[] } = { key: "", box: EVERYWHERE, layers: [] };
  private pressed: { x: number; y: number } | null = null;
  /** Of the map in pixels. Asking the element each time would make the browser lay the page out again for every move. */
  private width = 0;
  private height = 0;

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
    this.measureParent();
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
      // The shapes smooth their own edges, and every frame draws all of them: four samples a pixel and a copy of the
      // picture would double the time of a frame where there is no graphics card.
      deviceProps: { type: "webgl", webgl: { antialias: false, preserveDrawingBuffer: false } },
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

  private measureParent(): void {
    this.width = this.parent.clientWidth;
    this.height = this.parent.clientHeight;
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
    const height = this.height;
    const width = this.width - this.covered;
    const inside = x > 0.1 * width && x < 0.9 * width && y > 0.1 * height && y < 0.9 * height;
    if (inside && this.view.zoom >= 1) return;
    const nearer = Math.max(this.view.zoom, zoom);
    this.setView({ east: east + this.covered / 2 / 2 ** nearer, north, zoom: nearer });
  }

  /** How many pixels on the right something lies over the map. */
  private covered = 0;

  cover(px: number): void {
    this.covered = px < this.width / 2 ? px : 0;
  }

  metresPerPixel(): number {
    return 2 ** -this.view.zoom;
  }

  toScreen(east: number, north: number): [number, number] {
    const scale = 2 ** this.view.zoom;
    return [
      this.width / 2 + (east - this.view.east) * scale,
      this.height / 2 - (north - this.view.north) * scale,
    ];
  }

  toGround(x: number, y: number): [number, number] {
    const metres = this.metresPerPixel();
    return [
      this.view.east + (x - this.width / 2) * metres,
      this.view.north - (y - this.height / 2) * metres,
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
    const zoom = Math.log2(Math.min(this.width / width, this.height / height) * 0.88);
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
    this.makeRejected();
    this.makeMarks();
    this.rebuild();
  }

  setTruth(truth: Truth): void {
    this.truth = truth;
    this.makeTruth();
    this.rebuild();
  }

  setRejected(position: Float32Array): void {
    this.rejected = flat(position);
    this.makeRejected();
    this.draw();
  }

  select(at: [number, number] | null, movedTo: [number, number] | null = null): void {
    this.selected = [at, movedTo].filter((place) => place !== null);
    this.rays = null;
    this.lit = null;
    this.makeMarks();
    this.makeRays();
    this.draw();
  }

  showRays(details: LabelDetails | PlaceDetails): void {
    const to: [number, number] = [details.local_m[0], details.local_m[1]];
    this.rays =
      "voters" in details
        ? { shots: details.voters, misses: details.misses, to }
        : { shots: details.passing ?? [], misses: [], to };
    this.makeRays();
    this.draw();
  }

  light(shot: Shot | null): void {
    this.lit = shot;
    this.makeRays();
    this.draw();
  }

  shownRows(): Uint32Array {
    return this.shown;
  }

  /** How many labels are inside the picture now. */
  inView(): number {
    if (!this.index) return 0;
    const [left, top] = this.toGround(0, 0);
    const [right, bottom] = this.toGround(this.width, this.height);
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
    const fill = new Uint32Array(length);
    const line = new Uint32Array(length);
    const shape = new Float32Array(4 * length);
    const around = packed(this.dark ? [16, 20, 26] : [255, 255, 255], 255);
    const again = packed(STATES["check again"], 255);
    this.index = length ? new KDBush(length) : null;
    this.shown.forEach((row, i) => {
      const east = labels.position[3 * row];
      const north = labels.position[3 * row + 1];
      position[3 * i] = east;
      position[3 * i + 1] = north;
      const color = this.labelColor(row);
      const state = this.states[row];
      fill[i] = packed(color, state === "rejected" ? 30 : 255);
      line[i] = state === "rejected" ? packed(color, 230) : state === "check again" ? again : around;
      const major = labels.ellipse[3 * row];
      shape[4 * i] = major;
      shape[4 * i + 1] = Math.cos(labels.ellipse[3 * row + 2]);
      shape[4 * i + 2] = Math.sin(labels.ellipse[3 * row + 2]);
      shape[4 * i + 3] = major > 0 ? labels.ellipse[3 * row + 1] / major : 1;
      this.index!.add(east, north);
    });
    this.index?.finish();
    this.buffers = { length, position, fill, line, shape };
    this.held = null;
    this.trackLayers.key = "";
    this.makeRays();
    this.draw();
  }

  /** The ground that the map shows, widened by a part of its own size on every side. */
  private ground(margin: number): Box {
    const [left, top] = this.toGround(0, 0);
    const [right, bottom] = this.toGround(this.width, this.height);
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
    this.labelLayers = labelLayers(rows ? taken(this.buffers, rows) : this.buffers, near);
  }

  private draw(): void {
    const scale = 2 ** this.view.zoom;
    this.holdLabels();
    // Dots shrink where labels would cover each other; their size changes no buffer.
    // From near they shrink again, so that ellipses show.
    const small = scale < 0.15 ? 2.6 : scale < 1 ? 3.6 : scale < 24 ? 5 : 3.5;
    const layers: (Layer | null)[] = [
      ...this.trackLayersNow(),
      this.truthLayer?.clone({ visible: this.settings.layers.has("truth"), radius: this.view.zoom < 0 ? 5 : 9 } as never) ?? null,
      this.rejectedLayer?.clone({ visible: this.settings.layers.has("rejected"), radius: this.view.zoom < 0 ? 1.5 : 3 } as never) ?? null,
      this.labelLayers[1]?.clone({ visible: this.settings.layers.has("ellipses") }) ?? null,
      ...this.rayLayers.map((layer) => layer.clone({ visible: this.view.zoom > RAYS_FROM_ZOOM })),
      this.labelLayers[0]?.clone({ radius: small, lineWidth: small < 3 ? 0.5 : 1.25 } as never) ?? null,
      ...this.markLayers,
    ];
    this.deck.setProps({ layers });
  }

  private trackLayersNow(): Layer[] {
    const whole = this.tracks.at(this.metresPerPixel());
    const { layers, hiddenPasses } = this.settings;
    if (!whole) return [];
    const showTracks = layers.has("tracks");
    const showCameras = layers.has("cameras") && this.view.zoom > CAMERAS_FROM_ZOOM;
    const key = `${whole.spacing} ${this.dark} ${this.showStreets} ${[...hiddenPasses].join()}`;
    if (this.trackLayers.key !== key || !contains(this.trackLayers.box, this.ground(0))) {
      const box = this.ground(1);
      const level = within(whole, box);
      const drawn = distinct(level, hiddenPasses, level.spacing / 2);
      const rows = level.pass.length;
      const lines = new Uint32Array(rows);
      const dots = new Uint32Array(whole.spacing === 0 ? rows : 0);
      const palette = new Map<number, Color>();
      for (let i = 0; i < rows; i++) {
        const number = level.pass[i];
        if (hiddenPasses.has(number)) continue;
        let color = palette.get(number);
        if (!color) palette.set(number, (color = passColor(number, this.dark)));
        if (drawn[i]) lines[i] = packed(color, 130);
        if (dots.length) dots[i] = packed(color, 200);
      }
      const images: Discs = { length: dots.length, position: level.points, fill: dots, line: dots };
      this.trackLayers = {
        key,
        box: level === whole ? EVERYWHERE : box,
        layers: [
          ...(this.showStreets ? this.streetLayers(within(this.tracks.streets(whole), box)) : []),
          new LinesLayer({ id: `tracks-${level.spacing}`, lines: { points: level.points, colors: lines }, width: 1.5 }),
          ...(dots.length ? [new DiscLayer({ id: `cameras-${level.spacing}`, discs: images, radius: 2 })] : []),
        ],
      };
    }
    const streetPx = Math.max(3, STREET_M / this.metresPerPixel());
    return this.trackLayers.layers.map((layer) => {
      if (layer.id.startsWith("cameras")) return layer.clone({ visible: showCameras });
      if (layer.id.startsWith("tracks-streets")) return layer.clone({ visible: showTracks, width: streetPx } as never);
      if (layer.id.startsWith("tracks-corners")) {
        return layer.clone({ visible: showTracks && streetPx >= ROUND_FROM_PX, radius: streetPx / 2 } as never);
      }
      return layer.clone({ visible: showTracks });
    });
  }

  private showStreets = true;

  /** Whether the ground that was driven is drawn as streets: not over a basemap, which has its own. */
  setStreets(shown: boolean): void {
    this.showStreets = shown;
    this.draw();
  }

  /** Wide, pale lines beneath the tracks, with round ends: what was driven looks like a street. */
  private streetLayers(level: Level): Layer[] {
    const drawn = distinct(level, this.settings.hiddenPasses, Math.max(level.spacing, STREET_M) / 2);
    const color = packed(this.dark ? [34, 42, 51] : [255, 255, 255], 255);
    const corners = new Float32Array(level.points.length);
    let count = 0;
    const corner = (row: number) => corners.set(level.points.subarray(3 * row, 3 * row + 3), 3 * count++);
    const round = level.spacing <= (4 * STREET_M) / ROUND_FROM_PX; // Coarser levels are only seen from too far away.
    drawn.forEach((shown, row) => {
      if (!shown || !round) return;
      if (!drawn[row - 1]) corner(row);
      corner(row + 1);
    });
    const colors = new Uint32Array(drawn.length);
    drawn.forEach((shown, row) => (colors[row] = shown ? color : 0));
    const fill = new Uint32Array(count).fill(color);
    return [
      new LinesLayer({ id: `tracks-streets-${level.spacing}`, lines: { points: level.points, colors } }),
      new DiscLayer({ id: `tracks-corners-${level.spacing}`, discs: { length: count, position: corners.subarray(0, 3 * count), fill, line: fill } }),
    ];
  }

  /** Layers that change with what is shown, never with the view. */
  private truthLayer: Layer | null = null;
  private rejectedLayer: Layer | null = null;
  private rayLayers: Layer[] = [];
  private markLayers: Layer[] = [];

  private makeTruth(): void {
    if (!this.truth || !this.truth.position.length) return;
    const { position, outcome } = this.truth;
    const line = Uint32Array.from(outcome, (number) => packed(OUTCOMES[this.outcomes[number]] ?? OUTCOMES.found, 255));
    this.truthLayer = new DiscLayer({ id: "truth", discs: ringed({ length: outcome.length, position, fill: line, line }), lineWidth: 1.75 });
  }

  private makeRejected(): void {
    if (!this.rejected) return;
    const length = this.rejected.length / 3;
    const fill = new Uint32Array(length).fill(packed(this.dark ? [190, 190, 190] : [90, 90, 90], 150));
    this.rejectedLayer = new DiscLayer({ id: "rejected", discs: { length, position: this.rejected, fill, line: fill } });
  }

  private makeRays(): void {
    this.rayLayers = [];
    if (!this.rays) return;
    const { shots, misses, to } = this.rays;
    const seen = shots.filter((shot) => !this.settings.hiddenPasses.has(shot.pass));
    const ofPass = (opacity: number) => (shot: Shot) => packed(passColor(shot.pass, this.dark), opacity);
    const missed = (opacity: number) => () => packed([213, 94, 0], opacity);
    const lit = () => packed(this.dark ? [255, 255, 255] : [20, 20, 20], 255);
    this.rayLayers = [
      rays("misses", misses, to, missed(70), 1),
      rays("rays", seen, to, ofPass(120), 1),
      new DiscLayer({ id: "missed", discs: cameras(misses, missed(255)), radius: 2.6 }),
      new DiscLayer({ id: "voters", discs: cameras(seen, ofPass(255)), radius: 2.6 }),
      rays("lit", this.lit ? [this.lit] : [], to, lit, 2.5),
    ];
  }

  private makeMarks(): void {
    const position = new Float32Array(this.selected.flatMap((place) => [...place, 0]));
    const line = new Uint32Array(this.selected.length).fill(packed(this.dark ? [255, 255, 255] : [10, 20, 30], 255));
    this.markLayers = [
      new DiscLayer({ id: "selected", discs: ringed({ length: line.length, position, fill: line, line }), radius: 11, lineWidth: 2.5 }),
      new LinesLayer({ id: "moved", lines: { points: position, colors: line }, width: 1.5 }),
    ];
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
      else this.events.onLabel(this.labels.id[row], ...this.toGround(x, y));
    });
    this.parent.addEventListener("pointermove", (event) => {
      const [x, y] = at(event);
      const [east, north] = this.toGround(x, y);
      this.events.onHover(this.pressed ? null : this.pick(x, y), x, y, east, north);
    });
    this.parent.addEventListener("pointerleave", () => this.events.onHover(null, 0, 0, NaN, NaN));
    new ResizeObserver(() => {
      this.measureParent();
      this.draw();
    }).observe(this.parent);
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
    fill: Uint32Array.from(rows, (row) => all.fill[row]),
    line: Uint32Array.from(rows, (row) => all.line[row]),
    shape: new Float32Array(4 * length),
  };
  rows.forEach((row, i) => {
    part.position.set(all.position.subarray(3 * row, 3 * row + 3), 3 * i);
    part.shape.set(all.shape.subarray(4 * row, 4 * row + 4), 4 * i);
  });
  return part;
}

/** Labels as dots, and from near as ellipses: pale, with an outline in the same colour. */
function labelLayers({ length, position, fill, line, shape }: Buffers, near: boolean): Layer[] {
  const dots = new DiscLayer({ id: "labels", discs: { length, position, fill, line } });
  if (!near) return [dots];
  const pale = fill.map((color) => faded(color, 0.22));
  const ellipses = { length, position, fill: pale, line: fill, shape };
  return [dots, new DiscLayer({ id: "ellipses", discs: ellipses, radius: ELLIPSE_95, lineWidth: 1.5 })];
}

/** A packed colour with a part of its opacity. */
const faded = (color: number, part: number): number => ((color & 0xffffff) | (Math.round(part * (color >>> 24)) << 24)) >>> 0;

/** Discs with nothing inside. */
const ringed = (discs: Discs): Discs => ({ ...discs, fill: discs.fill.map((color) => faded(color, 0)) });

/** Discs where cameras were. */
function cameras(shots: Shot[], color: (shot: Shot) => number): Discs {
  const position = new Float32Array(3 * shots.length);
  shots.forEach(({ camera_m }, i) => position.set([camera_m[0], camera_m[1]], 3 * i));
  const fill = Uint32Array.from(shots, color);
  return { length: shots.length, position, fill, line: fill };
}

/** Lines from cameras to a place; none from there to the next camera. */
function rays(id: string, shots: Shot[], to: [number, number], color: (shot: Shot) => number, width: number): Layer {
  const points = new Float32Array(6 * shots.length);
  const colors = new Uint32Array(2 * shots.length);
  shots.forEach((shot, i) => {
    points.set([shot.camera_m[0], shot.camera_m[1], 0, ...to, 0], 6 * i);
    colors[2 * i] = color(shot);
  });
  return new LinesLayer({ id, lines: { points, colors }, width });
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
