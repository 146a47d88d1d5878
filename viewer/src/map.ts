/** The map: deck.gl draws labels, ellipses, tracks and rays from above, in metres; a basemap may lie beneath. */

import { Deck, OrthographicView } from "@deck.gl/core";
import KDBush from "kdbush";
import type { LabelDetails, PlaceDetails, Shot, State } from "./api";
import { classColor, type Color, existenceColor, OUTCOMES, packed, passColor, STATES, UPDATES } from "./colors";
import type { Columns } from "./columns";
import { Drives } from "./drives";
import { Ground, PictureLayer, type Slices } from "./ground";
import { DiscLayer, type Discs, type Lines, LinesLayer } from "./meshes";
import type { Box } from "./parts";
import { MAX_ZOOM, MIN_ZOOM, type Settings, type View } from "./state";
import { ROUND_FROM_PX, spacingAt, STREET_M, streetSpacing } from "./tracks";

const ELLIPSE_95 = Math.sqrt(5.991464547107979); // Half axis of 95 % of a normal distribution in the plane, in sigmas.
const PICK_PX = 12;
const RAYS_FROM_ZOOM = -2;
const CAMERAS_FROM_ZOOM = 1.5;
/** From this many pixels of a metre on ellipses are drawn, and only what is around the view. */
const NEAR_SCALE = 0.8;
const STREET_LEAST_PX = 3;
/** A zoom that has not changed for so long is the one to be painted sharply. */
const REST_MS = 100;

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
  /** What an update says, in words; nothing where there was none. */
  update: (string | undefined)[];
  rowOf: Map<number, number>;
}

