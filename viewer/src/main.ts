/** The page of `valuemap view`: loads a map, and keeps map, panels, address and decisions in step. */

import "./style.css";
import { api, type Head, type LabelDetails, type Lost, type Review, type State, type Verdict, type Wish } from "./api";
import type { Basemap } from "./basemap";
import { css, existenceScale, OUTCOMES, STATES, UPDATES, classColor } from "./colors";
import { type LabelPanel, renderLabel, renderPlace, renderProblem } from "./details";
import { byId, count, fixed, h, plural, probability, say } from "./dom";
import { dot, Filters } from "./filters";
import { geographic } from "./geodesy";
import { type Labels, MapView, plane, readLabels } from "./map";
import type { Gallery } from "./shots";
import { ticks } from "./side";
import { fromHash, type Selection, type Settings, toHash, type View } from "./state";

performance.mark("valuemap:start");
// The token is in a cookie now; in the address it would end up in bookmarks and histories.
if (new URLSearchParams(location.search).has("token")) history.replaceState(null, "", `/${location.hash}`);

/** A pointer that stays on a label for so long will probably click it. */
const REST_MS = 60;

const closed: Review = { label_id: -1, state: "open" };

class Page {
  private readonly settings: Settings;
  private selection: Selection;
  private readonly states: State[];
  private readonly reviews = new Map<number, Review>();
  private readonly labels: Labels;
  private readonly map: MapView;
  private readonly filters: Filters;
  private gallery: Gallery | null = null;
  private labelPanel: LabelPanel | null = null;
  private moving: number | null = null;
  private dark: boolean;
  private basemap: Basemap | null = null;
  private asked = 0;
  private drawn = false;

  constructor(
    private readonly head: Head,
    labels: Awaited<ReturnType<typeof api.labels>>,
    cameras: Awaited<ReturnType<typeof api.cameras>>,
    reviews: { decisions: Review[]; without_label: Lost[] },
  ) {
    this.labels = readLabels(labels, head.states);
    this.sigmaUp = labels.get("sigma_up");
    this.lost = reviews.without_label;
    this.states = new Array<State>(this.labels.count).fill("open");
    for (const review of reviews.decisions) this.keep(review);
    const { settings, view, selection } = fromHash(location.hash, head);
    this.settings = settings;
    this.selection = selection;
    this.dark = localStorage.getItem("theme") ? localStorage.getItem("theme") === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    document.documentElement.dataset.theme = this.dark ? "dark" : "light";
    document.title = `${head.name} - valuemap`;
    this.renderBar();
    this.filters = new Filters(byId("filters"), head, this.labels, settings, {
      onChange: () => this.settingsChanged(),
      onLabel: (id) => void this.openLabel(id),
      onGo: (east, north) => this.map.show(east, north, 5),
    });
    this.filters.render(this.dark);
    this.map = new MapView(byId("deck"), this.labels, cameras, head.outcomes, settings, this.states, view, {
      onView: () => this.viewChanged(),
      // What is moved is often moved by less than its own mark is wide.
      onLabel: (id, east, north) => void (this.moving === null ? this.openLabel(id) : this.clickedPlace(east, north)),
      onPress: (id) => this.expect(id),
      onPlace: (east, north) => void this.clickedPlace(east, north),
      onHover: (row, x, y, east, north) => this.hover(row, x, y, east, north),
      onDrawn: () => this.wasDrawn(),
    });
    this.map.setHiddenCodes(this.hiddenCodes());
    this.map.setDark(this.dark);
    this.updateList();
    this.renderLegend();
    this.viewChanged();
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("hashchange", () => this.addressChanged());
    for (const note of head.notes) say(note);
    void this.loadTheRest();
  }

  private readonly sigmaUp: Float32Array;
  private readonly lost: Lost[];
  /** What became of true objects: what there is of it. */
  private ofObjects = new Set<string>();

  private async loadTheRest(): Promise<void> {
    const { head } = this;
    if (this.selection?.kind === "label") await this.openLabel(this.selection.id, false);
    else if (this.selection) await this.openPlace(this.selection.east, this.selection.north);
    if (head.has.truth) {
      const truth = await api.truth();
      if (truth.has("outcome")) {
        const outcome = truth.get<Uint8Array>("outcome");
        this.map.setTruth({ position: plane(truth.get("position")), outcome, labelOutcome: truth.get<Uint8Array>("label_outcome") });
        this.ofObjects = new Set(Array.from(outcome, (number) => head.outcomes[number]));
        this.renderLegend();
      }
    }
    if (head.has.rejected) this.map.setRejected((await api.rejected()).get("position"));
    if (head.basemap && head.anchor) {
      const { Basemap } = await import("./basemap");
      this.basemap = await Basemap.create(byId("basemap"), head.anchor, head.basemap, this.dark, (text) => {
        byId("attribution").textContent = text;
        byId("attribution").hidden = !text;
      });
      this.basemap.follow(this.map.getView());
      this.map.setStreets(false);
    } else if (head.basemap) say("The map has no geo-reference, so there is no basemap under it.");
  }

  // What is known

  private keep(review: Review): void {
    const row = this.labels.rowOf.get(review.label_id);
    if (row === undefined) return;
    this.reviews.set(review.label_id, review);
    this.states[row] = review.state;
  }

  private hiddenCodes(): Set<number> {
    return new Set(this.head.classes.flatMap((name, code) => (this.settings.hiddenClasses.has(name) ? [code] : [])));
  }

  // The bar on top