export function readLabels(columns: Columns, updates: string[]): Labels {
  const id = columns.get<Float64Array>("id");
  return {
    count: id.length,
    id,
    position: plane(columns.get("position")),
    ellipse: columns.get("ellipse"),
    class: columns.get<Int32Array>("class"),
    votes: columns.get<Int32Array>("votes"),
    passes: columns.get<Int32Array>("passes"),
    existence: columns.get("existence"),
    update: Array.from(columns.get<Int32Array>("state"), (code) => updates[code]),
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
  /** The button is down on a label: it may become a click, or a drag. */
  onPress(id: number): void;
  onPlace(east: number, north: number): void;
  onHover(row: number | null, x: number, y: number, east: number, north: number): void;
  onDrawn(): void;
}

export class MapView {
  private readonly deck: Deck<OrthographicView>;
  private readonly drives: Drives;
  private readonly ground = new Ground();
  /** Changes whenever the ground is to be painted anew. */
  private content = 0;
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
  private buffers: Buffers | null = null;
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
    this.measureParent();
    this.settings = settings;
    this.states = states;
    this.around = boundsOf([this.labels.position, cameras.rows("position") ? plane(cameras.get("position")) : new Float32Array()]);
    this.view = view ?? this.fitting();
    this.drives = new Drives(cameras, () => this.repaint());
    this.drives.hide(settings.hiddenPasses);
    this.deck = new Deck({
      parent: parent as HTMLDivElement,
      style: { position: "absolute", inset: "0" } as never,
      views: new OrthographicView({ id: "plan", flipY: false }),
      viewState: this.deckView(),
      controller: { doubleClickZoom: false, keyboard: false, scrollZoom: { speed: 0.02, smooth: false }, inertia: false },
      useDevicePixels: true,
      effects: [this.ground],
      layerFilter: this.ground.drawn as never,
      // The shapes smooth their own edges: four samples a pixel and a copy of the picture would double the time of a
      // frame where there is no graphics card.
      deviceProps: { type: "webgl", webgl: { antialias: false, preserveDrawingBuffer: false } },
      onViewStateChange: ({ viewState }) => {
        const [east, north] = viewState.target as number[];
        this.setView({ east, north, zoom: viewState.zoom as number });
      },
      onAfterRender: () => this.wasDrawn(),
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
    const zoom = Math.min(MAX_ZOOM, Math.max(MIN_ZOOM, view.zoom));
    if (zoom !== this.view.zoom) {
      clearTimeout(this.zooming);
      this.zooming = window.setTimeout(() => {
        this.zooming = 0;
        this.draw();
      }, REST_MS);
    }
    this.view = { ...view, zoom };
    this.draw();
    this.events.onView(this.view);
  }

  /** The timer while somebody zooms. */
  private zooming = 0;

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

  private deckView({ east, north, zoom } = this.view) {
    return {
      target: [east, north, 0] as [number, number, number],
      zoom,
      minZoom: MIN_ZOOM,
      maxZoom: MAX_ZOOM,
    };
  }

  /** The bounds of everything there is. */
  private readonly around: Box;

  private fitting(): View {
    const box = this.around;
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
    this.rejected = plane(position);
    this.makeRejected();
    this.repaint();
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
    if (settings.colorBy === "update") return UPDATES[labels.update[row] ?? ""] ?? STATES.open;
    if (settings.colorBy === "outcome") {
      return OUTCOMES[this.outcomes[this.truth?.labelOutcome[row] ?? 0]] ?? STATES.open;
    }
    // Whether it was there is sure; that it is no longer is what matters.
    return labels.update[row] === "gone" ? UPDATES.gone : existenceColor(labels.existence[row], this.dark);
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
      !s.hiddenUpdates.has(labels.update[row] ?? "") &&
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
    const position = new Float32Array(2 * length);
    const fill = new Uint32Array(length);
    const line = new Uint32Array(length);
    const shape = new Float32Array(4 * length);
    const around = packed(this.dark ? [16, 20, 26] : [255, 255, 255], 255);
    const again = packed(STATES["check again"], 255);
    this.index = length ? new KDBush(length) : null;
    this.shown.forEach((row, i) => {
      const east = labels.position[2 * row];
      const north = labels.position[2 * row + 1];
      position[2 * i] = east;
      position[2 * i + 1] = north;
      const color = this.labelColor(row);
      const state = this.states[row];
      // Rings are what does not count: it was rejected, or is gone.
      const hollow = state === "rejected" || labels.update[row] === "gone";
      fill[i] = packed(color, hollow ? 30 : 255);
      line[i] = hollow ? packed(color, 230) : state === "check again" ? again : around;
      const major = labels.ellipse[3 * row];
      shape[4 * i] = major;
      shape[4 * i + 1] = Math.cos(labels.ellipse[3 * row + 2]);
      shape[4 * i + 2] = Math.sin(labels.ellipse[3 * row + 2]);
      shape[4 * i + 3] = major > 0 ? labels.ellipse[3 * row + 1] / major : 1;
      this.index!.add(east, north);
    });
    this.index?.finish();
    this.buffers = { length, position, fill, line, shape };
    this.drives.hide(this.settings.hiddenPasses);
    this.makeRays();
    this.repaint();
    this.filtered = this.content;
  }

  /** The content of the ground since the labels were filtered last. */
  private filtered = Infinity;

  /** The labels in a box, in the order in which they are drawn. */
  private labelsIn({ left, bottom, right, top }: Box): Buffers | null {
    if (!this.buffers || !this.index) return null;
    const rows = this.index.range(left, bottom, right, top);
    return rows.length === this.buffers.length ? this.buffers : taken(this.buffers, Uint32Array.from(rows).sort());
  }

  private readonly wanted = () => ({ view: this.view, width: this.width, height: this.height, content: this.content });

  /** Paint the ground anew: something else is to be seen on it. */
  private repaint(): void {
    this.content++;
    this.draw();
  }

  private draw(): void {
    const { ground, view } = this;
    const wanted = this.wanted();
    if (!this.zooming || !ground.servesZoom(wanted)) ground.need(wanted, (size, slices) => this.groundLayers(view, size, slices));
    const aligned = ground.aligned(view);
    const layers = [
      ...ground.layers,
      new PictureLayer({ id: "picture", ground, place: ground.place(aligned, this.width, this.height), parameters: { blend: false, depthCompare: "always" } }),
      ...this.rayLayers(),
      new DiscLayer({ id: "selected", discs: this.marks.at, radius: 11, lineWidth: 2.5 }),
      new LinesLayer({ id: "moved", lines: this.marks.moved, width: 1.5 }),
    ];
    this.deck.setProps({ layers, viewState: this.deckView(aligned) });
  }

  private wasDrawn(): void {
    this.events.onDrawn();
    const { ground } = this;
    if (ground.texture === this.picture) return;
    this.picture = ground.texture;
    this.draw();
  }

  private picture: unknown = null;

  /** What lies still, as it is painted for a view. */
  private groundLayers(view: View, [width, height]: [number, number], slices: Slices): (DiscLayer | LinesLayer)[] {
    const scale = 2 ** view.zoom;
    // Dots shrink where labels would cover each other. From near they shrink again, so that ellipses show.
    const radius = scale < 0.15 ? 2.6 : scale < 1 ? 3.6 : scale < 24 ? 5 : 3.5;
    const { layers } = this.settings;
    const [x, y] = [width / 2 / scale, height / 2 / scale];
    const discs = this.labelsIn({ left: view.east - x, bottom: view.north - y, right: view.east + x, top: view.north + y });
    const shaped = discs && scale > NEAR_SCALE && layers.has("ellipses") ? discs : null;
    // Ellipses are pale, with an outline in the same colour.
    const ellipses = shaped && { ...shaped, fill: shaped.fill.map((color) => faded(color, 0.22)), line: shaped.fill };
    return [
      ...this.trackLayers(view, slices),
      new DiscLayer({ id: "truth", slices, discs: this.truthDiscs, lineWidth: 1.75, visible: layers.has("truth"), radius: view.zoom < 0 ? 5 : 9 }),
      new DiscLayer({ id: "rejected", slices, discs: this.rejectedDiscs, visible: layers.has("rejected"), radius: view.zoom < 0 ? 1.5 : 3 }),
      new DiscLayer({ id: "ellipses", slices, discs: ellipses, shaped: true, radius: ELLIPSE_95, lineWidth: 1.5 }),
      new DiscLayer({ id: "labels", slices, discs, radius, lineWidth: radius < 3 ? 0.5 : 1.25 }),
    ];
  }

  /** Whether all labels that the filters leave are drawn. */
  labelsDrawn(): boolean {
    return this.ground.has(this.filtered);
  }

  /** Whether everything in view is drawn, as finely as it will be. */
  settled(): boolean {
    return !this.drives.waiting && !this.ground.painting && this.ground.shows(this.wanted());
  }

  private trackLayers(view: View, slices: Slices): (DiscLayer | LinesLayer)[] {
    const metres = 2 ** -view.zoom;
    const { layers } = this.settings;
    this.drives.need(spacingAt(metres));
    const level = this.drives.at(spacingAt(metres), this.dark);
    const streets = level && this.drives.at(streetSpacing(level.spacing), this.dark);
    const streetPx = Math.max(STREET_LEAST_PX, STREET_M / metres);
    const visible = layers.has("tracks");
    const visibleStreets = visible && this.showStreets;
    const showImages = layers.has("cameras") && view.zoom > CAMERAS_FROM_ZOOM;
    return [
      new LinesLayer({ id: "streets", slices, lines: streets && streets.streets, width: streetPx, visible: visibleStreets }),
      new DiscLayer({ id: "corners", slices, discs: streets && streets.corners, radius: streetPx / 2, visible: visibleStreets && streetPx >= ROUND_FROM_PX }),
      new LinesLayer({ id: "tracks", slices, lines: level && level.tracks, width: 1.5, visible }),
      new DiscLayer({ id: "cameras", slices, discs: level && level.images, radius: 2, visible: showImages }),
    ];
  }

  private showStreets = true;

  /** Whether the ground that was driven is drawn as streets: not over a basemap, which has its own. */
  setStreets(shown: boolean): void {
    this.showStreets = shown;
    this.repaint();
  }

  /** What changes with what is shown, never with the view. */
  private truthDiscs: Discs | null = null;
  private rejectedDiscs: Discs | null = null;
  private rayMeshes: { missed: Lines; seen: Lines; lit: Lines; misses: Discs; voters: Discs } | null = null;
  private marks: { at: Discs | null; moved: Lines | null } = { at: null, moved: null };

  private makeTruth(): void {
    if (!this.truth || !this.truth.position.length) return;
    const { position, outcome } = this.truth;
    const line = Uint32Array.from(outcome, (number) => packed(OUTCOMES[this.outcomes[number]] ?? OUTCOMES.found, 255));
    // What was not found is filled: not by its colour alone is it told from what was.
    const fill = line.map((color, i) => faded(color, this.outcomes[outcome[i]] === "found" ? 0 : 0.35));
    this.truthDiscs = { length: outcome.length, position, fill, line };
  }

  private makeRejected(): void {
    if (!this.rejected) return;
    const length = this.rejected.length / 2;
    const fill = new Uint32Array(length).fill(packed(this.dark ? [190, 190, 190] : [90, 90, 90], 150));
    this.rejectedDiscs = { length, position: this.rejected, fill, line: fill };
  }

  private makeRays(): void {
    this.rayMeshes = null;
    if (!this.rays) return;
    const { shots, misses, to } = this.rays;
    const seen = shots.filter((shot) => !this.settings.hiddenPasses.has(shot.pass));
    const ofPass = (opacity: number) => (shot: Shot) => packed(passColor(shot.pass, this.dark), opacity);
    const missed = (opacity: number) => () => packed([213, 94, 0], opacity);
    const lit = () => packed(this.dark ? [255, 255, 255] : [20, 20, 20], 255);
    this.rayMeshes = {
      missed: rays(misses, to, missed(70)),
      seen: rays(seen, to, ofPass(120)),
      lit: rays(this.lit ? [this.lit] : [], to, lit),
      misses: cameras(misses, missed(255)),
      voters: cameras(seen, ofPass(255)),
    };
  }

  private rayLayers(): (DiscLayer | LinesLayer)[] {
    const visible = this.view.zoom > RAYS_FROM_ZOOM;
    const { rayMeshes: meshes } = this;
    return [
      new LinesLayer({ id: "rays-missed", lines: meshes && meshes.missed, width: 1, visible }),
      new LinesLayer({ id: "rays", lines: meshes && meshes.seen, width: 1, visible }),
      new DiscLayer({ id: "misses", discs: meshes && meshes.misses, radius: 2.6, visible }),
      new DiscLayer({ id: "voters", discs: meshes && meshes.voters, radius: 2.6, visible }),
      new LinesLayer({ id: "lit", lines: meshes && meshes.lit, width: 2.5, visible }),
    ];
  }

  private makeMarks(): void {
    const ends = new Float32Array(this.selected.flat());
    const length = this.selected.length;
    const line = new Uint32Array(length).fill(packed(this.dark ? [255, 255, 255] : [10, 20, 30], 255));
    this.marks = {
      at: ringed({ length, position: ends, fill: line, line }),
      moved: length === 2 ? { length: 1, ends, colors: line } : null,
    };
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
      const away = Math.hypot(this.labels.position[2 * row] - east, this.labels.position[2 * row + 1] - north);
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
      const row = this.pressed && this.pick(x, y);
      if (row !== null) this.events.onPress(this.labels.id[row]);
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

function taken(all: Buffers, rows: Uint32Array): Buffers {
  const length = rows.length;
  const part: Buffers = {
    length,
    position: new Float32Array(2 * length),
    fill: rows.map((row) => all.fill[row]),
    line: rows.map((row) => all.line[row]),
    shape: new Float32Array(4 * length),
  };
  rows.forEach((row, i) => {
    part.position.set(all.position.subarray(2 * row, 2 * row + 2), 2 * i);
    part.shape.set(all.shape.subarray(4 * row, 4 * row + 4), 4 * i);
  });
  return part;
}

/** A packed colour with a part of its opacity. */
const faded = (color: number, part: number): number => ((color & 0xffffff) | (Math.round(part * (color >>> 24)) << 24)) >>> 0;

/** Discs with nothing inside. */
const ringed = (discs: Discs): Discs => ({ ...discs, fill: discs.fill.map((color) => faded(color, 0)) });

/** Discs where cameras were. */
function cameras(shots: Shot[], color: (shot: Shot) => number): Discs {
  const fill = Uint32Array.from(shots, color);
  const position = new Float32Array(shots.flatMap(({ camera_m: [east, north] }) => [east, north]));
  return { length: shots.length, position, fill, line: fill };
}

/** Lines from cameras to a place. */
function rays(shots: Shot[], to: [number, number], color: (shot: Shot) => number): Lines {
  const ends = new Float32Array(shots.flatMap(({ camera_m: [east, north] }) => [east, north, ...to]));
  return { length: shots.length, ends, colors: Uint32Array.from(shots, color) };
}

/** East and north of points that have a third number. */
export function plane(position: Float32Array): Float32Array {
  const rows = position.length / 3;
  const points = new Float32Array(2 * rows);
  for (let i = 0; i < rows; i++) {
    points[2 * i] = position[3 * i];
    points[2 * i + 1] = position[3 * i + 1];
  }
  return points;
}

/** The bounds of points; a place for none. */
function boundsOf(arrays: Float32Array[]): Box {
  const box = { left: Infinity, right: -Infinity, bottom: Infinity, top: -Infinity };
  for (const points of arrays) {
    for (let i = 0; i < points.length; i += 2) {
      box.left = Math.min(box.left, points[i]);
      box.right = Math.max(box.right, points[i]);
      box.bottom = Math.min(box.bottom, points[i + 1]);
      box.top = Math.max(box.top, points[i + 1]);
    }
  }
  return box.left <= box.right ? box : { left: -10, right: 10, bottom: -10, top: 10 };
}