  private renderBar(): void {
    const { head } = this;
    const search = h("input", { id: "search", type: "search", inputmode: "numeric", placeholder: "Label id  /", "aria-label": "Search by label id", autocomplete: "off" });
    search.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      const id = Number(search.value.trim());
      if (this.labels.rowOf.has(id)) void this.openLabel(id);
      else say(`There is no label ${search.value.trim()}.`);
      search.setAttribute("aria-invalid", this.labels.rowOf.has(id) ? "false" : "true");
    });
    byId("bar").replaceChildren(
      h("div", { class: "brand" }, h("img", { src: "/icon.svg", alt: "", width: 22, height: 22 }), h("b", {}, "valuemap")),
      h("div", { class: "name", title: head.folder }, h("b", {}, head.name), h("span", { class: "muted" }, ` ${plural(head.counts.labels, "label")}${head.counts.gone ? ` and ${count(head.counts.gone)} gone` : ""}${head.has.dataset ? ` from ${plural(head.counts.detections, "detection")} in ${plural(head.counts.images, "image")}, ${plural(head.passes.length, "pass", "passes")}` : ""}`)),
      h("span", { id: "shown", class: "muted" }),
      search,
      h("button", { id: "menu", title: "Filters and list", "aria-label": "Filters and list", onclick: () => document.body.classList.toggle("filtering") }, "☰"),
      h("button", { title: "Fit everything (0)", "aria-label": "Fit everything", onclick: () => this.map.fit() }, "⤢"),
      h("button", { title: "Light or dark (D)", "aria-label": "Light or dark", onclick: () => this.toggleDark() }, "◐"),
      h("button", { title: "Keys (?)", "aria-label": "Keys", onclick: () => showKeys() }, "?"),
    );
  }

  private renderLegend(): void {
    const { settings, head } = this;
    const legend = byId("legend");
    const entries: Node[] = [];
    if (settings.colorBy === "existence") {
      const bar = h("canvas", { width: 120, height: 8, "aria-hidden": "true" });
      const pen = bar.getContext("2d")!;
      const gradient = pen.createLinearGradient(0, 0, 120, 0);
      for (const [at, color] of existenceScale(this.dark)) gradient.addColorStop(at, css(color));
      pen.fillStyle = gradient;
      pen.fillRect(0, 0, 120, 8);
      entries.push(h("span", { class: "ramp" }, "0", bar, "1"), h("span", {}, "existence"));
    } else if (settings.colorBy === "class") {
      head.classes.slice(0, 12).forEach((name, code) => entries.push(h("span", {}, dot(css(classColor(code))), name)));
    } else if (settings.colorBy === "state") {
      for (const [state, color] of Object.entries(STATES)) entries.push(h("span", {}, dot(css(color)), state === "open" ? "not reviewed" : state));
    } else if (settings.colorBy === "update") {
      for (const name of head.states.filter((state) => state !== "gone")) entries.push(h("span", {}, dot(css(UPDATES[name] ?? STATES.open)), name));
    } else {
      for (const name of ["true", "duplicate", "false"]) entries.push(h("span", {}, dot(css(OUTCOMES[name])), name));
    }
    if (head.counts.gone) entries.push(h("span", {}, ring(css(UPDATES.gone), false), "gone"));
    if (settings.layers.has("truth")) {
      const named = { found: "true object", missed: "missed", "not recoverable": "not recoverable" };
      for (const [outcome, text] of Object.entries(named)) {
        if (this.ofObjects.has(outcome)) entries.push(h("span", {}, ring(css(OUTCOMES[outcome]), outcome !== "found"), text));
      }
    }
    legend.replaceChildren(...entries);
  }

  private toggleDark(): void {
    this.dark = !this.dark;
    localStorage.setItem("theme", this.dark ? "dark" : "light");
    document.documentElement.dataset.theme = this.dark ? "dark" : "light";
    this.filters.render(this.dark);
    this.map.setDark(this.dark);
    this.updateList();
    this.renderLegend();
    if (this.selection?.kind === "label") void this.openLabel(this.selection.id, false);
  }

  // What changes

  private settingsChanged(): void {
    this.map.setHiddenCodes(this.hiddenCodes());
    this.map.setSettings(this.settings);
    this.updateList();
    this.renderLegend();
    this.viewChanged();
  }

  private updateList(): void {
    const shown = this.map.shownRows();
    this.filters.update(shown, this.states, this.lost, this.selection?.kind === "label" ? this.selection.id : null);
    byId("shown").textContent = shown.length === this.labels.count ? "" : `${count(shown.length)} shown`;
  }

  private addressTimer = 0;

  private viewChanged(): void {
    this.basemap?.follow(this.map.getView());
    this.renderScale();
    clearTimeout(this.addressTimer);
    // Browsers refuse to change the address at the rate of a drag.
    this.addressTimer = window.setTimeout(() => this.writeAddress(), 200);
  }

  private writeAddress(): void {
    history.replaceState(null, "", toHash(this.settings, this.map.getView(), this.selection, this.head));
  }

  private addressChanged(): void {
    const { settings, view, selection } = fromHash(location.hash, this.head);
    Object.assign(this.settings, settings);
    this.filters.render(this.dark);
    if (view) this.map.setView(view);
    this.settingsChanged();
    if (selection?.kind === "label") void this.openLabel(selection.id, false);
    else if (selection) void this.openPlace(selection.east, selection.north);
  }

  private renderScale(): void {
    const metres = this.map.metresPerPixel();
    const steps = ticks(0, 130 * metres, 3);
    const length = steps[steps.length - 1];
    const text = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
    const bar = byId("scale");
    bar.textContent = text;
    bar.style.width = `${length / metres}px`;
  }

  private wasDrawn(): void {
    const { dataset } = document.body;
    dataset.drawnLabels = String(this.map.inView());
    dataset.settled = String(this.map.settled());
    if (!this.drawn && this.map.labelsDrawn()) {
      this.drawn = true;
      performance.measure("valuemap:interactive", { start: 0, end: performance.now() });
      dataset.ready = "true";
    }
  }

  private resting = 0;

  /** The label whose details are open. */
  private open(): number | null {
    return this.selection?.kind === "label" ? this.selection.id : null;
  }

  private hover(row: number | null, x: number, y: number, east: number, north: number): void {
    const tip = byId("tip");
    const where = byId("where");
    if (Number.isFinite(east)) {
      const { anchor, origin } = this.head;
      const geo = anchor && geographic(anchor, east, north);
      where.textContent = `${fixed(east + origin[0], 1)}, ${fixed(north + origin[1], 1)} m${geo ? `  ·  ${geo.lat.toFixed(6)}, ${geo.lon.toFixed(6)}` : ""}`;
    }
    tip.hidden = row === null;
    clearTimeout(this.resting);
    if (row === null) return;
    const { labels } = this;
    this.resting = window.setTimeout(() => this.expect(labels.id[row]), REST_MS);
    tip.replaceChildren(
      h("b", {}, `Label ${labels.id[row]}`),
      ` ${this.head.classes[labels.class[row]]}${labels.update[row] === "gone" ? ", gone" : ""}`,
      h("br"),
      `existence ${probability(labels.existence[row])} · ${plural(labels.votes[row], "vote")} · ${plural(labels.passes[row], "pass", "passes")}`,
    );
    // On the other side of the pointer where it would be cut, by the details for one.
    const [deck, details] = [byId("deck"), byId("details")];
    const right = deck.clientWidth - (details.hidden ? 0 : details.offsetWidth);
    const left = x + 14 + tip.offsetWidth > right ? Math.max(0, x - 14 - tip.offsetWidth) : x + 14;
    const top = y + 14 + tip.offsetHeight > deck.clientHeight ? y - 14 - tip.offsetHeight : y + 14;
    tip.style.transform = `translate(${left}px, ${top}px)`;
  }

  // Clicks

  private panelEvents = {
    onClose: () => this.close(),
    onLabel: (id: number) => void this.openLabel(id),
    onGo: (east: number, north: number) => this.map.show(east, north, 5),
    onLight: (shot: import("./api").Shot | null) => this.map?.light(shot),
    onDecide: (wish: Wish) => void this.decide(wish),
    onMove: (id: number) => this.startMoving(id),
  };

  private panel(): HTMLElement {
    const panel = byId("details");
    panel.hidden = false;
    byId("tip").hidden = true; // It says less than the panel, which may cover it.
    this.map.cover(panel.offsetWidth);
    return panel;
  }

  private async openLabel(id: number, move = true): Promise<void> {
    const begun = performance.now();
    const row = this.labels.rowOf.get(id);
    document.body.classList.remove("filtering");
    this.selection = { kind: "label", id };
    if (row === undefined) {
      renderProblem(this.panel(), `Label ${id}`, `There is no label ${id} in this map.`, this.panelEvents);
      return;
    }
    const at: [number, number] = [this.labels.position[2 * row], this.labels.position[2 * row + 1]];
    const turn = ++this.asked;
    this.panel();
    this.map.select(at, this.reviews.get(id)?.moved_to);
    if (move) this.map.show(...at);
    this.filters.mark(id);
    try {
      const details = await this.detailsOf(id);
      if (turn !== this.asked) return;
      const panel = this.panel();
      panel.scrollTop = 0;
      this.labelPanel = renderLabel(panel, details, this.sigmas(row), this.reviews.get(id) ?? closed, this.head, this.dark, this.panelEvents);
      this.gallery = this.labelPanel.gallery;
      this.map.showRays(details);
      say(`Label ${id}, ${details.class}${details.state === null ? "" : `, ${details.state}`}, existence ${probability(details.existence)}, ${plural(details.votes, "vote")}.`);
    } catch (error) {
      if (turn === this.asked) renderProblem(this.panel(), `Label ${id}`, String((error as Error).message), this.panelEvents);
    }
    answered(begun);
    this.viewChanged();
  }

  private early: { id: number; details: Promise<LabelDetails> } | null = null;

  /** Ask for a label that will be clicked in a moment: the pointer rests on it, or the button is down. */
  private expect(id: number): void {
    if (this.early?.id === id || this.open() === id) return;
    const details = api.label(id);
    details.catch(() => undefined); // Whoever clicks hears of it.
    this.early = { id, details };
  }

  /** What a label rests on, as it was asked for before or else now; a map that was made again is asked again. */
  private detailsOf(id: number): Promise<LabelDetails> {
    const { early } = this;
    this.early = null;
    return early?.id === id ? early.details : api.label(id);
  }

  private sigmas(row: number) {
    return { major: this.labels.ellipse[3 * row], minor: this.labels.ellipse[3 * row + 1], up: this.sigmaUp[row] };
  }

  private async clickedPlace(east: number, north: number): Promise<void> {
    if (this.moving === null) return this.openPlace(east, north);
    const id = this.moving;
    this.moving = null;
    document.body.classList.remove("moving");
    const review = this.reviews.get(id) ?? closed;
    await this.decide({ label_id: id, verdict: review.verdict ?? "accepted", new_class: review.new_class ?? null, moved_to: [east, north], note: review.note ?? "" });
  }

  private async openPlace(east: number, north: number): Promise<void> {
    const begun = performance.now();
    const turn = ++this.asked;
    this.selection = { kind: "place", east, north };
    this.labelPanel = null;
    this.map.select([east, north]);
    this.filters.mark(null);
    try {
      const details = await api.place(east, north);
      if (turn !== this.asked) return;
      const panel = this.panel();
      panel.scrollTop = 0;
      this.gallery = renderPlace(panel, details, this.head, this.dark, this.panelEvents);
      this.map.showRays(details);
      say(details.answer);
    } catch (error) {
      if (turn === this.asked) renderProblem(this.panel(), "Why is there nothing here?", String((error as Error).message), this.panelEvents);
    }
    answered(begun);
    this.viewChanged();
  }

  private close(): void {
    this.asked++;
    this.selection = null;
    this.gallery = this.labelPanel = null;
    this.stopMoving();
    this.map.select(null);
    this.filters.mark(null);
    byId("details").hidden = true;
    this.map.cover(0);
    byId("deck").focus({ preventScroll: true });
    this.viewChanged();
  }

  private async decide(wish: Wish): Promise<void> {
    try {
      const review = await api.decide(wish);
      this.reviews.delete(wish.label_id);
      const row = this.labels.rowOf.get(wish.label_id)!;
      this.states[row] = review.state;
      if (review.verdict) this.keep(review);
      this.map.setStates(this.states);
      this.updateList();
      if (this.selection?.kind === "label" && this.selection.id === wish.label_id) await this.openLabel(wish.label_id, false);
      say(`Label ${wish.label_id}: ${review.state === "open" ? "not reviewed" : review.state}, saved.`);
    } catch (error) {
      say(`Not saved: ${(error as Error).message}`);
      document.body.classList.add("problem");
      setTimeout(() => document.body.classList.remove("problem"), 6000);
    }
  }

  private startMoving(id: number): void {
    this.moving = id;
    document.body.classList.add("moving");
    say(`Click where label ${id} really is. Escape keeps it where it is.`);
  }

  private stopMoving(): void {
    this.moving = null;
    document.body.classList.remove("moving");
  }

  // Keys

  private key(event: KeyboardEvent): void {
    const target = event.target as HTMLElement;
    const typing = target.matches("input:not([type=checkbox]):not([type=radio]):not([type=range]), textarea");
    if (event.key === "Escape" && !document.querySelector("dialog[open]")) {
      if (typing) target.blur();
      else if (this.moving !== null) this.stopMoving();
      else if (this.selection) this.close();
      return;
    }
    if (typing || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (target.matches("input") && event.key.startsWith("Arrow")) return;
    const label = this.selection?.kind === "label" ? this.selection.id : null;
    const arrows: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[event.key];
    if (arrow) {
      const sideways = arrow[0] !== 0;
      if (this.gallery && !event.shiftKey && sideways) this.gallery.step(arrow[0]);
      else if (this.gallery && !event.shiftKey && target.closest("#details")) return;
      else this.map.panBy(80 * arrow[0], 80 * arrow[1]);
      event.preventDefault();
      return;
    }
    const press = (verdict: Verdict) => {
      if (label === null || !this.labelPanel) return;
      const now = this.reviews.get(label)?.verdict ?? null;
      void this.decide(this.labelPanel.wish(now === verdict ? null : verdict));
    };
    const keys: Record<string, () => void> = {
      "+": () => this.map.zoomBy(0.5),
      "=": () => this.map.zoomBy(0.5),
      "-": () => this.map.zoomBy(-0.5),
      "0": () => this.map.fit(),
      "/": () => byId("search").focus(),
      "?": () => showKeys(),
      a: () => press("accepted"),
      r: () => press("rejected"),
      u: () => label !== null && this.labelPanel && void this.decide({ label_id: label, verdict: null }),
      m: () => label !== null && this.startMoving(label),
      n: () => this.next(label, 1),
      j: () => this.next(label, 1),
      p: () => this.next(label, -1),
      k: () => this.next(label, -1),
      d: () => this.toggleDark(),
    };
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (act) {
      event.preventDefault();
      act();
    } else if (event.key === "Enter" && this.gallery && !target.closest("button, a, input, textarea, summary")) {
      event.preventDefault(); // Else the same key closes what it opens: the button to close has the focus then.
      this.gallery.open();
    }
  }

  private next(label: number | null, by: number): void {
    const id = this.filters.neighbor(label, by);
    if (id !== null) void this.openLabel(id);
  }

  /** For tests and measurements: where on the screen a label is. */
  screenOf(id: number): [number, number] | null {
    const row = this.labels.rowOf.get(id);
    if (row === undefined) return null;
    const [x, y] = this.map.toScreen(this.labels.position[2 * row], this.labels.position[2 * row + 1]);
    const box = byId("deck").getBoundingClientRect();
    return [x + box.left, y + box.top];
  }

  getView(): View {
    return this.map.getView();
  }

  setView(view: View): void {
    this.map.setView(view);
  }
}

/** The time from a click until what it asked for is painted. */
function answered(begun: number): void {
  requestAnimationFrame(() => setTimeout(() => performance.measure("valuemap:click", { start: begun, end: performance.now() })));
}

function ring(color: string, filled: boolean): Node {
  const mark = dot(color) as SVGSVGElement;
  const circle = mark.firstElementChild!;
  circle.setAttribute("fill-opacity", filled ? "0.35" : "0");
  circle.setAttribute("stroke", color);
  circle.setAttribute("stroke-width", "0.4");
  circle.setAttribute("r", "0.75");
  return mark;
}

function showKeys(): void {
  const keys: [string, string][] = [
    ["click", "a label: what it rests on; elsewhere: why there is nothing"],
    ["N  P", "next and previous label, the most doubtful first"],
    ["← →", "through the pictures of a label; without one, move the map"],
    ["Enter", "the whole picture"],
    ["A  R  U", "accept, reject, undo"],
    ["M", "move the label: click where it really is"],
    ["+  −  0", "zoom in, out, show everything"],
    ["Shift + arrows", "move the map"],
    ["/", "search by id"],
    ["D", "light or dark"],
    ["Esc", "close"],
  ];
  const dialog = h("dialog", { id: "keys", "aria-label": "Keys" }, h("h2", {}, "Keys"), h("dl", { class: "facts" }, ...keys.flatMap(([key, text]) => [h("dt", {}, h("kbd", {}, key)), h("dd", {}, text)])), h("button", { class: "close", "aria-label": "Close", onclick: () => dialog.close() }, "×"));
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}

declare global {
  interface Window {
    valuemap?: Page;
  }
}

async function start(): Promise<void> {
  const begun = api.labels();
  const [head, labels, cameras, reviews] = await Promise.all([api.head(), begun, api.cameras(), api.reviews()]);
  performance.mark("valuemap:loaded");
  window.valuemap = new Page(head, labels, cameras, reviews);
  performance.mark("valuemap:built");
}

start().catch((error: Error) => {
  document.body.classList.add("problem");
  say(`The map cannot be shown: ${error.message}`);
});
